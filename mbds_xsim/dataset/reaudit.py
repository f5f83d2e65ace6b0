"""Check a file of trajectories again, from its own contents alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.dataset.content import check_content
from mbds_xsim.dataset.facts import attributes_of, scene_of
from mbds_xsim.dataset.fit import misfits
from mbds_xsim.dataset.gate import SHARED, Verdict, judge_rows
from mbds_xsim.dataset.held import Held
from mbds_xsim.dataset.layout import CHECKS
from mbds_xsim.dataset.opened import opened
from mbds_xsim.dataset.points import Points
from mbds_xsim.errors import EngineMissing, InputError, UnknownName
from mbds_xsim.registry import load_adapter
from mbds_xsim.sampling import draw_batch
from mbds_xsim.simulate import simulate
from mbds_xsim.state import Trajectory

__all__ = ["FileReport", "reaudit"]

_SAME_DRAW = 1e-12  # relative; what another processor's sine may differ by
_SAME_FIGURE = 1e-6  # of the figure, or of what is allowed
_ROUNDED = 2.0**-23  # of float32, relative: the nearest of two neighbours
_SAME_MOTION = 1e-6  # of a state's scale; rounding that chaos has amplified
_SAME_AT_FIRST = 1e-10  # the same, up to the frame _EARLY
_EARLY = 5
_STATE = ("position", "orientation", "velocity", "angular_velocity")


@dataclass(frozen=True)
class FileReport:
    """What became of one file."""

    file: str
    kind: str
    trajectories: int
    problems: tuple[str, ...] = ()
    """What is wrong; nothing: it holds what it says."""
    notes: tuple[str, ...] = ()
    """What else there is to know."""


def reaudit(path: Path, resimulated: int, seed: int = 0) -> FileReport:
    """Check layout, checksums, numbers, draws, points and every check; make some again.

    Args:
        path: A shard, or a file of rejected trajectories.
        resimulated: How many trajectories are simulated again, if the engine is here.
        seed: Chooses which.
    """
    try:
        wrong = check_content(path)
        if wrong is not None:
            return FileReport(str(path), "unknown", 0, (f"checksum: {wrong}",))
        kind, problems = _layout(path)
        if problems:
            return FileReport(str(path), kind, 0, problems)
        held = Held.read(path)
        problems = (*_numbers(held), *_draws(held), *_orientations(held))
        problems = (*problems, *_points(held), *_checks(held))
        more, notes = _again(held, resimulated, seed)
    except (InputError, OSError, KeyError, ValueError, RuntimeError) as error:
        return FileReport(str(path), "unknown", 0, (f"cannot be read: {error}",))
    return FileReport(str(path), held.attributes["kind"], len(held), (*problems, *more), notes)


def _layout(path: Path) -> tuple[str, tuple[str, ...]]:
    """Give the kind of a file, and what is wrong with its datasets."""
    told = attributes_of(path)
    scene = scene_of(told["scene"], path)
    with opened(path) as file:
        return told["kind"], tuple(misfits(file, told["kind"], scene))


def _numbers(held: Held) -> Iterator[str]:
    """The numbering of the trajectories, and what repeats what the scene says."""
    told, index = held.attributes, held.arrays["index"]
    first, count = told["first"], told["count"]
    if len(index) and (
        index[0] < first or index[-1] >= first + count or (np.diff(index) < 1).any()
    ):
        yield f"index: not ascending from {first} to {first + count - 1}"
    if not np.array_equal(held.arrays["interval"], index % 3):
        yield "interval: not index mod 3"
    own = "published" if told["kind"] == "shard" else "rejected"
    if told[own] != len(index) or told["published"] + told["rejected"] != count:
        yield f"counts: {own} is {told[own]} with {len(index)} trajectories of {count} here"
    clock = held.scene.clock
    if (told["steps"], told["frame_s"]) != (clock.steps, clock.frame):
        yield "clock: steps and frame_s are not the scene's"
    time = clock.frame * np.arange(clock.steps + 1)
    if not np.allclose(held.arrays["time"], time, rtol=1e-12, atol=0):
        yield "time: not that of the scene's frames"


def _draws(held: Held) -> Iterator[str]:
    """Starts and inputs must be those of seed and index: so engines are paired."""
    told = held.attributes
    drawn = draw_batch(
        held.scene, held.arrays["index"].tolist(), seed=told["seed"], noise=bool(told["noise"])
    )
    for key in drawn.__dataclass_fields__:
        wanted, got = getattr(drawn, key), getattr(held.batch, key)
        if len(held) and not _close(got, wanted, _SAME_DRAW):
            yield f"pairing: {key} is not what seed {told['seed']} and index give"
    if "input/known_force" in held.arrays and len(held):
        known = draw_batch(
            held.scene, held.arrays["index"].tolist(), seed=told["seed"], noise=False
        )
        if not _close(held.arrays["input/known_force"], known.force, _SAME_DRAW):
            yield "pairing: known_force is not what seed and index give"


def _close(got: NDArray[np.float64], wanted: NDArray[np.float64], relative: float) -> bool:
    scale = max(1.0, float(np.abs(wanted).max(initial=0.0)))
    return bool((np.abs(got - wanted) <= relative * scale).all())


def _orientations(held: Held) -> Iterator[str]:
    """Quaternions must go on with the sign that they have at the start."""
    given = held.arrays["body/orientation"]
    turned = rotation.continuous(given, held.arrays["start/orientation"])
    off = (turned != given) & np.isfinite(given)
    for row, frame in zip(*np.nonzero(off.any(axis=(2, 3))), strict=True):
        yield (
            f"body/orientation: changes its sign at frame {frame} of trajectory "
            f"{held.batch.index[row]}; what is learned from it would see a jump"
        )
        return


def _points(held: Held) -> Iterator[str]:
    """Positions and velocities of the particles follow from the bodies' states."""
    points = Points.of(held.scene)
    for name, wanted in zip(("position", "velocity"), points.motion(held.trajectory), strict=True):
        got = held.arrays[name]
        off = np.abs(got - wanted) > _ROUNDED * np.abs(wanted) + 1e-14
        if off.any() or not np.array_equal(np.isnan(got), np.isnan(wanted)):
            row = int(np.flatnonzero((off | (np.isnan(got) != np.isnan(wanted))).any((1, 2, 3)))[0])
            yield f"{name}: not that of the bodies, first of trajectory {held.batch.index[row]}"
    for name, values in points.graph().items():
        if not np.array_equal(held.arrays[name], values):
            yield f"{name}: not that of the scene"


def _checks(held: Held) -> Iterator[str]:
    """Every check must find what it found, and the verdict be what it was.

    Checks that are newer than the file were not measured then; they judge all the same.
    """
    if not set(held.arrays["check/name"].tolist()) <= set(CHECKS):
        yield "checks: another version's; install the version that the file names"
        return
    if not len(held):
        return
    verdict = judge_rows(held.scene, held.batch, held.trajectory, held.making)
    yield from _figures(held, verdict)
    passed = verdict.published(certified=held.attributes["certification"] == "certified")
    if held.attributes["kind"] == "shard":
        for row in np.flatnonzero(~passed):
            yield f"published trajectory {held.batch.index[row]} fails: {verdict.reason(int(row))}"
    else:
        of_all = ("read-back", SHARED)
        misbuilt = np.array([text.startswith(of_all) for text in held.arrays["reason"]])
        for row in np.flatnonzero(passed & ~misbuilt):
            yield f"rejected trajectory {held.batch.index[row]} passes every check"


def _figures(held: Held, verdict: Verdict) -> Iterator[str]:
    names = held.arrays["check/name"].tolist()
    columns = [list(CHECKS).index(name) for name in names]
    allowed = verdict.allowed[:, columns]
    for key in ("figure", "allowed"):
        stored, found = held.arrays[f"check/{key}"], getattr(verdict, key)[:, columns]
        scale = np.fmax(np.abs(stored), np.where(np.isfinite(found), np.abs(found), 0.0))
        scale = np.fmax(scale, np.where(np.isfinite(allowed), allowed, 0.0))
        same = (stored == found) | (np.abs(stored - found) <= _SAME_FIGURE * scale)
        # A check may not apply to any of the trajectories left, and so to none.
        same |= np.isnan(stored) | np.isnan(found)
        for row, column in np.argwhere(~same)[:3]:
            yield (
                f"checks: {names[column]} of trajectory {held.batch.index[row]} is stored "
                f"as {key} {stored[row, column]:.9g} and found as {found[row, column]:.9g}"
            )


def _again(held: Held, count: int, seed: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Simulate some of the trajectories again, where the engine is here in the same version.

    Returns:
        What is wrong, and what else there is to know.
    """
    told = held.attributes
    count = min(count, len(held))
    if not count or told["kind"] != "shard":
        return (), ()
    here = _version(told["engine"])
    if here != told["engine_version"]:
        note = f"not simulated again: {told['engine']} {told['engine_version']} is not here"
        return (), (note + (f", but {here}" if here else ""),)
    rng = np.random.default_rng([seed, told["first"]])
    rows = np.sort(rng.choice(len(held), count, replace=False)).tolist()
    made = simulate(held.scene, held.batch[rows], told["engine"], held.settings).trajectory
    return _compared(made, held.trajectory[rows], held.batch.index[rows], held.scene.length)


def _compared(
    made: Trajectory, stored: Trajectory, index: NDArray[np.int64], length: float
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Compare all states: the same bits, or what another processor's last digit may grow to.

    A difference that is there from the first frames on has not grown: it is no rounding.
    """
    problems, largest = [], 0.0
    for key in _STATE:
        new, old = getattr(made, key), getattr(stored, key)
        scale = length if key == "position" else max(1.0, float(np.abs(old).max(initial=0.0)))
        off = np.where(new == old, 0.0, np.abs(new - old) / scale).max(axis=(2, 3))
        off = np.where(np.isnan(off), np.inf, off)
        largest = max(largest, float(off.max()))
        allowed = np.where(np.arange(off.shape[1]) <= _EARLY, _SAME_AT_FIRST, _SAME_MOTION)
        for row in np.flatnonzero((off > allowed).any(axis=1))[:1]:
            frame = int(np.argmax(off[row] > allowed))
            problems.append(
                f"simulated again: {key} of trajectory {index[row]} differs by "
                f"{off[row, frame]:.2g} of its scale at frame {frame}"
            )
    same = "the same bits" if largest == 0.0 else f"within {largest:.1g} of their scale, rounding"
    return tuple(problems), () if problems else (f"{len(made)} simulated again: {same}",)


def _version(engine: str) -> str | None:
    try:
        return load_adapter(engine).version()
    except (EngineMissing, UnknownName):
        return None
