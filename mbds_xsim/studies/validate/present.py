"""Report of a validation: the verdict, then motions, plots, findings and all settings."""

from __future__ import annotations

from collections.abc import Iterator

from mbds_xsim.base.text import counted
from mbds_xsim.measure.result import EngineResult, Evidence, FindingResult, Validation
from mbds_xsim.report import blocks, quantity
from mbds_xsim.report.blocks import (
    PAGE,
    Cell,
    FigureGroup,
    Section,
    Table,
    Text,
    plots,
    row_of,
    table_of,
)
from mbds_xsim.report.themed import Style
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.studies.validate import figures, motion, words
from mbds_xsim.studies.validate.figures import styled
from mbds_xsim.studies.validate.motion import Contact, contacts_of

_VERDICTS: dict[str, blocks.Mark] = {"pass": "pass", "warn": "warn", "fail": "fail"}
_FEW = 6
"""Largest number of pairs of distributions that are shown unfolded."""
_FINDING = ("", "check", ">figure", ">budget", "worst in", "where", "figure of each trajectory")
_REFERENCE = Style(-1, dashed=False)


def present(validation: Validation, evidence: Evidence | None = None) -> blocks.Report:
    """Report which engines can be trusted; without evidence there are no motions or plots."""
    versions = ", ".join(f"{name} {version}" for name, version in validation.versions.items())
    shown = () if evidence is None else tuple(_behind(validation, evidence))
    return blocks.Report(
        title=validation.scene,
        what=validation.verdict,
        description=validation.description,
        conclusion=words.conclusion(validation),
        blocks=(*_summary(validation), *shown),
        command=validation.command,
        made=f"{validation.machine}, in {validation.wall_s:.0f} s, with {versions}",
        verdict=_VERDICTS.get(validation.verdict, ""),
    )


def _summary(validation: Validation) -> Iterator[blocks.Block]:
    yield _engines(validation)
    yield blocks.Remarks.of(
        [
            *words.remarks(validation),
            *((f"{name} left out", reason) for name, reason in validation.left_out.items()),
            ("reference", words.reference_line(validation)),
            ("odd one out", words.odd_one_out(validation)),
            *([("time", words.spent_line(validation))] if validation.spent_s else []),
        ]
    )


def _engines(validation: Validation) -> Table:
    rows = []
    for result, style in styled(validation, validation.engines):
        _, *cells = words.cells_of(result, validation)
        verdict = Cell(result.verdict, _VERDICTS.get(result.verdict, ""))
        first = Cell(result.engine, line=style)
        rows.append(blocks.Row((first, *cells, verdict), reasons=result.reasons))
    return table_of((*words.COLUMNS, "verdict"), rows, grouped=True)


def _behind(validation: Validation, evidence: Evidence) -> Iterator[Section]:
    """Yield the sections that only a page shows."""
    contacts = contacts_of(evidence)
    yield Section("Motion", (_motion(validation, evidence, contacts),), on=PAGE)
    yield from plots("Impacts", [figures.restitution(validation, evidence, contacts)])
    yield _agreement(validation, evidence)
    checks = (
        figures.check_series(validation, evidence, check)
        for check in figures.plotted_checks(evidence)
    )
    first = " Vertical: the earliest first impact." if any(words.ends(validation)[:1]) else ""
    text = "The worst of all trajectories at each time; 0 is ideal. Dotted: budgets."
    yield from plots("Checks over time", checks, text + first)
    text = (
        "Each engine was run again at another step. What its results tend to as the step shrinks "
        "must meet the reference within the uncertainty of that estimate; this shows errors of the "
        "model far below the accuracy budgets."
    )
    yield from plots("Consistency", [figures.consistency(validation)], text)
    each = enumerate(styled(validation, validation.engines))
    findings = tuple(_findings(result, style, first=not k) for k, (result, style) in each)
    yield Section("Findings", findings, on=PAGE)
    yield Section("Settings", tuple(_settings(validation, evidence)), on=PAGE)


def _motion(
    validation: Validation, evidence: Evidence, contacts: tuple[Contact | None, ...]
) -> blocks.Motion:
    names = [words.label(result) for result in validation.engines]
    entries = tuple(styled(validation, names))
    data = motion.pack(evidence, entries)
    if not contacts:
        return blocks.Motion(data, "reference", entries)
    count = len(data["trajectories"])
    data["contact"] = motion.pack_strips(validation, evidence, contacts, count)
    every = (("reference", _REFERENCE), *entries)
    numbers = [trajectory["index"] for trajectory in data["trajectories"]]
    tables = motion.tables(contacts, every, numbers)
    reading = motion.reading(evidence, slips=data["contact"]["slips"])
    about = words.contact_words(validation, evidence)
    return blocks.Motion(data, "reference", entries, tables, (about, reading))


def _agreement(validation: Validation, evidence: Evidence) -> Section:
    growth = figures.error_growth(validation, evidence)
    shown = tuple(filter(None, (*growth, figures.matrix(validation))))
    text = Text(words.growth_words(validation, evidence, known=bool(growth)))
    distributions = _distributions(validation) if validation.ensembles else ()
    title = "Agreement with the reference" if growth else "Agreement"
    return Section(title, (text, FigureGroup(shown), *distributions), on=PAGE)


def _distributions(validation: Validation) -> Iterator[blocks.Block]:
    apart = sum(pair.p_value < 0.01 for pair in validation.ensembles)
    yield Text(
        "Distributions: pairs whose motions no longer agree one by one, as samples of "
        "distributions at the end: their energy distance, 0 for equal and 1 for two points, and "
        "the probability of so large a one if both are draws of one distribution"
    )
    columns = ("pair", ">trajectories", ">distance", ">p-value")
    rows = [
        (f"{p.one} and {p.other}", str(p.count), *map(quantity.number, (p.distance, p.p_value)))
        for p in validation.ensembles
    ]
    title = f"{counted(len(rows), 'pair')}, {apart} told apart with p below 0.01"
    yield Section(title, (table_of(columns, rows),), folded=True, opened=len(rows) <= _FEW)


def _findings(result: EngineResult, style: Style, *, first: bool) -> Section:
    failures = (Text(failure, "fail") for failure in result.failures)
    tables = [table_of(_FINDING, map(_finding_row, result.findings))] if result.findings else []
    return Section(
        words.label(result),
        (*failures, *tables),
        folded=True,
        opened=first or result.verdict == "fail",
        verdict=_VERDICTS.get(result.verdict, ""),
        line=style,
    )


def _finding_row(finding: FindingResult) -> blocks.Row:
    figure, budget = quantity.beside(
        finding.figure, finding.budget, finding.unit, passed=finding.passed
    )
    note = f" ({finding.note})" if finding.note else ""
    each = " ".join(quantity.with_unit(value, finding.unit) for value in finding.figures)
    worst = f"trajectory {finding.trajectory}, frame {finding.frame}"
    where = finding.where or quantity.NONE
    judged = Cell("", "pass" if finding.passed else "fail")
    sign = Cell("·", "muted") if finding.budget is None else judged
    cells = (sign, f"{finding.check}{note}", figure, budget, worst, where, each)
    return row_of(cells, "" if finding.passed else "over")


def _settings(validation: Validation, evidence: Evidence) -> Iterator[Table]:
    words_first = ("engine", "version", "method", "family", ">order", ">step", "options")
    columns = (*words_first, ">coordinates", ">constraints", ">set-up")
    rows: list[list[Cell | str]] = [
        [
            Cell(words.label(result), line=style),
            result.version,
            result.method,
            result.family,
            str(result.order),
            f"{result.step_s:g} s" if result.rtol is None else quantity.NONE,
            ", ".join(f"{key} = {value}" for key, value in result.options.items()) or "defaults",
            *(
                quantity.NONE if n is None else str(n)
                for n in (result.coordinates, result.constraints)
            ),
            quantity.span(result.setup_s),
        ]
        for result, style in styled(validation, validation.engines)
    ]
    yield table_of(columns, rows)
    budgets = [(key, quantity.number(value)) for key, value in validation.budget.items()]
    lengths = ("length of the scene", quantity.length(validation.length_m))
    yield _pairs("Budgets", [*budgets, lengths])
    yield _pairs("Trajectories", [("seed", str(validation.seed)), *_intervals(evidence)])


def _pairs(title: str, pairs: list[tuple[str, str]]) -> Table:
    return table_of(("", ">"), pairs, title=title)


def _intervals(evidence: Evidence) -> Iterator[tuple[str, str]]:
    """List the trajectories of each sampling interval, if there is more than one trajectory."""
    batch = evidence.batch
    of_row = [(str(batch.index[row]), batch.interval(row)) for row in range(len(batch))]
    for name in INTERVALS if len(batch) > 1 else ():
        numbers = [number for number, interval in of_row if interval == name]
        yield name, ", ".join(numbers) or quantity.NONE
