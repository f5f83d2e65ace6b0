"""A comparison as Markdown, to be kept or shown beside a change."""

from __future__ import annotations

from collections.abc import Iterator

from mbds_xsim.report import diff_summary as summary
from mbds_xsim.safe_text import as_code, in_markdown
from mbds_xsim.study.diff import Comparison, Diff

__all__ = ["to_markdown"]


def to_markdown(comparison: Comparison) -> str:
    """Give everything that changed, scene by scene."""
    files = f"{as_code(comparison.old)} and {as_code(comparison.new)}"
    comparison = in_markdown(comparison)
    lines = [line for diff in comparison.scenes for line in _scene(diff)]
    only = [
        f"- Scenes only in the {which} one: {', '.join(names)}"
        for which, names in (
            ("old", comparison.scenes_only_old),
            ("new", comparison.scenes_only_new),
        )
        if names
    ]
    return "\n".join([*lines, *only, f"- Compared {files}: {summary.thresholds(comparison)}", ""])


def _scene(diff: Diff) -> Iterator[str]:
    yield from (f"# {diff.scene}: {'worse' if diff.worse else 'nothing worse'}", "")
    yield from (f"{summary.conclusion(diff).capitalize()}.", "")
    for heading, lines in (
        ("What changed", summary.figure_lines(diff)),
        ("Times", summary.time_lines(diff)),
    ):
        if lines:
            yield from (f"## {heading}", "", *_table(lines), "")
    yield from (f"- **Worse: {line}**" for line in diff.worse)
    yield from (f"- {subject.capitalize()}: {text}" for subject, text in summary.remarks(diff))
    yield f"- Old: {as_code(diff.old_command)}; new: {as_code(diff.new_command)}"


def _table(lines: list[summary.Line]) -> Iterator[str]:
    yield f"| {' | '.join(summary.HEADINGS)} |"
    yield "| :-- | :-- | :-- | :-- | --: |"
    for line in lines:
        cells = (cell.replace("|", "\\|").replace("<", "&lt;") for cell in line.cells)
        yield f"| {' | '.join(f'**{cell}**' if line.worse else cell for cell in cells)} |"
