"""Trade-off studies as Markdown: what the terminal shows, to be kept."""

from __future__ import annotations

from mbds_xsim.report import quantity
from mbds_xsim.report import tradeoff_summary as summary
from mbds_xsim.report.learned_summary import model_columns, models_short, models_told
from mbds_xsim.safe_text import as_code, in_markdown, sentence
from mbds_xsim.study.rows import Tradeoff

__all__ = ["to_markdown"]


def to_markdown(studies: list[Tradeoff], picture: str = "") -> str:
    """Give table, conclusions, failures, and how to make each again.

    Args:
        studies: A chapter each.
        picture: Where the charts of them stand, from the page; left out where there are none.
    """
    studies = in_markdown(studies)
    lines = [line for study in studies for line in _lines(study)]
    scenes = " and ".join(study.scene for study in studies)
    shown = [f"![Speed against accuracy of {scenes}: charts]({picture})", ""] if picture else []
    return "\n".join([*lines, *shown])


def _lines(study: Tradeoff) -> list[str]:
    conclusion = summary.conclusion(study)
    versions = ", ".join(f"{name} {version}" for name, version in study.versions.items())
    return [
        f"# {study.scene}: speed against accuracy",
        "",
        f"{models_short(study)}{sentence(study.description)}{sentence(conclusion).rstrip()}",
        "",
        *_table(study),
        "",
        *_models(study),
        f"- Error: {summary.what_is_charted(study)}",
        *(f"- {column.heading}: {column.meaning}" for column in summary.columns(study)[2:]),
        *(f"- Option that pays: {line}" for line in summary.options_that_pay(study)),
        *(f"- {name}: {steps}: {what}" for name, steps, what in summary.failures(study)),
        *(f"- Left out: {reason}" for reason in study.left_out.values()),
        f"- Made by {as_code(study.command)} in {quantity.span(study.wall_s)} on "
        f"{summary.machine_told(study)}; {versions}",
        "",
    ]


def _models(study: Tradeoff) -> list[str]:
    if not study.models:
        return []
    columns = model_columns(study)
    told = models_told(study)
    rows = [
        [column.heading for column in columns],
        [":--" if column.text else "--:" for column in columns],
        *([column.cell(model) for column in columns] for model in study.models),
    ]
    table = [f"| {' | '.join(row)} |" for row in rows]
    return ["Trained models:", "", *table, "", f"- Trained models {told}", ""]


def _table(study: Tradeoff) -> list[str]:
    columns = summary.columns(study)
    headings = [column.heading for column in columns]
    rules = [":--" if column.text else "--:" for column in columns]
    rows = [
        [column.cell(curve).replace("<", "&lt;") for column in columns]
        for curve in summary.main_curves(study)
    ]
    return [f"| {' | '.join(row)} |" for row in (headings, rules, *rows)]
