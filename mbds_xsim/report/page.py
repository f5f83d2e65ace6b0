"""Reports as one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from mbds_xsim.base.safe_text import printable, sentence
from mbds_xsim.report import palette, themed
from mbds_xsim.report.blocks import Block, Figure, Motion, Report, Section
from mbds_xsim.report.terminal import SIGNS


def to_html(reports: Sequence[Report], title: str) -> str:
    """Give the page; the motion of the first report that has one can be played.

    Args:
        reports: A chapter each.
        title: Of the page.
    """
    environment = Environment(
        loader=PackageLoader("mbds_xsim", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_finalized,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["sentence"] = sentence
    return environment.get_template("page.html").render(
        light=palette.LIGHT,
        dark=palette.DARK,
        reports=reports,
        title=title,
        signs=SIGNS,
        svg=_svg,
        motion=next((m.data for report in reports for m in _motions(report.blocks)), None),
    )


def _svg(figure: Figure) -> Markup:
    return themed.svg(figure.title, figure.draw, figure.size, figure.tips)


def _motions(blocks: Iterable[Block]) -> Iterator[Motion]:
    for block in blocks:
        if isinstance(block, Motion):
            yield block
        elif isinstance(block, Section):
            yield from _motions(block.blocks)


def _finalized(value: Any) -> Any:
    """Drop control characters; text that is HTML already stays so."""
    return type(value)(printable(value)) if isinstance(value, str) else value
