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

_SAME_DRAW = 1e-12  # relative; sines of two processors may differ by as much
_SAME_FIGURE = 1e-6  # relative to the figure or to its limit
_SOURCES = {"interval": "index mod 3", "time": "that of the scene's frames"}
_ROUNDED = 2.0**-23  # spacing of float32, relative: either neighbour may be stored
_SAME_MOTION = 1e-6  # relative to a state's scale; rounding that chaos has amplified
_SAME_AT_FIRST = 1e-10  # the same, up to frame _EARLY
_EARLY = 5


@dataclass
class FileReport:
    """Report on one file."""

    file: str
    kind: str
    trajectories: int = 0
    problems: list[str] = field(default_factory=list)
    """Faults; empty if the file is sound."""
    notes: list[str] = field(default_factory=list)
    """Remarks that are not faults."""


def reaudit(path: Path, report: FileReport, resimulated: int, seed: int) -> None:
    """Check a shard or a file of rejected trajectories: layout, numbers, draws, points, all checks.

    Some trajectories of a shard, chosen by the seed, are simulated again if the engine is
    installed. Findings are added to the report.
    """
    attributes = attributes_of(path)
    scene, report.kind = scene_of(attributes["scene"], path), attributes["kind"]
    with open_hdf5(path) as file:
        report.problems += misfits(file, report.kind, scene)
    if report.problems:
        return
    data = load_dataset(path)
    report.problems += _numbers(data)
    if len(data):  # all trajectories of a shard may have been rejected
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
    """Yield faults in the numbering, the counts, and the attributes that repeat the scene."""
    attrs, index = data.attributes, data.index
    first, count = attrs["first"], attrs["count"]
    if len(index) and (
        index[0] < first or index[-1] >= first + count or (np.diff(index) < 1).any()
    ):
        yield f"index: not ascending from {first} to {first + count - 1}"
    own = "published" if attrs["kind"] == "shard" else "rejected"
    if attrs[own] != len(index) or attrs["published"] + attrs["rejected"] != count:
        yield f"counts: {own} is {attrs[own]}, but {len(index)} of {count} trajectories are here"
    scene, clock = data.scene, data.scene.clock
    if (attrs["steps"], attrs["frame_s"]) != (clock.steps, clock.frame):
        yield "clock: steps and frame_s are not the scene's"
    if (attrs["scene_name"], attrs["dimension"]) != (scene.name, scene.dimension):
        yield "scene_name and dimension are not the scene's"
    if (attrs["certification"] == "certified") != (attrs["profile"] == "matched"):
        yield f"certification: {attrs['certification']} at settings called {attrs['profile']}"


def _derived(data: Dataset) -> Iterator[str]:
    """Yield faults in data that follow from the scene, seed and index, or states of the bodies.

    Starts and inputs must be those of seed and index, since these pair the engines.
    """
    attrs, scene = data.attributes, data.scene
    drawn = draw_batch(scene, data.index.tolist(), seed=attrs["seed"], noise=attrs["noise"])
    frames = scene.clock.frame * np.arange(scene.clock.steps + 1, dtype=np.float64)
    motion = dataclasses.replace(data.trajectory(), time=frames)
    for name, wanted in derived(scene, drawn, motion, attrs["seed"]).items():
        deviating = _off(data[name][:], wanted) if name in data else np.zeros(0, dtype=bool)
        if not deviating.any():
            continue
        group, _, key = name.rpartition("/")
        if group in ("start", "input"):
            yield f"pairing: {key} is not what seed {attrs['seed']} and index give"
        elif name in MOTION:
            row = np.argwhere(deviating)[0][0]
            yield f"{name}: not that of the bodies, first of trajectory {data.index[row]}"
        else:
            yield f"{name}: not {_SOURCES.get(name, 'that of the scene')}"


def _off(got: NDArray[Any], wanted: NDArray[Any]) -> NDArray[np.bool_]:
    """Mark values that differ by more than rounding and another processor's sine explain."""
    if got.dtype.kind != "f":
        return np.asarray(got != wanted)
    near = _SAME_DRAW * max(1.0, float(np.abs(wanted).max(initial=0.0)))
    allowed = _ROUNDED * np.abs(wanted) + 1e-14 if got.dtype == np.float32 else near
    with np.errstate(over="ignore", invalid="ignore"):  # of motions that blew up
        same = (got == wanted.astype(got.dtype)) | (np.abs(got - wanted) <= allowed)
    return np.asarray(~(same | (np.isnan(got) & np.isnan(wanted))))


def _orientations(data: Dataset) -> Iterator[str]:
    """Yield the first change of sign of a quaternion, from the start or from frame to frame."""
    orientation = data["body/orientation"][:]
    continuous = rotation.continuous(orientation, data["start/orientation"][:])
    flipped = (continuous != orientation) & np.isfinite(orientation)
    for row, frame in zip(*np.nonzero(flipped.any(axis=(2, 3))), strict=True):
        yield (
            f"body/orientation: changes its sign at frame {frame} of trajectory "
            f"{data.index[row]}; a model trained on it would see a jump"
        )
        return


def _checks(data: Dataset) -> Iterator[str]:
    """Repeat every check; yield differences from the stored figures and verdicts.

    Checks that are newer than the file have no figures in it, but they judge all the same. Figures
    and rejections of an older version are not compared, since they may differ.
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
        stored, computed = data[f"check/{key}"][:], getattr(verdict, key)[:, columns]
        scale = np.fmax(np.abs(stored), np.where(np.isfinite(computed), np.abs(computed), 0.0))
        scale = np.fmax(scale, np.where(np.isfinite(allowed), allowed, 0.0))
        same = (stored == computed) | (np.abs(stored - computed) <= _SAME_FIGURE * scale)
        # A check may apply to none of the trajectories that are left after rejection.
        same |= np.isnan(stored) | np.isnan(computed)
        for row, column in np.argwhere(~same)[:3]:
            yield (
                f"checks: {names[column]} of trajectory {data.index[row]} is stored "
                f"as {key} {stored[row, column]:.9g} and found as {computed[row, column]:.9g}"
            )


def making_of(data: Dataset) -> Making:
    """Return the facts in a file about how its trajectories were made.

    The file has the order that the method reached in this scene. Friction, stops and saturated
    servos lower the order at fixed steps; if the file's is higher, the method adapts its steps.
    """
    attrs = data.attributes
    method = Method(
        name=attrs["method"],
        family=attrs["method_family"],
        order=attrs["method_order"],
        velocity_lag=attrs["velocity_lag_s"] / attrs["step_s"],
        single=attrs["single_precision"],
    )
    method = dataclasses.replace(method, adaptive=method.order > method.order_for(data.scene))
    return Making(method, attrs["step_s"], attrs["contact_time_s"])


def _settings(data: Dataset) -> Settings:
    """Return the settings to simulate the trajectories again."""
    attrs = data.attributes
    try:
        options = msgspec.json.decode(attrs["options"], type=dict[str, Any])
    except (msgspec.DecodeError, UnicodeError) as error:
        msg = f"{data.path}: attribute options: got {attrs['options']!r}: {error}"
        raise InputError(msg) from error
    return Settings(attrs["method"], attrs["step_s"], options)


def _simulate_again(data: Dataset, report: FileReport, count: int, seed: int) -> None:
    """Simulate some trajectories again, if engine and adapter are those that made them."""
    attrs = data.attributes
    version, revision = _here(attrs["engine"])
    made_by = f"{attrs['engine']} {attrs['engine_version']}"
    if version != attrs["engine_version"]:
        note = f"not simulated again: {made_by} is not installed"
        report.notes.append(note + (f", but {version}" if version else ""))
        return
    if attrs["adapter_revision"] not in (0, revision):  # 0: unknown, in older files
        note = f"not simulated again: {made_by} was driven by revision {attrs['adapter_revision']}"
        report.notes.append(f"{note} of its adapter, here is {revision}")
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
    """Compare all states; differences may be as large as rounding on another processor can grow.

    A difference that is there from the first frames on has not grown: it is not rounding.
    """
    largest, differing = 0.0, False
    for key in STATES:
        new, old = getattr(made, key), getattr(stored, key)
        scale = length if key == "position" else max(1.0, float(np.abs(old).max(initial=0.0)))
        difference = np.where(new == old, 0.0, np.abs(new - old) / scale).max(axis=(2, 3))
        difference = np.where(np.isnan(difference), np.inf, difference)
        largest = max(largest, float(difference.max()))
        allowed = np.where(np.arange(difference.shape[1]) <= _EARLY, _SAME_AT_FIRST, _SAME_MOTION)
        for row in np.flatnonzero((difference > allowed).any(axis=1))[:1]:
            frame, differing = int(np.argmax(difference[row] > allowed)), True
            report.problems.append(
                f"simulated again: {key} of trajectory {index[row]} differs by "
                f"{difference[row, frame]:.2g} of its scale at frame {frame}"
            )
    same = "the same bits" if largest == 0.0 else f"within {largest:.1g} of their scale, rounding"
    if not differing:
        report.notes.append(f"{len(made)} simulated again: {same}")


def _here(engine: str) -> tuple[str | None, int]:
    """Return the version of an engine and the revision of its adapter; None if it is missing."""
    try:
        adapter = load_adapter(engine)
        return adapter.version(), adapter.revision
    except (EngineMissing, UnknownName, ImportError):  # the last for a package that is missing
        return None, 0
