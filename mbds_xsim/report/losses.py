"""Report on an imported model: the parts of its file that are kept, approximated or dropped."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from mbds_xsim.base.text import counted
from mbds_xsim.report import blocks
from mbds_xsim.report.blocks import WRITTEN, Cell, Section, Table, Text, table_of
from mbds_xsim.report.catalogue import scene_row
from mbds_xsim.report.draw import scene_figure
from mbds_xsim.scene.imported import FIXED, Fate, Imported, Outcome, Written
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene

_MARKS: dict[Outcome, blocks.Mark] = {"kept": "pass", "approximated": "warn", "dropped": "fail"}
_MOST = 3  # places that a table names
_WIDE, _ENDLESS = 4 * math.pi, 1000.0  # [rad]: two turns; limits that stand for none
_POSE = "The model at its reference pose"  # bodies are ellipsoids of their inertia


def import_row(imported: Imported) -> dict[str, Any]:
    """Summarise an import; only approximations and drops that affect the motion are counted."""
    row = scene_row(imported.scene)
    return {
        "file": imported.file,
        "format": imported.format,
        "reader": imported.reader,
        "scene": row.scene,
        "bodies": row.bodies,
        "joints": row.joints,
        "degrees_of_freedom": row.degrees_of_freedom,
        "mass_kg": float(Mechanism.of(imported.scene).mass.sum()),
        "approximated": imported.count("approximated"),
        "dropped": imported.count("dropped"),
        "fates": imported.fates,
    }


def present(imported: Imported, command: str) -> blocks.Report:
    """Return the report on an imported model."""
    row = import_row(imported)
    size = (
        f"{counted(row['bodies'], 'body')}, {row['mass_kg']:g} kg, "
        f"reach {imported.scene.length:.3g} m, "
        f"{counted(row['degrees_of_freedom'], 'degree of freedom', 'degrees of freedom')}"
    )
    fixed = [_places(fate) for fate in imported.fates if fate.reason == FIXED]
    return blocks.Report(
        title=imported.file,
        what="imported",
        description=f"{imported.format}, read by {imported.reader}: {size}"
        + "".join(f"; fixed in the world: {places}" for places in fixed)
        + _wide_limits(imported.scene)
        + _far_target(imported.scene),
        conclusion=conclusion(imported),
        blocks=(*loss_blocks(imported), *blocks.plots(_POSE, [scene_figure(imported.scene)])),
        command=command,
    )


def _wide_limits(scene: Scene) -> str:
    """Name the first hinge with a limit of over two turns: it may be in degrees."""
    for joint in scene.joints:
        low, high = joint.limits or (0.0, 0.0)
        if joint.kind == "hinge" and _WIDE < max(-low, high) < _ENDLESS:
            return f"; limits in radians, of over two turns: {joint.name}, {low:g} to {high:g}"
    return ""


def _far_target(scene: Scene) -> str:
    """Name the first servo that pulls past its joint's limits: MJCF has no ranges in degrees."""
    limits = {joint.name: joint.limits for joint in scene.joints if joint.limits}
    for servo in scene.servos:
        low, high = limits.get(servo.joint, (-math.inf, math.inf))
        target = servo.position[0]
        if servo.stiffness and not low <= target <= high:
            span = f"{low:g} to {high:g}"
            return f"; a servo's target past its joint's limits {span}: {servo.joint}, {target:g}"
    return ""


def conclusion(imported: Imported) -> str:
    """Summarise in a clause how much of what affects the motion is lost."""
    dropped, approximated = (imported.count(outcome) for outcome in ("dropped", "approximated"))
    if not dropped and not approximated:
        return "all that bears on the motion is kept"
    return f"{dropped} of what bears on the motion dropped, {approximated} approximated"


def loss_blocks(imported: Imported | Written) -> Iterator[blocks.Block]:
    """Yield a table of losses that affect the motion; in Markdown and pages also the rest."""
    lost = [fate for fate in imported.fates if fate.moves and fate.outcome != "kept"]
    kept = [fate for fate in imported.fates if fate.moves and fate.outcome == "kept"]
    others = [fate for fate in imported.fates if not fate.moves]
    if lost:
        yield _table(lost, "lost of the motion")
    rest = (_table(kept, "kept"), _table(others, "without effect on the motion"))
    tables = tuple(table for table in rest if table.rows)
    yield Section("What is kept, and what moves nothing", tables, True, on=WRITTEN)


def loss_section(imported: Imported) -> Section:
    """Return a section on the losses of import, for a page about the model's motion."""
    summary = Text(f"In {imported.file}, read by {imported.reader}: {conclusion(imported)}.")
    title = "What of the model is simulated"
    return Section(title, (summary, *loss_blocks(imported)), on=WRITTEN)


def _table(fates: list[Fate], title: str) -> Table:
    headings = ("", "element", "of it", ">count", "how or why", "where")
    return table_of(headings, map(_row, fates), title=title)


def _row(fate: Fate) -> tuple[Cell | str, ...]:
    outcome = Cell(fate.outcome, _MARKS[fate.outcome] if fate.moves else "")
    words = ", ".join(fate.properties), str(fate.count), fate.reason, _places(fate)
    return outcome, fate.element, *words


def _places(fate: Fate) -> str:
    more = len(fate.places) - _MOST
    return "; ".join(fate.places[:_MOST]) + (f" and {more} more" if more > 0 else "")
