"""The files that `tradeoff` is asked for."""

from __future__ import annotations

import os
from pathlib import Path

from mbds_xsim.report.tradeoff_csv import to_csv
from mbds_xsim.report.tradeoff_markdown import to_markdown
from mbds_xsim.report.tradeoff_page import to_html, to_png
from mbds_xsim.study.rows import Row, Tradeoff, to_json
from mbds_xsim.write import write_whole

__all__ = ["write_files"]


def write_files(
    studies: list[Tradeoff],
    rows: list[Row],
    *,
    csv: Path | None = None,
    html: Path | None = None,
    png: Path | None = None,
    markdown: Path | None = None,
) -> None:
    """Write those that are named, each whole or not at all."""
    if csv is not None:
        write_whole(csv, to_csv(rows))
    if html is not None:
        write_whole(html, to_html(studies).encode())
    if png is not None:
        write_whole(png, to_png(studies, to_json(studies)))
    if markdown is not None:
        picture = "" if png is None else _link(markdown, png)
        write_whole(markdown, to_markdown(studies, picture).encode())


def _link(page: Path, picture: Path) -> str:
    """Name a picture from the folder of a page."""
    return Path(os.path.relpath(picture, page.parent)).as_posix()
