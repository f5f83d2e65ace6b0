"""The reference solution: the neutral scene integrated independently of any engine."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.reference import cache as entries
from mbds_xsim.reference.bouncing import march_balls
from mbds_xsim.reference.colliding import march_colliding
from mbds_xsim.reference.dynamics import Dynamics
from mbds_xsim.reference.equations import dynamics_of
from mbds_xsim.reference.first_impact import TOUCHING, FirstImpact
from mbds_xsim.reference.marching import Marched, Problem, march
from mbds_xsim.reference.singular import moved
from mbds_xsim.reference.stiff import is_stiff, march_stiff
from mbds_xsim.scene.collisions import has_known_impacts
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.markers import marker_positions, markers
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.servo import with_pushes
from mbds_xsim.scene.state import Batch, Failure, Trajectory

# Trajectories solved at once: with fewer, lanes idle at the end; more gain nothing. Large scenes
# have as many as fit into some memory [bytes], but at least enough to fill the lanes.
_TOGETHER, _LEAST_TOGETHER, _MEMORY = 256, 8, 2**25
_SUNK = 1e-9  # overlap that rounding may give a start in contact [m]
TIGHTEST, LOOSEST = 1e-14, 1e-3
_CONFIRMED = 1e-13
_ALONE = 1e-11


def solve(scene: Scene, batch: Batch, *, rtol: float = 1e-11, cache: bool = True) -> Trajectory:
    """Integrate every trajectory of a batch to high accuracy.

    Most scenes are integrated by compiled kernels, in coordinates of a spanning tree; loops are
    closed by constraints at acceleration level and a projection at every frame (`compiled`). Joints
    with dry friction or stops add events (`gripping`). Other scenes with contact or stiff dampers
    use maximal coordinates (`marching`, `stiff`). Free bodies with one contact sphere around their
    centre of mass are followed exactly through flight, impacts, sliding and rolling (`bouncing`);
    so are even balls that touch each other, two at a time, and no ground (`colliding`). Any other
    contact has no unique solution: there a trajectory ends, with a `FirstImpact` in place of a
    failure, when a contact sphere first reaches what it may touch; its later frames are NaN.

    Args:
        scene: Scene to simulate.
        batch: Starts and inputs.
        rtol: Allowed error of a step, relative to 1 plus the size of each component of the state.
        cache: Whether results are read from the disk, and stored there.

    Raises:
        InputError: The tolerance is out of range, or contact spheres start in the ground or in
            each other.
    """
    return _solved("solve", integrate, scene, batch, checked_tolerance(rtol), cache)


def confirmed(scene: Scene, batch: Batch, cache: bool) -> Trajectory:
    """Solve again by other equations, slowly, to check the reference itself.

    All joints are closed by multipliers in maximal coordinates, without the compiled kernels, at a
    tolerance of 1e-13; the method is explicit even for stiff scenes. Exceptions: rotors, couplings,
    dry friction and stops need the compiled kernels, and the last two are solved as in `solve`.
    Whole turns are not counted, so a trajectory ends where a sprung hinge passes half a turn.
    """
    return _solved("confirmed", _marched, scene, batch, _CONFIRMED, cache)


def _solved(
    kind: str,
    method: Callable[[Problem], Marched],
    scene: Scene,
    batch: Batch,
    rtol: float,
    cache: bool,
) -> Trajectory:
    def compute(rows: list[int]) -> list[entries.Arrays]:
        problem = _problem(scene, batch[rows], rtol)
        _check_apart(problem.mechanism, problem.start)
        marched = method(problem)
        return [
            {"states": states, "failure": _encoded(failure)}
            for states, failure in zip(marched.states, marched.failures, strict=True)
        ]

    each = 8 * 13 * (len(scene.bodies) + 1) * (batch.steps + 1)
    lanes = _MEMORY // each // _LEAST_TOGETHER * _LEAST_TOGETHER
    together = min(max(_LEAST_TOGETHER, lanes), _TOGETHER)
    ready = entries.complete(kind, scene, batch, rtol, compute, keep=cache, together=together)
    return _trajectory(scene, batch, ready)


def _problem(scene: Scene, batch: Batch, rtol: float) -> Problem:
    mechanism = Mechanism.of(scene)
    return Problem(
        dynamics=dynamics_of(mechanism),
        start=start_states(mechanism, batch),
        force=batch.force,
        torque=with_pushes(mechanism.drives, batch.torque),
        rtol=rtol,
    )


def _marched(problem: Problem) -> Marched:
    return integrate(problem) if problem.mechanism.braked else march(problem)


def checked_tolerance(rtol: float) -> float:
    """Return the tolerance, or raise InputError if it is out of range."""
    if not TIGHTEST <= rtol <= LOOSEST:
        raise InputError(f"rtol: got {rtol}, allowed is {TIGHTEST:.0e} to {LOOSEST:.0e}")
    return rtol


def _check_apart(mechanism: Mechanism, start: Array) -> None:
    dynamics = dynamics_of(mechanism)
    gap, _ = dynamics.gaps(start)
    if not (gap.size and gap.min() < -_SUNK):
        return
    grounded, pairs = dynamics.topology.grounded, mechanism.sphere_pairs.tolist()
    lowest, names = int(gap.min(axis=0).argmin()), [body.name for body in mechanism.scene.bodies]
    on = [f"contacts[{k}] on {names[body]!r}" for k, body in enumerate(mechanism.sphere_body)]
    if lowest < len(grounded):
        subject, place = f"{on[grounded[lowest]]} starts", "below the ground z = 0"
        hint = "start it with its centre at its radius or higher"
    else:
        subject = " and ".join(on[k] for k in pairs[lowest - len(grounded)]) + " start"
        place, hint = "in each other", "start them apart"
    raise InputError(f"{subject} {-gap.min():.3g} m {place}; {hint}")


def start_states(mechanism: Mechanism, batch: Batch) -> Array:
    """Start states of a batch, shape (trajectory, body + world, 13)."""
    return dynamics_of(mechanism).pack(BodyStates.of(mechanism, batch))


def integrate(problem: Problem) -> Marched:
    """Solve a problem with the method that suits the scene."""
    mechanism = problem.mechanism
    if has_known_impacts(mechanism):
        return march_balls(problem) if mechanism.scene.ground else march_colliding(problem)
    if mechanism.braked:
        from mbds_xsim.reference.gripping import march_gripping  # imports a compiler

        # Companions stop and start at different times, so that their errors do not cancel.
        rtol = min(problem.rtol, _ALONE) if problem.companions > 1 else problem.rtol
        return march_gripping(dataclasses.replace(problem, rtol=rtol))
    if is_stiff(mechanism):
        return march_stiff(problem)
    if mechanism.scene.contacts:
        return march(problem)
    from mbds_xsim.reference.compiled import march_compiled  # imports a compiler

    return march_compiled(problem)


def _trajectory(
    scene: Scene, batch: Batch, ready: Iterable[tuple[int, entries.Arrays]]
) -> Trajectory:
    mechanism = Mechanism.of(scene)
    time = scene.clock.frame * np.arange(batch.steps + 1, dtype=float)
    shape, dynamics = (len(batch), len(time), mechanism.body_count), dynamics_of(mechanism)
    position, velocity, spin = (np.empty((*shape, 3)) for _ in range(3))
    orientation = np.empty((*shape, 4))
    failures: list[Failure | None] = [None] * len(batch)
    for row, entry in ready:
        failures[row] = _decoded(entry["failure"])
        bodies = dynamics.unpack(entry["states"])
        position[row], velocity[row] = bodies.position, bodies.velocity
        orientation[row] = mechanism.body_orientation(bodies.native)
        spin[row] = bodies.angular_velocity
    # Frame 0 is the start, bit for bit.
    orientation[:, 0] = batch.orientation
    return Trajectory(time, position, orientation, velocity, spin, tuple(failures))


def _encoded(failure: Failure | None) -> NDArray[np.str_]:
    text = [] if failure is None else [str(failure.frame), failure.reason]
    if isinstance(failure, FirstImpact):
        text.append(repr(failure.time))
    return np.array(text, dtype=np.str_)


def _decoded(text: NDArray[np.str_]) -> Failure | None:
    if not len(text):
        return None
    frame, reason, *time = map(str, text)
    return FirstImpact(int(frame), reason, float(time[0])) if time else Failure(int(frame), reason)


_SIZE = 1e-8  # RMS displacement of the start [m], and RMS change of its velocities [m/s]
_SEED = 20240607
_PAIRS_TOGETHER = 32


def sensitivity(scene: Scene, batch: Batch, *, rtol: float = 1e-7, cache: bool = True) -> Array:
    """Measure the growth factor G: RMS particle distance of two runs over that at the start.

    The second start is displaced by 1e-8 m, and its velocities are changed by 1e-8 m/s, in random
    directions that the joints, the ground and the scene's dimension allow, always the same for a
    trajectory. Both runs share their steps, so that numerical errors cancel in their distance and
    a loose tolerance is enough.

    Args:
        scene: Scene to simulate.
        batch: Starts and inputs.
        rtol: Allowed error of a step, as in `solve`.
        cache: Whether results are read from the disk, and stored there.

    Returns:
        G, shape (trajectory, frame), 1 at frame 0; NaN from the frame on at which either of the two
        solutions ends.

    Raises:
        InputError: The tolerance is out of range.
    """
    rtol = checked_tolerance(rtol)
    kind = f"sensitivity {_SIZE} {_SEED}"

    def compute(rows: list[int]) -> list[entries.Arrays]:
        growth = _growth(scene, batch[rows], rtol)
        return [{"growth": values} for values in growth]

    ready = entries.complete(
        kind, scene, batch, rtol, compute, keep=cache, together=_PAIRS_TOGETHER
    )
    factors = np.empty((len(batch), batch.steps + 1))
    for row, entry in ready:
        factors[row] = entry["growth"]
    return factors


def _growth(scene: Scene, batch: Batch, rtol: float) -> Array:
    once = _problem(scene, batch, rtol)
    mechanism, dynamics = once.mechanism, once.dynamics
    start = dynamics.project(once.start)
    other = np.array([_perturbed(dynamics, *pair) for pair in zip(start, batch.index, strict=True)])
    pairs = np.stack([start, other], axis=1).reshape(-1, *start.shape[1:])
    twice = once.part(np.repeat(np.arange(len(batch)), 2))
    marched = integrate(dataclasses.replace(twice, start=pairs, companions=2))
    bodies = dynamics.unpack(marched.states)
    markers = marker_positions(mechanism, bodies.position, bodies.native)
    distance = _rms(markers[::2] - markers[1::2])
    return np.asarray(distance / distance[:, :1])


def _perturbed(dynamics: Dynamics, state: Array, index: int) -> Array:
    """Perturb one state, shape (body + world, 13), as its joints allow."""
    rng = np.random.default_rng(np.random.SeedSequence([_SEED, index]))
    free = _free_components(dynamics, state)
    shift, rate = (_allowed_twist(dynamics, state, free, rng) for _ in range(2))
    other = moved(state, shift[None])
    other[..., 7:] += rate
    return np.asarray(dynamics.project(other)[0])


def _free_components(dynamics: Dynamics, state: Array) -> Array:
    """1 where a body may move or turn, else 0, shape (body, 6)."""
    mechanism = dynamics.mechanism
    free = np.ones((mechanism.body_count, 6))
    if mechanism.scene.dimension < 3:
        free[:, [1, 3, 5]] = 0.0
    if mechanism.scene.dimension < 2:
        free[:, 2] = 0.0
    grounded = dynamics.topology.grounded
    height = dynamics.gaps(state[None])[0][0, : len(grounded)]
    free[mechanism.sphere_body[grounded[height <= TOUCHING]], 2] = 0.0
    return free


def _allowed_twist(
    dynamics: Dynamics, state: Array, free: Array, rng: np.random.Generator
) -> Array:
    """Random twists, shape (body + world, 6), under which the markers move by 1e-8 m (RMS)."""
    trial = state.copy()
    trial[:-1, 7:] = free * rng.standard_normal(free.shape)
    trial[:-1, 10:] /= dynamics.length
    trial = dynamics.project(trial[None])[0]
    rate = dynamics.unpack(trial).speeds(*markers(dynamics.mechanism))
    return np.asarray(trial[:, 7:] * (_SIZE / _rms(rate)))


def _rms(vectors: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(np.sum(vectors**2, axis=-1), axis=-1)))
