"""A validation as one HTML file that needs nothing else: verdict, motions, plots, all settings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from markupsafe import Markup

from mbds_xsim.report import (
    animation,
    contact_table,
    figures,
    palette,
    summary,
    timeline,
)
from mbds_xsim.report.contact import contacts_of
from mbds_xsim.report.palette import Style
from mbds_xsim.report.template import rendered
from mbds_xsim.result import Evidence, Validation
from mbds_xsim.write import write_whole

__all__ = ["write_page"]


def write_page(validation: Validation, evidence: Evidence, path: Path) -> None:
    """Write the page.

    Args:
        validation: The figures.
        evidence: The arrays behind them.
        path: Where to; an existing file is replaced.
    """
    styles = palette.styles(validation.engines)
    names = tuple(summary.label(result) for result in validation.engines)
    viewer = animation.pack(evidence, names, styles)
    contacts = contacts_of(evidence)
    count = len(viewer["trajectories"])
    if contacts:
        viewer["contact"] = timeline.pack(validation, evidence, contacts, count)
    page = rendered(
        "page.html",
        v=validation,
        columns=summary.COLUMNS,
        names=names,
        styles=styles,
        conclusion=summary.conclusion(validation),
        odd_one_out=summary.odd_one_out(validation),
        reference=summary.reference_line(validation),
        intervals=_intervals(evidence),
        viewer=viewer,
        contact_tables=contact_table.tables(contacts, count),
        lanes=timeline.lanes(evidence) if contacts else "",
        ends=summary.ends(validation),
        restitution=figures.restitution(validation, evidence, styles, contacts),
        ground=evidence.scene.ground,
        growth=figures.error_growth(validation, evidence, styles),
        checks=list(_check_figures(validation, evidence, styles)),
        matrix=figures.matrix(validation, styles),
        consistency=figures.consistency(validation, styles),
    )
    write_whole(path, page.encode())


def _check_figures(
    validation: Validation, evidence: Evidence, styles: tuple[Style, ...]
) -> Iterator[tuple[str, Markup]]:
    for check in figures.plotted_checks(evidence):
        yield check, figures.check_series(validation, evidence, styles, check)


def _intervals(evidence: Evidence) -> dict[int, Any]:
    """Sampling interval of every trajectory, by its index; none where there is only one."""
    batch = evidence.batch
    if len(batch) == 1:
        return {}
    return {int(batch.index[row]): batch.interval(row) for row in range(len(batch))}
