"""Survey of published models: stored findings, a table of all models, and a page for each wheel."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from fnmatch import fnmatch
from importlib.metadata import version
from pathlib import Path

import msgspec

from benchmarks.harness import print_head, print_made, print_table
from benchmarks.validated_model import ENGINES
from mbds_xsim.base.files import write_whole
from mbds_xsim.base.text import counted, in_markdown
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Remarks, Report, Section
from mbds_xsim.report.files import to_markdown
from mbds_xsim.scene.imported import Fate
from mbds_xsim.studies.readers import Difference

READERS = ("mujoco", "pybullet", "dart")
"""Engines whose own readers are surveyed."""


class SurveyRow(msgspec.Struct, omit_defaults=True):
    """Findings about one model."""

    key: str
    package: str
    path: str
    format: str = ""
    refused: str = ""
    """Reason why it is not imported; empty if it is."""
    bodies: int = 0
    degrees_of_freedom: int = 0
    kept: int = 0
    """Number of kept kinds of elements and attributes that affect the motion."""
    lost: tuple[Fate, ...] = ()
    """Other elements and attributes that affect the motion, without their places."""
    from_compiled: float | None = None
    """Largest relative deviation of masses, places and axes from MuJoCo's compiled model."""
    from_second: float | None = None
    """The same deviation from Pinocchio's reading of a URDF."""
    readers: dict[str, str] = {}
    """Results by engine: "alike", "refuses: …", or the fields that its reader reads differently."""
    differences: dict[str, tuple[Difference, ...]] = {}
    """Differences in these fields, by engine."""
    moved_m: dict[str, float] = {}
    """Distance of each engine's bodies from the motion of the file after 1 s [m]."""
    verdicts: dict[str, str] = {}
    """Verdicts by engine, as in `Verdicts`; empty if not validated."""
    reasons: dict[str, str] = {}
    """Reasons for not passing, by engine."""
    reference: str = ""
    """Reason why the reference ends early or is missing."""

    @property
    def place(self) -> str:
        """Package, folder and file of the model."""
        return in_markdown(f"{self.package}: {Path(self.path).parent.name}/{Path(self.path).name}")


def _what(fate: Fate) -> str:
    """Name an element, and its attribute if there is exactly one."""
    single = fate.properties if len(fate.properties) == 1 else ()
    return " ".join((fate.element, *single))


class Cause(msgspec.Struct):
    """Known cause of failed verdicts."""

    models: str
    """Shell pattern of the models' paths."""
    engine: str
    finding: str
    """Beginning of the verdict's reason; a cause does not outlive its finding."""
    why: str

    def explains(self, row: SurveyRow, engine: str) -> bool:
        """Return whether this is why a model does not pass in an engine."""
        matches = row.reasons.get(engine, "").startswith(self.finding)
        return matches and engine == self.engine and fnmatch(row.path, self.models)


def _known(causes: Iterable[Cause], row: SurveyRow, engine: str) -> str:
    """Return why a model does not pass in an engine, or "" if no cause is known."""
    return next((cause.why for cause in causes if cause.explains(row, engine)), "")


_HEAD = """\
Models in the wheels of pybullet (pybullet_data), dm_control, gymnasium, gymnasium-robotics and
example-robot-data that have joints, each imported, held against what two other readers make of it,
and read by three engines' own readers. Nothing was copied: the files are those of the wheels. The
name of a model leads to its section on its wheel's page.

*Deviation* is the largest difference of masses, centres of mass, inertias, axes and places of the
imported bodies and joints, over the model's own size, from MuJoCo's compiled model and from
Pinocchio's reading of URDF. What an engine has otherwise than the file says is what
`mbds-xsim readers MODEL` lists; see [what engines' own readers lose](../../docs/reader-losses.md).

*Verdicts* are on half a second of motion from three starts, at the engines' presets (`matched`,
without a search for better settings), with a minute of processor time for each engine and for the
reference. Verdicts are of an earlier run than the rest, of the same files and releases of engines.
"""


def print_page(rows: list[SurveyRow], causes: list[Cause]) -> None:
    """Print the survey: its totals, and one table of all models."""
    print_head("Models in the wild", "make reports-models-in-the-wild", _HEAD)
    read = [row for row in rows if not row.refused]
    print(f"{len(read)} of {len(rows)} files are imported.\n")
    print("## In short\n")
    print_table("what|>models", _summary(rows, read))
    print("\n## What is lost on import, by models\n")
    print_table("|element and attribute|>models", _losses_by_models(read))
    print("\n## Model by model\n")
    heads = "model|>dof|>lost|>deviation|>from Pinocchio|mujoco|pybullet|dart|runs in"
    print_table(heads, (_cells(row) for row in read))
    print("\n## Why models do not pass\n")
    print_table("model|engine|verdict|by|why", _failed(read, causes))
    print("\n## Not imported\n")
    refused = ((linked(row), in_markdown(row.refused)) for row in rows if row.refused)
    print_table("file|why", refused)
    print_made(f"mujoco {version('mujoco')}", f"dart {version('dartpy')}")


def _summary(rows: list[SurveyRow], read: list[SurveyRow]) -> Iterator[tuple[str, str]]:
    still = sum(row.refused.startswith("nothing in it moves") for row in rows)
    yield "files that are no part of another", str(len(rows))
    yield "of these with degrees of freedom", str(len(rows) - still)
    yield "imported", f"{len(read)} ({len(read) / max(len(rows) - still, 1):.0%})"
    yield "imported, nothing of the motion lost", str(sum(not row.lost for row in read))
    for name, key in (("MuJoCo's compiled model", "from_compiled"), ("Pinocchio", "from_second")):
        deviations = [value for row in read if (value := getattr(row, key)) is not None]
        near = sum(value <= 1e-9 for value in deviations)
        yield f"as {name} has them to 1e-9 (of those that it reads)", f"{near} of {len(deviations)}"
    for engine in READERS:
        readings = [row.readers[engine] for row in read if engine in row.readers]
        alike = readings.count("alike")
        refused = sum(reading.startswith("refuses") for reading in readings)
        yield f"{engine}'s own reader: as the file says", f"{alike} of {len(readings)}"
        yield f"{engine}'s own reader: refuses the file", f"{refused} of {len(readings)}"
    all_alike = sum(set(row.readers.values()) == {"alike"} for row in read)
    yield "read alike by all three engines' own readers", f"{all_alike} of {len(read)}"
    ran = [row for row in read if row.verdicts]
    yield "validated so far, the smallest first", f"{len(ran)} of {len(read)}"
    if ran:
        judged = [row for row in ran if {*row.verdicts.values()} <= {"pass", "fail"}]
        both = sum(not row.reference for row in judged)
        share = f"{both} ({both / len(read):.0%} of all that are imported)"
        yield "run in all four engines, with a verdict against the reference", share
        passed = sum({*row.verdicts.values()} == {"pass"} for row in ran)
        yield "pass in all four engines", f"{passed} of {len(ran)}"
        for engine in ENGINES:
            counts = Counter(row.verdicts[engine] for row in ran)
            words = ", ".join(f"{count} {verdict}" for verdict, count in counts.most_common())
            yield f"validated in {engine}", words


def _losses_by_models(read: list[SurveyRow]) -> Iterator[tuple[str, str, str]]:
    """Yield dropped, then approximated elements and attributes, and the number of models."""
    losses = ((row.path, fate.outcome, _what(fate)) for row in read for fate in row.lost)
    found = dict.fromkeys(losses)  # a model counts once
    for outcome in ("dropped", "approximated"):
        counts = Counter(name for _, own, name in found if own == outcome)
        yield from ((outcome, name, str(count)) for name, count in counts.most_common())


def _cells(row: SurveyRow) -> tuple[str, ...]:
    lost = sum(fate.count for fate in row.lost)
    deviations = (
        "–" if value is None else f"{value:.0e}" for value in (row.from_compiled, row.from_second)
    )
    readers = (in_markdown(row.readers.get(engine, "–")) for engine in READERS)
    passed = [engine for engine, verdict in row.verdicts.items() if verdict == "pass"]
    runs = ", ".join(passed) or ("none" if row.verdicts else "–")
    return (linked(row), str(row.degrees_of_freedom), str(lost), *deviations, *readers, runs)


def _failed(read: list[SurveyRow], causes: list[Cause]) -> Iterator[tuple[str, ...]]:
    for row in read:
        if row.reference:
            yield row.place, "reference", "ends early", in_markdown(row.reference), ""
        for engine, reason in row.reasons.items():
            texts = in_markdown((reason, _known(causes, row, engine)))
            yield row.place, engine, row.verdicts[engine], *texts


_WHEEL = (
    "Model by model: what of it is lost on import, what engines' own readers have otherwise than "
    "the file says, and how it runs. models.md sums all wheels up and says how it was done"
)


def write_wheels(rows: Iterable[SurveyRow], causes: list[Cause], folder: Path) -> None:
    """Write the pages, each named after its wheel."""
    wheels: dict[str, list[SurveyRow]] = {}
    for row in rows:
        wheels.setdefault(row.package, []).append(row)
    for wheel, own in wheels.items():
        write_whole(folder / f"{wheel}.md", to_markdown([_page(wheel, own, causes)]).encode())


def linked(row: SurveyRow) -> str:
    """Return a link to a model's section, with the anchor that renderers give its heading."""
    anchor = re.sub(r"[^\w\- ]", "", _title(row).lower()).replace(" ", "-")
    return f"[{row.place}]({row.package}.md#{anchor})"


def _title(row: SurveyRow) -> str:
    """Return the path inside the wheel's own folder."""
    return row.path.partition(f"{row.package}/")[2] or row.path


def _page(wheel: str, rows: list[SurveyRow], causes: list[Cause]) -> Report:
    imported = sum(not row.refused for row in rows)
    sections = (Section(_title(row), (Remarks.of(_said(row, causes)),)) for row in rows)
    return Report(
        title=wheel,
        what=counted(len(rows), "model"),
        description=_WHEEL,
        conclusion=f"{imported} of {counted(len(rows), 'file')} imported",
        blocks=tuple(sections),
        command="make reports-models-in-the-wild",
    )


def _said(row: SurveyRow, causes: list[Cause]) -> Iterator[tuple[str, str]]:
    """Yield subjects, and a remark on each."""
    if row.refused:
        yield "not imported", row.refused
        return
    bodies = counted(row.bodies, "body", "bodies")
    degrees = counted(row.degrees_of_freedom, "degree of freedom", "degrees of freedom")
    yield "imported", f"{row.format}, {bodies}, {degrees}"
    yield from _losses(row)
    yield "deviation", _deviations(row)
    for engine in READERS:
        yield f"{engine}'s own reader", _reading(row, engine)
    yield from _verdicts(row, causes)


def _losses(row: SurveyRow) -> Iterator[tuple[str, str]]:
    if not row.kept:
        yield "kept and lost", "not run"
        return
    yield "kept", counted(row.kept, "kind of elements", "kinds of elements")
    if not row.lost:
        yield "lost of the motion", "nothing"
    for fate in row.lost:
        yield f"{fate.outcome}, {fate.count} × {_what(fate)}", fate.reason


def _deviations(row: SurveyRow) -> str:
    readers = {"MuJoCo's compiled model": row.from_compiled, "Pinocchio": row.from_second}
    texts = (f"{value:.0e} from {name}" for name, value in readers.items() if value is not None)
    return ", ".join(texts) or "no other reader takes the file as it is"


def _reading(row: SurveyRow, engine: str) -> str:
    read = row.readers.get(engine, "not run")
    if read == "alike":
        return "as the file says"
    clauses = [_otherwise(difference) for difference in row.differences.get(engine, ())] or [read]
    if (moved := row.moved_m.get(engine)) is not None:
        clauses.append(f"after 1 s bodies are {quantity.length(moved)} off")
    return "; ".join(clauses)


def _otherwise(difference: Difference) -> str:
    """Describe a reader's difference, as `mbds-xsim readers` does in a row of its table."""
    example = f"{difference.first} has {difference.read}" if difference.first else difference.read
    share = f"{difference.count} of {difference.among} {difference.of}"
    return f"{difference.field} of {share} ({example}, the file says {difference.stated})"


def _verdicts(row: SurveyRow, causes: list[Cause]) -> Iterator[tuple[str, str]]:
    if not row.verdicts:
        yield "verdicts", "not run"
        return
    if passed := [engine for engine, verdict in row.verdicts.items() if verdict == "pass"]:
        yield "passes in", ", ".join(passed)
    if row.reference:
        yield "reference", f"ends early: {row.reference}"
    for engine, verdict in row.verdicts.items():
        if verdict != "pass":
            parts = (verdict, row.reasons.get(engine, ""), _known(causes, row, engine))
            yield f"in {engine}", "; ".join(filter(None, parts))
