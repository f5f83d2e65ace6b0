"""How a trajectory amplifies a small error: the reference run again from a perturbed start."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.reference import cache as entries
from mbds_xsim.reference.dynamics import Dynamics, dynamics_of
from mbds_xsim.reference.first_impact import TOUCHING
from mbds_xsim.reference.solution import checked_tolerance, integrate, start_states
from mbds_xsim.scene.mechanism import Mechanism, marker_positions, markers
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch

Progress = Callable[[int, int], None]

_SIZE = 1e-8  # RMS displacement of the start [m], and RMS change of its velocities [m/s]
_SEED = 20240607
_PAIRS_TOGETHER = 32


def sensitivity(
    scene: Scene,
    batch: Batch,
    *,
    rtol: float = 1e-7,
    cache: bool = True,
    progress: Progress | None = None,
) -> Array:
    """Measure the growth factor G: RMS particle distance of two runs over that at the start.

    The second start is displaced by 1e-8 m, and its velocities are changed by 1e-8 m/s, in random
    directions that the joints, the ground and the scene's dimension allow, always the same for a
    trajectory. Both runs share their steps, so that numerical errors cancel in their distance and
    a loose tolerance is enough.

    Args:
        scene: What to simulate.
        batch: Starts and inputs.
        rtol: Allowed error of a step, as in `solve`.
        cache: Whether results are taken from disk, and kept there.
        progress: Called now and then with the number of frames done and of all frames.

    Returns:
        G, shape (trajectory, frame), 1 at frame 0; NaN from the frame on at which the solution of
        either of the two ends.

    Raises:
        InputError: The tolerance is out of range.
    """
    rtol = checked_tolerance(rtol)
    what = f"sensitivity {_SIZE} {_SEED}"

    def compute(rows: list[int], report: Progress | None) -> list[entries.Arrays]:
        growth = _growth(scene, batch[rows], rtol, report)
        return [{"growth": values} for values in growth]

    ready = entries.complete(
        what, scene, batch, rtol, compute, keep=cache, together=_PAIRS_TOGETHER, progress=progress
    )
    return np.array([entry["growth"] for entry in ready]).reshape(len(batch), batch.steps + 1)


def _growth(scene: Scene, batch: Batch, rtol: float, progress: Progress | None) -> Array:
    mechanism = Mechanism.of(scene)
    dynamics = dynamics_of(mechanism)
    start = dynamics.project(start_states(mechanism, batch))
    other = np.array(
        [_perturbed(mechanism, *pair) for pair in zip(start, batch.index, strict=True)]
    )
    pairs = np.stack([start, other], axis=1).reshape(-1, *start.shape[1:])
    twice = batch[np.repeat(np.arange(len(batch)), 2)]
    marched = integrate(scene, pairs, twice, rtol, companions=2, progress=progress)
    bodies = dynamics.unpack(marched.states)
    markers = marker_positions(mechanism, bodies.position, bodies.native)
    distance = _rms(markers[::2] - markers[1::2])
    return np.asarray(distance / distance[:, :1])


def _perturbed(mechanism: Mechanism, state: Array, index: int) -> Array:
    """Move one state, shape (body + world, 13), as its joints allow."""
    dynamics = dynamics_of(mechanism)
    rng = np.random.default_rng(np.random.SeedSequence([_SEED, index]))
    free = _free_components(mechanism, dynamics, state)
    shift, rate = (_allowed_twist(mechanism, dynamics, state, free, rng) for _ in range(2))
    moved = state.copy()
    moved[:, :3] += shift[:, :3]
    moved[:, 3:7] = rotation.multiply(rotation.from_vector(shift[:, 3:]), state[:, 3:7])
    moved[:, 7:] += rate
    return np.asarray(dynamics.project(moved[None])[0])


def _free_components(mechanism: Mechanism, dynamics: Dynamics, state: Array) -> Array:
    """1 where a body may move or turn, else 0, shape (body, 6)."""
    free = np.ones((mechanism.body_count, 6))
    if mechanism.scene.dimension < 3:
        free[:, [1, 3, 5]] = 0.0
    if mechanism.scene.dimension < 2:
        free[:, 2] = 0.0
    height, _ = dynamics.heights(state[None])
    free[mechanism.sphere_body[height[0] <= TOUCHING], 2] = 0.0
    return free


def _allowed_twist(
    mechanism: Mechanism,
    dynamics: Dynamics,
    state: Array,
    free: Array,
    rng: np.random.Generator,
) -> Array:
    """Random twists, shape (body + world, 6), under which the markers move by 1e-8 m (RMS)."""
    trial = state.copy()
    trial[:-1, 7:] = free * rng.standard_normal(free.shape)
    trial[:-1, 10:] /= mechanism.scene.length
    trial = dynamics.project(trial[None])[0]
    rate = dynamics.unpack(trial).speeds(*markers(mechanism))
    return np.asarray(trial[:, 7:] * (_SIZE / _rms(rate)))


def _rms(vectors: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(np.sum(vectors**2, axis=-1), axis=-1)))
