"""Survey of published models: a page for each wheel, with a section for each model."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from benchmarks.survey_rows import READERS, Cause, SurveyRow, what_of
from mbds_xsim.base.files import write_whole
from mbds_xsim.base.text import counted
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Remarks, Report, Section
from mbds_xsim.report.files import to_markdown
from mbds_xsim.studies.readers import Difference

_HEAD = (
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
        description=_HEAD,
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
        yield f"{fate.outcome}, {fate.count} × {what_of(fate)}", fate.reason


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
            why = next((cause.why for cause in causes if cause.explains(row, engine)), "")
            parts = (verdict, row.reasons.get(engine, ""), why)
            yield f"in {engine}", "; ".join(filter(None, parts))
