"""A validation as Markdown: what the terminal shows, to be kept beside the data."""

from __future__ import annotations

from mbds_xsim.report import summary
from mbds_xsim.report.summary import COLUMNS, Column
from mbds_xsim.result import EngineResult, Validation
from mbds_xsim.safe_text import as_code, in_markdown, sentence

__all__ = ["to_markdown"]


def to_markdown(validation: Validation) -> str:
    """Give the table, what failed and why, and how to make it again."""
    validation = in_markdown(validation)
    versions = ", ".join(f"{name} {what}" for name, what in validation.versions.items())
    lines = [
        f"# {validation.scene}: {validation.verdict}",
        "",
        f"{sentence(validation.description)}{summary.conclusion(validation)}.",
        "",
        *_table(validation),
        "",
        *_reasons(validation),
        f"- Reference: {summary.reference_line(validation)}",
        f"- Odd one out: {summary.odd_one_out(validation)}",
        f"- Figures over budget are bold; {_meanings()}",
        f"- Made by {as_code(validation.command)} on {validation.machine}, in "
        f"{validation.wall_s:.0f} s, with {versions}",
    ]
    return "\n".join(lines) + "\n"


def _table(validation: Validation) -> list[str]:
    headings = [*(column.heading for column in COLUMNS), "verdict"]
    rules = [*(":--" if column.text else "--:" for column in COLUMNS), ":--"]
    rows = [
        [*(_cell(column, result, validation) for column in COLUMNS), result.verdict]
        for result in validation.engines
    ]
    return [f"| {' | '.join(row)} |" for row in (headings, rules, *rows)]


def _cell(column: Column, result: EngineResult, validation: Validation) -> str:
    cell = column.cell(result, validation)
    return f"**{cell.text}**" if cell.over else cell.text.replace("<", "&lt;")


def _reasons(validation: Validation) -> list[str]:
    failed = [f"{summary.label(r)}: {reason}" for r in validation.engines for reason in r.reasons]
    left_out = [f"{engine} left out: {reason}" for engine, reason in validation.left_out.items()]
    remarks = [f"{subject}: {note}" for subject, note in summary.remarks(validation)]
    return [f"- {line}" for line in (*failed, *remarks, *left_out)]


def _meanings() -> str:
    figures = [column for column in COLUMNS if not column.text]
    return "; ".join(f"{column.heading}: {_lowered(column.meaning)}" for column in figures)


def _lowered(sentence: str) -> str:
    return sentence[0].lower() + sentence[1:]
