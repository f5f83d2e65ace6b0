"""Ablations as Markdown: what the terminal shows, to be kept."""

from __future__ import annotations

from collections.abc import Sequence

from mbds_xsim.report import ablate_summary as summary
from mbds_xsim.report import quantity
from mbds_xsim.safe_text import as_code, in_markdown, sentence
from mbds_xsim.study.ablate_result import Ablation

__all__ = ["to_markdown"]


def to_markdown(ablations: Sequence[Ablation]) -> str:
    """Give tables, floor and judge of each scene, and how to make them again."""
    lines = [
        "# No more than a scene needs",
        "",
        "What dropping or halving each modelled effect changes, beside what engines differ by.",
        "",
        *(f"- {column.heading.strip()}: {column.meaning}" for column in summary.COLUMNS[1:]),
        "",
    ]
    told = (line for ablation in in_markdown(ablations) for line in _lines(ablation))
    return "\n".join([*lines, *told])


def _lines(ablation: Ablation) -> list[str]:
    versions = ", ".join(f"{name} {version}" for name, version in ablation.versions.items())
    return [
        f"## {ablation.scene}",
        "",
        f"{sentence(ablation.description)}{summary.conclusion(ablation).capitalize()}.",
        "",
        *_effects(ablation),
        "",
        f"- Judge: {summary.judge_line(ablation)}",
        f"- Floor: {summary.floor_line(ablation)}",
        *(f"- {engine} failed: {reason}" for engine, reason in ablation.failed.items()),
        *(f"- {engine} left out: {reason}" for engine, reason in ablation.left_out.items()),
        "",
        *_sizes(ablation),
        "",
        f"- Scene: {summary.size_line(ablation)}",
        f"- Made by {as_code(ablation.command)} on {ablation.machine}, in "
        f"{quantity.span(ablation.wall_s)}, with {versions}",
        "",
    ]


def _effects(ablation: Ablation) -> list[str]:
    headings = [*(column.heading.strip() for column in summary.COLUMNS), "why"]
    rules = [*(":--" if column.text else "--:" for column in summary.COLUMNS), ":--"]
    rows = [
        [*(column.cell(row).replace("<", "&lt;") for column in summary.COLUMNS), row.sentence]
        for row in ablation.rows
    ]
    return [_line(row) for row in (headings, rules, *rows)]


def _sizes(ablation: Ablation) -> list[str]:
    rows = [
        [
            size.engine,
            *map(str, (size.coordinates, size.constraints, size.contact_pairs)),
            summary.model(size),
        ]
        for size in ablation.sizes
    ]
    headings = ["engine", "coordinates", "constraints", "contact pairs", ""]
    return [_line(row) for row in (headings, [":--", "--:", "--:", "--:", ":--"], *rows)]


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
