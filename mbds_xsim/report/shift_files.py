"""The files that `shift` is asked for."""

from __future__ import annotations

import os
from pathlib import Path

from mbds_xsim.learn.shift.result import to_json
from mbds_xsim.learn.shift.samples import samples_of
from mbds_xsim.learn.shift.study import Studied
from mbds_xsim.report.shift_csv import to_csv
from mbds_xsim.report.shift_figures import to_png
from mbds_xsim.report.shift_markdown import to_markdown
from mbds_xsim.report.shift_motion import samples_png
from mbds_xsim.report.shift_page import to_html
from mbds_xsim.write import write_whole

__all__ = ["write_files"]


def write_files(
    studies: list[Studied],
    *,
    csv: Path | None = None,
    html: Path | None = None,
    png: Path | None = None,
    rollouts: Path | None = None,
    markdown: Path | None = None,
) -> None:
    """Write those that are named, each whole or not at all."""
    shifts = [studied.shift for studied in studies]
    if csv is not None:
        write_whole(csv, to_csv(studies))
    if html is not None:
        write_whole(html, to_html(studies).encode())
    if png is not None:
        write_whole(png, to_png(shifts, to_json(shifts)))
    if rollouts is not None:
        write_whole(rollouts, samples_png([samples_of(studied.board) for studied in studies]))
    if markdown is not None:
        picture = "" if png is None else Path(os.path.relpath(png, markdown.parent)).as_posix()
        write_whole(markdown, to_markdown(shifts, picture).encode())
