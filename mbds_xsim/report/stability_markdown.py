"""Stability studies as Markdown: the largest stable steps, and what breaks."""

from __future__ import annotations

from mbds_xsim.counted import counted
from mbds_xsim.report import quantity
from mbds_xsim.report import stability_summary as summary
from mbds_xsim.safe_text import as_code, in_markdown, sentence
from mbds_xsim.study.stability.definition import text_of
from mbds_xsim.study.stability.rows import Sweep

__all__ = ["to_markdown"]


def to_markdown(sweeps: list[Sweep]) -> str:
    """Give the table of each study, what breaks, and how to make it again."""
    return "\n".join(line for sweep in in_markdown(sweeps) for line in _lines(sweep))


def _lines(sweep: Sweep) -> list[str]:
    versions = ", ".join(f"{name} {version}" for name, version in sweep.versions.items())
    return [
        f"# {sweep.study}: largest stable step [ms]",
        "",
        f"{sentence(sweep.sentence)}{summary.conclusion(sweep)}.",
        "",
        *_table(sweep),
        "",
        f"- {summary.reading(sweep)[0].upper()}{summary.reading(sweep)[1:]}",
        f"- {sweep.criteria[0].upper()}{sweep.criteria[1:]}",
        *(f"- {name}: {text}" for name, text in summary.breaking(sweep)),
        *(f"- {name}: {text}" for name, text in summary.holding(sweep)),
        *([f"- Trained models: {summary.learned_told(sweep)}"] * bool(summary.learned_told(sweep))),
        *(f"- {name} left out: {reason}" for name, reason in sweep.left_out.items()),
        *(f"- No reference at {name}: {reason}" for name, reason in sweep.unknown.items()),
        f"- Made by {as_code(sweep.command)} on {sweep.machine}, "
        f"{counted(sweep.workers, 'process')} at a time, "
        f"in {quantity.span(sweep.wall_s)}, with {versions}",
        "",
    ]


def _table(sweep: Sweep) -> list[str]:
    heads = [f"engine and method / {summary.swept(sweep)}", *map(text_of, sweep.values)]
    rules = [":--", *("--:" for _ in sweep.values)]
    rows = [
        [panel.name, *(summary.limit(panel, row) for row in range(len(sweep.values)))]
        for panel in sweep.panels
    ]
    return [f"| {' | '.join(row)} |" for row in (heads, rules, *rows)]
