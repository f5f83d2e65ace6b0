"""Comparison of a model's file with engines' own readings of it, in data and in motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import EntryPoint
from operator import attrgetter
from pathlib import Path
from typing import Literal, TypeVar

import msgspec
import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError, check_name
from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.base.text import counted
from mbds_xsim.reference import solve
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Cell, Report, Row, row_of, table_of
from mbds_xsim.scene.imported import Imported, JointFacts, LinkFacts, ModelFacts
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mass import with_mass_properties
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Scene
from mbds_xsim.simulate.registry import read_model, registered

Loader = Callable[[Path, bool], ModelFacts]
"""Function of a file and whether its base floats; raises `InputError` if the engine refuses it."""

Part = Literal["links", "joints"]
T = TypeVar("T", LinkFacts, JointFacts)
_TIMEOUT = 300.0  # time limit of a reader [s]
_PATIENCE = 30.0  # time limit of a motion [s]
_SAME = 1e-6
"""Relative deviation that rounding to single precision explains."""
_FAR = 1e9
"""Limit that stands for none [rad or m]."""
_CLOCK = Clock(frame=0.02, steps=50)
_ROUNDED = 1e-6  # relative tolerance of masses and inertias in single precision
_STARTS = (1, 4, 7)  # indices of medium starts
_JOINT_FIELDS = ("damping", "friction", "stiffness", "armature")


class Difference(msgspec.Struct, frozen=True):
    """A field that a reader reads differently from the file."""

    field: str
    of: Part
    count: int
    """Number of links or joints with another value."""
    among: int
    """Number of links or joints that were compared."""
    first: str
    """Name of the first one with another value; empty for couplings and loops."""
    read: str
    """Value in the engine."""
    stated: str
    """Value in the file."""


class EngineReading(msgspec.Struct, frozen=True):
    """One engine's reading of a file."""

    engine: str
    refused: str
    """Reason why the engine refuses the file, or ""."""
    differences: tuple[Difference, ...]
    moved_m: float | None = None
    """RMS distance of the bodies after 1 s between the motion as read and that of the file [m];
    None if the file is refused, if loops or couplings are lost, or if no motion is found within
    half a minute."""

    @property
    def alike(self) -> bool:
        """Whether the engine reads the file without differences."""
        return not self.refused and not self.differences


class Readings(msgspec.Struct, frozen=True, tag_field="schema", tag="mbds-xsim/readers/1"):
    """Readings of one file by several engines."""

    file: str
    format: str
    floating: bool
    links: int
    joints: int
    readings: tuple[EngineReading, ...]


def compare(
    path: Path, engines: Sequence[str], *, folder: Path | None = None, floating: bool = False
) -> Readings:
    """Read a model, let engines read it, and list the differences.

    Args:
        path: File of the model.
        engines: Names of the engines.
        folder: Folder that must hold all files named in the model; None: the model's own.
        floating: Whether a base that the file attaches to nothing is free.

    Raises:
        InputError: The file cannot be read in its format, or an engine has no reader of its own.
    """
    imported = read_model(path, folder=folder, floating=floating)
    return compare_imported(imported, path, engines, floating=floating)


def compare_imported(
    imported: Imported, path: Path, engines: Sequence[str], *, floating: bool = False
) -> Readings:
    """Compare an imported model with engines' readings of its file, as in `compare`."""
    loaders = registered("mbds_xsim.model_loaders")
    for engine in engines:
        check_name("engine with a reader of its own", engine, sorted(loaders))
    tasks = [Task(_load, (loaders[name], path.absolute(), floating), _TIMEOUT) for name in engines]
    answers: dict[str, ModelFacts | str] = {
        engine: answer.reason if isinstance(answer, Crash) else answer
        for engine, answer in zip(engines, run_tasks(tasks), strict=True)
    }
    read = {engine: facts for engine, facts in answers.items() if isinstance(facts, ModelFacts)}
    differences = {engine: tuple(_differences(facts, imported)) for engine, facts in read.items()}
    others = [engine for engine in read if differences[engine]]
    motions = run_tasks([Task(divergence, (imported, read[name]), _PATIENCE) for name in others])
    moved = {
        engine: None if isinstance(motion, Crash) else motion
        for engine, motion in zip(others, motions, strict=True)
    }
    readings = tuple(
        EngineReading(engine, "", differences[engine], moved.get(engine, 0.0))
        if engine in read
        else EngineReading(engine, str(answer), ())
        for engine, answer in answers.items()
    )
    stated = imported.facts
    return Readings(
        imported.file, imported.format, floating, len(stated.links), len(stated.joints), readings
    )


def _load(point: EntryPoint, path: Path, floating: bool) -> ModelFacts:
    loader: Loader = point.load()
    return loader(path, floating)


def _differences(read: ModelFacts, imported: Imported) -> Iterator[Difference]:
    facts, length = imported.facts, imported.scene.length
    links = _pair_by_name(facts.links, read.links)
    yield from _missing("links", links)
    yield from _field("links", "mass", links, lambda link: link.mass)
    yield from _field("links", "centre of mass", links, lambda link: link.com, scale=length)
    yield from _field("links", "inertia", links, lambda link: link.inertia)
    joints = _pair_by_name(facts.joints, read.joints)
    joints = [pair for pair in joints if pair[0].kind != "free"]  # some readers have no such joint
    yield from _missing("joints", joints)
    turning = [pair for pair in joints if pair[1] is not None]
    kinds = [(a.name, b.kind, a.kind) for a, b in turning if b is not None and a.kind != b.kind]
    yield from _difference("kind", "joints", len(turning), kinds)
    yield from _field("joints", "anchor", turning, lambda joint: joint.anchor, scale=length)
    yield from _field("joints", "axis", turning, lambda joint: joint.axis)
    for name in _JOINT_FIELDS:
        yield from _field("joints", name, turning, attrgetter(name))
    yield from _field("joints", "limits", turning, lambda joint: _sides(joint.limits or ()))
    limited = [pair for pair in turning if _sides(pair[0].limits or ())]
    yield from _field("joints", "enforcement of limits", limited, lambda j: float(j.enforced))
    for field, stated, kept, words in (
        ("coupling", facts.couplings, read.couplings, "follows another"),
        ("loop", facts.loops, read.loops, "closes it"),
    ):
        if stated > kept:
            yield Difference(field, "joints", stated - kept, stated, "", "none", words)


def _pair_by_name(stated: Sequence[T], read: Sequence[T]) -> list[tuple[T, T | None]]:
    by_name = {item.name: item for item in read}
    return [(item, by_name.get(item.name)) for item in stated]


def _missing(of: Part, pairs: list[tuple[T, T | None]]) -> Iterator[Difference]:
    wrong = [(item.name, "nothing", "there") for item, read in pairs if read is None]
    yield from _difference("existence", of, len(pairs), wrong)


def _field(
    of: Part,
    name: str,
    pairs: list[tuple[T, T | None]],
    value: Callable[[T], float | Sequence[float]],
    *,
    scale: float = 0.0,
) -> Iterator[Difference]:
    """Compare a field; `scale` widens the tolerance of positions, which depend on the origin."""
    wrong, there = [], [(item, read) for item, read in pairs if read is not None]
    for item, read in there:
        ours, theirs = np.atleast_1d(value(item)), np.atleast_1d(value(read))
        if not _same(ours, theirs, scale):
            has, says = _texts(theirs, ours)
            wrong.append((item.name, has, says))
    yield from _difference(name, of, len(there), wrong)


def _same(ours: Array, theirs: Array, scale: float) -> bool:
    if ours.shape != theirs.shape:
        return False
    compared = ~(np.isinf(ours) & (ours == theirs))
    bound = _SAME * (scale + float(np.linalg.norm(ours[np.isfinite(ours)])))
    return bool(np.linalg.norm(ours[compared] - theirs[compared]) <= bound)


def _sides(limits: Sequence[float]) -> list[float]:
    """Return limits with ±inf for a side that no joint reaches; none if it reaches neither."""
    sides = [side if abs(side) < _FAR else math.copysign(math.inf, side) for side in limits]
    return sides if any(map(math.isfinite, sides)) else []


def _difference(
    field: str, of: Part, among: int, wrong: list[tuple[str, str, str]]
) -> Iterator[Difference]:
    """Yield the difference of a field: name, reading and statement of the first that is wrong."""
    if wrong:
        yield Difference(field, of, len(wrong), among, *wrong[0])


def _texts(theirs: Array, ours: Array) -> tuple[str, str]:
    """Write both with so many digits that they differ."""
    for digits in range(4, 18):
        read, stated = (
            " ".join(f"{value:.{digits}g}" for value in values) or "none"
            for values in (theirs, ours)
        )
        if read != stated:
            break
    return read, stated


_COLUMNS = ("engine", "field", ">wrong", ">of", "for one", "engine has", "file says")
_TITLE = "what engines' own readers make of it"


def present(readings: Readings, command: str) -> Report:
    """Report how each engine reads a file."""
    wrong = [reading.engine for reading in readings.readings if not reading.alike]
    right = [reading.engine for reading in readings.readings if reading.alike]
    rows = (row for reading in readings.readings for row in _rows(reading))
    return Report(
        title=readings.file,
        what="read alike by all engines" if not wrong else "read otherwise",
        description=f"{readings.format}: {counted(readings.links, 'link')} that can move, "
        f"{counted(readings.joints, 'joint')}",
        conclusion=f"as the file says: {', '.join(right) or 'no engine'}; "
        f"otherwise: {', '.join(wrong) or 'none'}",
        blocks=(table_of(_COLUMNS, rows, title=_TITLE, grouped=True),),
        command=command,
        verdict="fail" if wrong else "pass",
    )


def _rows(reading: EngineReading) -> Iterator[Row]:
    engine = Cell(reading.engine, "pass" if reading.alike else "fail")
    if reading.refused:
        yield row_of((engine, "", "", "", "", f"refuses: {reading.refused}", ""), "fail")
        return
    if reading.alike:
        yield row_of((engine, "", "0", "", "", "all that the file says", ""))
        return
    for each in reading.differences:
        field, count = f"{each.field} of {each.of}", str(each.count)
        yield row_of((engine, field, count, str(each.among), each.first, each.read, each.stated))
    gone = "none" if reading.moved_m is None else f"{quantity.length(reading.moved_m)} off"
    yield row_of((engine, "motion after 1 s", "", "", "", gone, ""))


def divergence(imported: Imported, read: ModelFacts) -> float | None:
    """Compare the motion of a model as read with that of its file, from the same starts.

    Masses, centres of mass and inertias, and the joints' anchors, axes, damping, friction,
    stiffness and armature are those that were read; everything else is as the file says.

    Returns:
        RMS distance after 1 s [m] of the points that are the bodies' centres of mass in the file;
        None if one of the models has no motion, for example because bodies lack inertia, or if
        loops or couplings are lost, as then the two have no starts in common.
    """
    if read.loops < imported.facts.loops or read.couplings < imported.facts.couplings:
        return None
    stated = msgspec.structs.replace(imported.scene, clock=_CLOCK)
    try:
        other = _scene_of(stated, imported, read)
        points = Mechanism.of(stated).com
        ends = [_ends(scene, points) for scene in (stated, other)]
    except InputError:
        return None
    off = float(np.sqrt(np.mean(np.sum((ends[1] - ends[0]) ** 2, axis=-1))))
    return off if np.isfinite(off) else None  # NaN if a solution ends early


def _scene_of(scene: Scene, imported: Imported, read: ModelFacts) -> Scene:
    links = {link.name: link for link in read.links}
    by_body: dict[str, list[LinkFacts]] = {}
    deviating = set()
    for link in imported.facts.links:
        counterpart = links.get(link.name, link)
        by_body.setdefault(link.body, []).append(counterpart)
        if not _alike(counterpart, link):
            deviating.add(link.body)
    joints = {joint.name: joint for joint in read.joints}
    placed = [
        msgspec.structs.replace(
            joint,
            anchor=tuple(own_joint.anchor),
            axis=tuple(own_joint.axis),
            **{name: getattr(own_joint, name) for name in _JOINT_FIELDS},
        )
        if (own_joint := joints.get(joint.name)) and joint.axis and any(own_joint.axis)
        else joint
        for joint in scene.joints
    ]
    bodies = [_with_mass_of(b, by_body[b.name]) if b.name in deviating else b for b in scene.bodies]
    return msgspec.structs.replace(scene, bodies=tuple(bodies), joints=tuple(placed))


def _alike(read: LinkFacts, stated: LinkFacts) -> bool:
    first, second = (np.array([link.mass, *link.com, *link.inertia]) for link in (read, stated))
    return bool(np.allclose(first, second, rtol=_ROUNDED, atol=_ROUNDED * np.abs(second).max()))


def _with_mass_of(body: Body, links: list[LinkFacts]) -> Body:
    """Give a body the summed inertia of its links; if their mass is zero it stays as it is."""
    mass = sum(link.mass for link in links)
    if not mass > 0:
        return body
    com = np.asarray(sum(link.mass * np.array(link.com) for link in links) / mass)
    tensor = np.zeros((3, 3))
    for link in links:
        arm = np.array(link.com) - com
        tensor += link.tensor + link.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return with_mass_properties(body, mass, com, tensor)


def _ends(scene: Scene, points: Array) -> Array:
    """Solve a scene and return the final positions of points of its bodies.

    Args:
        scene: Scene to solve.
        points: One point of each body, in W at the reference pose [m], shape (body, 3).

    Returns:
        Positions in W [m], shape (start, body, 3).
    """
    mechanism = Mechanism.of(scene)
    motion = solve(scene, draw_batch(scene, _STARTS), rtol=1e-9)
    last = BodyStates.of(mechanism, motion)[:, -1]
    return last.points(np.arange(len(points)), points - mechanism.com)
