"""The reference as a test domain, and the floors that follow from it: noise and chaos."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import reference
from mbds_xsim.dataset.points import Points
from mbds_xsim.errors import InputError
from mbds_xsim.isolate import Crash, Task, run_tasks
from mbds_xsim.learn.shift.domains import Paired, Solved
from mbds_xsim.learn.window import HISTORY
from mbds_xsim.reference.cache import directory, key_of, read_sealed, sealed
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Trajectory
from mbds_xsim.write import write_whole

__all__ = ["Truth", "read_truth", "solve_domain"]

Array = NDArray[np.float64]

_TOGETHER = 8
_STATES = ("position", "orientation", "velocity", "angular_velocity")


@dataclass(frozen=True, eq=False)
class Truth:
    """The reference solution of a test set, up to a last frame."""

    position: Array
    """Of the particles [m], shape (trajectory, frame, particle, axis); NaN where not known."""
    velocity: Array
    """The same [m/s]."""
    body: Array
    """Published states of the bodies, shape (trajectory, frame, body, 13)."""
    quiet: Array
    """Positions without the noise from frame `HISTORY` on, started from this solution [m], shape
    (trajectory, frame − 6, particle, axis)."""
    growth: Array
    """Growth factor of small errors, `reference.sensitivity`, shape (trajectory, frame)."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """Shape (trajectory, frame)."""
        return np.asarray(np.isfinite(self.position).all(axis=(2, 3)))


def solve_domain(
    test: Paired, horizon: int, *, cache: bool = True, workers: int | None = None
) -> tuple[Solved | None, str]:
    """Solve the reference for all test starts.

    Returns:
        The domain; None where it is known nowhere behind the first window, and the reason.
    """
    steps = HISTORY - 1 + horizon
    batch = test.batch.truncated(steps)
    path = directory() / "shift" / "truth" / f"{_key(test, batch)}.npz"
    truth = _kept(path) if cache else None
    if truth is None:
        answers = run_tasks(_tasks(test, batch, cache), workers=workers)
        crashes = [answer.reason for answer in answers if isinstance(answer, Crash)]
        if crashes:
            return None, f"the reference solution failed: {crashes[0]}"
        truth = _joined(answers)
        _write(path, truth)
    if not truth.known[:, HISTORY].any():
        return None, "the reference ends at a first impact within the first frames"
    content = hashlib.sha256(path.read_bytes()).hexdigest()
    return Solved(test.domains[0], path, content), ""


def read_truth(path: Path) -> Truth:
    """Read what `solve_domain` has kept.

    Raises:
        InputError: It cannot be read any more.
    """
    truth = _kept(path)
    if truth is None:
        msg = f"{path}: cannot be read; run again"
        raise InputError(msg)
    return truth


def _kept(path: Path) -> Truth | None:
    arrays = read_sealed(path)
    return None if arrays is None else Truth(**arrays)


def _tasks(test: Paired, batch: Batch, cache: bool) -> list[Task]:
    parts = [slice(k, k + _TOGETHER) for k in range(0, len(batch), _TOGETHER)]
    quiet = test.quiet[:, : batch.steps]
    return [Task(_solved, (test.scene, batch[part], quiet[part], cache)) for part in parts]


def _solved(scene: Scene, batch: Batch, quiet: Array, cache: bool) -> Truth:
    trajectory = reference.solve(scene, batch, cache=cache)
    position, velocity = Points.of(scene).motion(trajectory)
    return Truth(
        position=position,
        velocity=velocity,
        body=np.concatenate([getattr(trajectory, name) for name in _STATES], axis=-1),
        quiet=_without_noise(scene, batch, trajectory, quiet, cache),
        growth=reference.sensitivity(scene, batch, cache=cache),
    )


def _without_noise(
    scene: Scene, batch: Batch, trajectory: Trajectory, quiet: Array, cache: bool
) -> Array:
    """What a perfect model, which does not see the noise, predicts from the last known frame."""
    last = HISTORY - 1
    known = np.isfinite(trajectory.position[:, last]).all(axis=(1, 2))
    states = {name: getattr(trajectory, name)[known, last] for name in _STATES}
    start = Batch(
        index=batch.index[known],
        **states,
        force=quiet[known, last:],
        torque=batch.torque[known, last:],
    )
    found, _ = Points.of(scene).motion(reference.solve(scene, start, cache=cache))
    whole = np.full((len(batch), *found.shape[1:]), np.nan)
    whole[known] = found
    return whole[:, 1:]


def _key(test: Paired, batch: Batch) -> str:
    digest = hashlib.sha256()
    for row in range(len(batch)):
        digest.update(key_of("shift", test.scene, batch, row, 0.0).encode())
    digest.update(np.ascontiguousarray(test.quiet[:, : batch.steps]).tobytes())
    return digest.hexdigest()


def _joined(parts: list[Truth]) -> Truth:
    names = Truth.__dataclass_fields__
    return Truth(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


def _write(path: Path, truth: Truth) -> None:
    arrays = {name: getattr(truth, name) for name in Truth.__dataclass_fields__}
    write_whole(path, sealed(path, arrays))
