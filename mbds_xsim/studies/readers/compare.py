"""What engines' own readers make of a model: compared with what its file says, and as a report."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal, TypeVar

import msgspec
import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.text import counted
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Cell, Report, Row, Table, columns_of
from mbds_xsim.scene.imported import Imported, JointFacts, LinkFacts, ModelFacts
from mbds_xsim.simulate.models import engine_facts, read_model
from mbds_xsim.studies.readers.motion import moved

T = TypeVar("T", LinkFacts, JointFacts)
_SAME = 1e-6
"""Deviation that rounding to single precision explains, over what is compared."""
_JOINT_FIELDS = ("damping", "friction", "stiffness", "armature")


class Difference(msgspec.Struct, frozen=True):
    """A field that a reader has otherwise."""

    field: str
    of: Literal["links", "joints"]
    count: int
    """Links or joints with another value."""
    among: int
    """All those that the file has."""
    first: str
    """Name of the first of them."""
    read: str
    """What the engine has there."""
    stated: str
    """What the file says."""


class Reading(msgspec.Struct, frozen=True):
    """What one engine makes of a file."""

    engine: str
    refused: str
    """Why it does not read the file, or ""."""
    differences: tuple[Difference, ...]
    moved_m: float | None = None
    """RMS distance of the bodies after 1 s from where the file has them go [m]; None where what was
    read has no motion."""

    @property
    def alike(self) -> bool:
        """Whether it reads what the file says."""
        return not self.refused and not self.differences


class Readings(msgspec.Struct, frozen=True, tag_field="schema", tag="mbds-xsim/readers/1"):
    """What engines make of a file."""

    file: str
    format: str
    floating: bool
    links: int
    joints: int
    readings: tuple[Reading, ...]


def compare(
    path: Path, engines: Sequence[str], *, folder: Path | None = None, floating: bool = False
) -> Readings:
    """Read a model, let engines read it, and list what they have otherwise.

    Args:
        path: Of the file.
        engines: Names.
        folder: That files named in the model must lie in.
        floating: Whether a base that the file ties to nothing is free.

    Raises:
        InputError: The file cannot be read as its format says.
    """
    imported = read_model(path, folder=folder, floating=floating)
    return compared(imported, path, engines, floating=floating)


def compared(
    imported: Imported, path: Path, engines: Sequence[str], *, floating: bool = False
) -> Readings:
    """Let engines read the file of a model that was imported, as in `compare`."""
    answers = engine_facts(path, engines, floating=floating)
    readings = tuple(_reading(engine, facts, imported) for engine, facts in answers.items())
    said = imported.facts
    return Readings(
        imported.file, imported.format, floating, len(said.links), len(said.joints), readings
    )


def _reading(engine: str, facts: ModelFacts | str, imported: Imported) -> Reading:
    if isinstance(facts, str):
        return Reading(engine, facts, ())
    found = tuple(_differences(facts, imported))
    return Reading(engine, "", found, moved(imported, facts) if found else 0.0)


def _differences(read: ModelFacts, imported: Imported) -> Iterator[Difference]:
    said, length = imported.facts, imported.scene.length
    links = _paired(said.links, read.links)
    yield from _missing("links", links)
    yield from _field("links", "mass", links, lambda link: [link.mass])
    yield from _field("links", "centre of mass", links, lambda link: link.com, scale=length)
    yield from _field("links", "inertia", links, lambda link: link.inertia)
    joints = _paired(said.joints, read.joints)
    joints = [pair for pair in joints if pair[0].kind != "free"]  # to some readers it is none
    yield from _missing("joints", joints)
    turning = [pair for pair in joints if pair[1] is not None]
    yield from _kinds(turning)
    yield from _field("joints", "anchor", turning, lambda joint: joint.anchor, scale=length)
    yield from _field("joints", "axis", turning, lambda joint: joint.axis)
    for name in _JOINT_FIELDS:
        yield from _field("joints", name, turning, _single(name))
    yield from _field("joints", "limits", turning, lambda joint: joint.limits or ())
    limited = [pair for pair in turning if pair[0].limits]
    yield from _field("joints", "enforcement of limits", limited, lambda j: [float(j.enforced)])
    if said.couplings > read.couplings:
        count = said.couplings - read.couplings
        yield Difference("coupling", "joints", count, said.couplings, "", "none", "follows another")


def _paired(said: Sequence[T], read: Sequence[T]) -> list[tuple[T, T | None]]:
    by_name = {item.name: item for item in read}
    return [(item, by_name.get(item.name)) for item in said]


def _missing(
    of: Literal["links", "joints"], pairs: list[tuple[T, T | None]]
) -> Iterator[Difference]:
    lost = [said.name for said, read in pairs if read is None]
    if lost:
        yield Difference("existence", of, len(lost), len(pairs), lost[0], "nothing", "there")


def _kinds(pairs: list[tuple[JointFacts, JointFacts | None]]) -> Iterator[Difference]:
    found = [(a, b) for a, b in pairs if b is not None and a.kind != b.kind]
    if found:
        said, read = found[0]
        yield Difference("kind", "joints", len(found), len(pairs), said.name, read.kind, said.kind)


def _field(
    of: Literal["links", "joints"],
    name: str,
    pairs: list[tuple[T, T | None]],
    value: Callable[[T], Sequence[float]],
    *,
    scale: float = 0.0,
) -> Iterator[Difference]:
    """Compare a field; `scale` is added to what the file says, for lengths from an origin."""
    found = []
    for said, read in pairs:
        if read is None:
            continue
        ours, theirs = np.array(value(said)), np.array(value(read))
        bound = _SAME * (scale + float(np.linalg.norm(ours)))
        if ours.shape != theirs.shape or np.linalg.norm(ours - theirs) > bound:
            found.append((said.name, theirs, ours))
    if found:
        first, theirs, ours = found[0]
        yield Difference(name, of, len(found), len(pairs), first, _shown(theirs), _shown(ours))


def _single(name: str) -> Callable[[JointFacts], Sequence[float]]:
    return lambda joint: [getattr(joint, name)]


def _shown(values: Array) -> str:
    return " ".join(f"{value:.4g}" for value in values) or "none"


def present(readings: Readings, command: str) -> Report:
    """Say what each engine makes of a file.

    Args:
        readings: Of the engines.
        command: That made them.
    """
    wrong = [reading.engine for reading in readings.readings if not reading.alike]
    right = [reading.engine for reading in readings.readings if reading.alike]
    return Report(
        title=readings.file,
        what="read alike by all engines" if not wrong else "read otherwise",
        description=f"{readings.format}: {counted(readings.links, 'link')} that can move, "
        f"{counted(readings.joints, 'joint')}",
        conclusion=f"as the file says: {', '.join(right) or 'no engine'}; "
        f"otherwise: {', '.join(wrong) or 'none'}",
        blocks=(_table(readings),),
        command=command,
        verdict="fail" if wrong else "pass",
    )


def _table(readings: Readings) -> Table:
    columns = columns_of("engine", "field", ">wrong", ">of", "for one", "engine has", "file says")
    rows = [row for reading in readings.readings for row in _rows(reading)]
    return Table(columns, tuple(rows), "what engines' own readers make of it", grouped=True)


def _rows(reading: Reading) -> list[Row]:
    if reading.refused:
        cells = (reading.engine, "", "", "", "", f"refuses: {reading.refused}", "")
        return [Row((Cell(reading.engine, "fail"), *map(Cell, cells[1:])), "fail")]
    if reading.alike:
        rest = map(Cell, ("", "0", "", "", "all that the file says", ""))
        return [Row((Cell(reading.engine, "pass"), *rest))]
    rows = [_row(reading.engine, difference) for difference in reading.differences]
    gone = "none" if reading.moved_m is None else f"{quantity.length(reading.moved_m)} off"
    end = map(Cell, ("motion after 1 s", "", "", "", gone, ""))
    return [*rows, Row((Cell(reading.engine, "fail"), *end))]


def _row(engine: str, difference: Difference) -> Row:
    cells = (
        f"{difference.field} of {difference.of}",
        str(difference.count),
        str(difference.among),
        difference.first,
        difference.read,
        difference.stated,
    )
    return Row((Cell(engine, "fail"), *map(Cell, cells)))
