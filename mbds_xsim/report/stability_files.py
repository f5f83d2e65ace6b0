"""The files that `stability` is asked for."""

from __future__ import annotations

from pathlib import Path

from mbds_xsim.report.stability_csv import to_csv
from mbds_xsim.report.stability_markdown import to_markdown
from mbds_xsim.report.stability_page import to_html, to_png
from mbds_xsim.study.stability.rows import Sweep, to_json
from mbds_xsim.write import write_whole

__all__ = ["write_all", "write_files"]


def write_all(sweep: Sweep, folder: Path) -> None:
    """Write every kind of file of one study into a folder, named after it."""
    base = folder / sweep.study
    write_whole(base.with_suffix(".json"), to_json([sweep]) + b"\n")
    write_files(
        [sweep],
        csv=base.with_suffix(".csv"),
        html=base.with_suffix(".html"),
        png=base.with_suffix(".png"),
        markdown=base.with_suffix(".md"),
    )


def write_files(
    sweeps: list[Sweep],
    *,
    csv: Path | None = None,
    html: Path | None = None,
    png: Path | None = None,
    markdown: Path | None = None,
) -> None:
    """Write those that are named, each whole or not at all."""
    if csv is not None:
        write_whole(csv, to_csv(sweeps))
    if html is not None:
        write_whole(html, to_html(sweeps).encode())
    if png is not None:
        write_whole(png, to_png(sweeps, to_csv(sweeps)))
    if markdown is not None:
        write_whole(markdown, to_markdown(sweeps).encode())
