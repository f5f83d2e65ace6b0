"""Check a file of trajectories again, from its own contents alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.base.errors import EngineMissing, InputError, UnknownName
from mbds_xsim.base.versions import CHECKS
from mbds_xsim.dataset.gate import COLUMNS, TOGETHER, CheckTable, Making, judge_rows
from mbds_xsim.dataset.hdf5 import attributes_of, misfits, open_hdf5, scene_of
from mbds_xsim.dataset.layout import MOTION
from mbds_xsim.dataset.read import Dataset, load_dataset
from mbds_xsim.dataset.shard import derived
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.state import STATES, Trajectory
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.claims import Method
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.simulate.timed import simulate

_SAME_DRAW = 1e-12  # relative; what another processor's sine may differ by
_SAME_FIGURE = 1e-6  # of the figure, or of what is allowed
_SOURCES = {"interval": "index mod 3", "time": "that of the scene's frames"}
_ROUNDED = 2.0**-23  # of float32, relative: the nearest of two neighbours
_SAME_MOTION = 1e-6  # of a state's scale; rounding that chaos has amplified
_SAME_AT_FIRST = 1e-10  # the same, up to the frame _EARLY
_EARLY = 5


@dataclass
class FileReport:
    """What became of one file."""

    file: str
    kind: str
    trajectories: int = 0
    problems: list[str] = field(default_factory=list)
    """What is wrong; nothing: it holds what it says."""
    notes: list[str] = field(default_factory=list)
    """What else there is to know."""


def reaudit(path: Path, report: FileReport, resimulated: int, seed: int) -> None:
    """Check layout, numbers, draws, points and every check of a shard, or of rejected trajectories.

    Some, chosen by the seed, are simulated again, if the engine is here. The report is added to.
    """
    attributes = attributes_of(path)
    scene, report.kind = scene_of(attributes["scene"], path), attributes["kind"]
    with open_hdf5(path) as file:
        report.problems += misfits(file, report.kind, scene)
    if report.problems:
        return
    data = load_dataset(path)
    report.problems += _numbers(data)
    if len(data):  # all of a shard may have been rejected
        for check in (_derived, _orientations, _checks):
            report.problems += check(data)
    if not _same_checks(data):
        report.notes.append(
            f"figures of checks of version {data.attributes['checks_version']} not compared, here "
            f"is {CHECKS}; judged anew"
        )
    if report.kind == "shard" and min(resimulated, len(data)):
        _simulate_again(data, report, min(resimulated, len(data)), seed)
    report.trajectories = len(data)


def _numbers(data: Dataset) -> Iterator[str]:
    """The numbering of the trajectories, and what repeats what the scene says."""
    attrs, index = data.attributes, data.index
    first, count = attrs["first"], attrs["count"]
    if len(index) and (
        index[0] < first or index[-1] >= first + count or (np.diff(index) < 1).any()
    ):
        yield f"index: not ascending from {first} to {first + count - 1}"
    own = "published" if attrs["kind"] == "shard" else "rejected"
    if attrs[own] != len(index) or attrs["published"] + attrs["rejected"] != count:
        yield f"counts: {own} is {attrs[own]} with {len(index)} trajectories of {count} here"
    scene, clock = data.scene, data.scene.clock
    if (attrs["steps"], attrs["frame_s"]) != (clock.steps, clock.frame):
        yield "clock: steps and frame_s are not the scene's"
    if (attrs["scene_name"], attrs["dimension"]) != (scene.name, scene.dimension):
        yield "scene_name and dimension are not the scene's"
    if (attrs["certification"] == "certified") != (attrs["profile"] == "matched"):
        yield f"certification: {attrs['certification']} at settings called {attrs['profile']}"


def _derived(data: Dataset) -> Iterator[str]:
    """Whatever follows from the scene, from seed and index, and from the states of the bodies.

    Starts and inputs must be those of seed and index: so engines are paired.
    """
    attrs, scene = data.attributes, data.scene
    drawn = draw_batch(scene, data.index.tolist(), seed=attrs["seed"], noise=attrs["noise"])
    frames = scene.clock.frame * np.arange(scene.clock.steps + 1, dtype=np.float64)
    motion = dataclasses.replace(data.trajectory(), time=frames)
    for name, wanted in derived(scene, drawn, motion, attrs["seed"]).items():
        off = _off(data[name][:], wanted) if name in data else np.zeros(0, dtype=bool)
        if not off.any():
            continue
        group, _, key = name.rpartition("/")
        if group in ("start", "input"):
            yield f"pairing: {key} is not what seed {attrs['seed']} and index give"
        elif name in MOTION:
            row = np.argwhere(off)[0][0]
            yield f"{name}: not that of the bodies, first of trajectory {data.index[row]}"
        else:
            yield f"{name}: not {_SOURCES.get(name, 'that of the scene')}"


def _off(got: NDArray[Any], wanted: NDArray[Any]) -> NDArray[np.bool_]:
    """Where values are others, but for rounding and what another processor's sine may do."""
    if got.dtype.kind != "f":
        return np.asarray(got != wanted)
    near = _SAME_DRAW * max(1.0, float(np.abs(wanted).max(initial=0.0)))
    allowed = _ROUNDED * np.abs(wanted) + 1e-14 if got.dtype == np.float32 else near
    same = (got == wanted) | (np.abs(got - wanted) <= allowed)
    return np.asarray(~(same | (np.isnan(got) & np.isnan(wanted))))


def _orientations(data: Dataset) -> Iterator[str]:
    """Quaternions must go on with the sign that they have at the start."""
    given = data["body/orientation"][:]
    turned = rotation.continuous(given, data["start/orientation"][:])
    off = (turned != given) & np.isfinite(given)
    for row, frame in zip(*np.nonzero(off.any(axis=(2, 3))), strict=True):
        yield (
            f"body/orientation: changes its sign at frame {frame} of trajectory "
            f"{data.index[row]}; what is learned from it would see a jump"
        )
        return


def _checks(data: Dataset) -> Iterator[str]:
    """Every check must find what it found, and the verdict be what it was.

    Checks that are newer than the file were not measured then; they judge all the same. The figures
    of an older version may be others, and so may what it rejected.
    """
    if not set(data["check/name"][:].tolist()) <= set(COLUMNS):
        yield "checks: another version's; install the version that the file names"
        return
    verdict = judge_rows(data.scene, data.batch(), data.trajectory(), making_of(data))
    if _same_checks(data):
        yield from _figures(data, verdict)
    passed = verdict.published(certified=data.attributes["certification"] == "certified")
    if data.attributes["kind"] == "shard":
        for row in np.flatnonzero(~passed):
            yield f"published trajectory {data.index[row]} fails: {verdict.reason(int(row))}"
    elif _same_checks(data):
        of_all = ("read-back", TOGETHER)
        misbuilt = np.array([text.startswith(of_all) for text in data["reason"][:]])
        for row in np.flatnonzero(passed & ~misbuilt):
            yield f"rejected trajectory {data.index[row]} passes every check"


def _same_checks(data: Dataset) -> bool:
    return bool(data.attributes["checks_version"] == CHECKS)


def _figures(data: Dataset, verdict: CheckTable) -> Iterator[str]:
    names = data["check/name"][:].tolist()
    if data["check/unit"][:].tolist() != [COLUMNS[name] for name in names]:
        yield "check/unit: not those of the checks"
    columns = [list(COLUMNS).index(name) for name in names]
    allowed = verdict.allowed[:, columns]
    for key in ("figure", "allowed"):
        stored, found = data[f"check/{key}"][:], getattr(verdict, key)[:, columns]
        scale = np.fmax(np.abs(stored), np.where(np.isfinite(found), np.abs(found), 0.0))
        scale = np.fmax(scale, np.where(np.isfinite(allowed), allowed, 0.0))
        same = (stored == found) | (np.abs(stored - found) <= _SAME_FIGURE * scale)
        # A check may not apply to any of the trajectories left, and so to none.
        same |= np.isnan(stored) | np.isnan(found)
        for row, column in np.argwhere(~same)[:3]:
            yield (
                f"checks: {names[column]} of trajectory {data.index[row]} is stored "
                f"as {key} {stored[row, column]:.9g} and found as {found[row, column]:.9g}"
            )


def making_of(data: Dataset) -> Making:
    """Give what a file says of how it was made.

    The file has the order that the method reached in this scene. Friction, stops and saturated
    servos lower that of fixed steps; a file with a higher one is of a method that adapts its steps.
    """
    attrs = data.attributes
    method = Method(
        name=attrs["method"],
        family=attrs["method_family"],
        order=attrs["method_order"],
        velocity_lag=attrs["velocity_lag_s"] / attrs["step_s"],
        single=attrs["single_precision"],
    )
    adaptive = method.order > method.order_for(data.scene)
    method = dataclasses.replace(method, adaptive=adaptive)
    return Making(method, attrs["step_s"], attrs["contact_time_s"])


def _settings(data: Dataset) -> Settings:
    """Give the settings to make it again."""
    attrs = data.attributes
    try:
        options = msgspec.json.decode(attrs["options"], type=dict[str, Any])
    except (msgspec.DecodeError, UnicodeError) as error:
        msg = f"{data.path}: attribute options: got {attrs['options']!r}: {error}"
        raise InputError(msg) from error
    return Settings(attrs["method"], attrs["step_s"], options)


def _simulate_again(data: Dataset, report: FileReport, count: int, seed: int) -> None:
    """Simulate some of the trajectories again, where the engine is here in the same version."""
    attrs = data.attributes
    here = _version(attrs["engine"])
    if here != attrs["engine_version"]:
        note = f"not simulated again: {attrs['engine']} {attrs['engine_version']} is not here"
        report.notes.append(note + (f", but {here}" if here else ""))
        return
    rng = np.random.default_rng([seed, attrs["first"]])
    rows = np.sort(rng.choice(len(data), count, replace=False)).tolist()
    made = simulate(data.scene, data.batch(rows), attrs["engine"], _settings(data)).trajectory
    _compare(made, data.trajectory(rows), data.index[rows], data.scene.length, report)


def _compare(
    made: Trajectory,
    stored: Trajectory,
    index: NDArray[np.int64],
    length: float,
    report: FileReport,
) -> None:
    """Compare all states: the same bits, or what another processor's last digit may grow to.

    A difference that is there from the first frames on has not grown: it is no rounding.
    """
    largest, differing = 0.0, False
    for key in STATES:
        new, old = getattr(made, key), getattr(stored, key)
        scale = length if key == "position" else max(1.0, float(np.abs(old).max(initial=0.0)))
        off = np.where(new == old, 0.0, np.abs(new - old) / scale).max(axis=(2, 3))
        off = np.where(np.isnan(off), np.inf, off)
        largest = max(largest, float(off.max()))
        allowed = np.where(np.arange(off.shape[1]) <= _EARLY, _SAME_AT_FIRST, _SAME_MOTION)
        for row in np.flatnonzero((off > allowed).any(axis=1))[:1]:
            frame, differing = int(np.argmax(off[row] > allowed)), True
            report.problems.append(
                f"simulated again: {key} of trajectory {index[row]} differs by "
                f"{off[row, frame]:.2g} of its scale at frame {frame}"
            )
    same = "the same bits" if largest == 0.0 else f"within {largest:.1g} of their scale, rounding"
    if not differing:
        report.notes.append(f"{len(made)} simulated again: {same}")


def _version(engine: str) -> str | None:
    try:
        return load_adapter(engine).version()
    except (EngineMissing, UnknownName):
        return None
