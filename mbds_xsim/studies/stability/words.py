"""A stability study in words: limits, what breaks first, who said so."""

from __future__ import annotations

import itertools
import shlex
from collections import Counter
from collections.abc import Callable, Iterator, Sequence

from mbds_xsim.report import quantity
from mbds_xsim.studies.stability.definition import text_of
from mbds_xsim.studies.stability.rows import MapCell, Panel, Survey

_WHO = {
    "engine": "the engine",
    "adapter": "the adapter's watch on the states; the engine itself says nothing",
    "process": "the process, by its end",
    "nobody": "nobody: only the checks saw it",
}


_LEARNED = (
    "they take no steps, only frames, start with the reference's first six, and are judged by "
    "their particles alone, with the limits of engines: joints by the distances that no motion "
    "changes, energy as that of points, against the reference's (with contact: above the start's)"
)


def swept(sweep: Survey) -> str:
    """Name what is swept, with its unit."""
    return f"{sweep.quantity} [{sweep.unit}]" if sweep.unit else sweep.quantity


def limit(panel: Panel, row: int) -> str:
    """Write the largest stable step [ms], and in brackets the largest on course if it is less."""
    stable, on_course = panel.largest_stable(row), panel.largest_on_course(row)
    if stable is None:
        return _alike(panel.cells[row]) or quantity.NONE
    if on_course == stable:
        return milliseconds(stable)
    less = quantity.NONE if on_course is None else milliseconds(on_course)
    return f"{milliseconds(stable)} ({less})"


def milliseconds(step: float) -> str:
    """Write a step [s] without its unit."""
    return f"{1e3 * step:.4g}"


def reading(sweep: Survey) -> str:
    """Explain the table of limits."""
    steps = ", ".join(map(milliseconds, sweep.steps_s))
    return (
        f"in ms, of {steps} tried over {sweep.duration_s:g} s; in brackets the largest one that is "
        f"on course too; {quantity.NONE}: none"
    )


def breaking(sweep: Survey) -> Iterator[tuple[str, str]]:
    """Say of every panel what breaks, how often, and how often silently."""
    for panel in sweep.panels:
        wrong = [c for row in panel.cells for c in row if c.failed or c.outcome == "off course"]
        counts = Counter(cell.outcome for cell in wrong)
        late = sum(cell.unmeasured for row in panel.cells for cell in row)
        silent = sum(cell.silent for cell in wrong)
        told = [f"{what} {count}×" for what, count in counts.most_common()]
        text = ", ".join(told + [f"not measured {late}×"] * bool(late))
        if text:
            cells = sum(len(row) for row in panel.cells)
            yield panel.name, f"{text}, of {cells} cells; {silent} without a word of the engine"


def conclusion(sweep: Survey) -> str:
    """Say in one line what bears most, and how much goes wrong silently."""
    cells = sweep.cells
    ranked = [panel for panel in sweep.panels if not panel.learned] or sweep.panels
    failed = [cell for cell in cells if cell.failed]
    silent = [cell for cell in failed if cell.silent]
    late = sum(cell.unmeasured for cell in cells)
    lacking = f", {late} are not measured (out of time: give more by --limit)" if late else ""
    stable = Counter({p.name: sum(_holds(c) for row in p.cells for c in row) for p in ranked})
    most = max(stable.values())
    best = [name for name, count in stable.items() if count == most]
    shown = ", ".join(best[:3]) + (f" and {len(best) - 3} more" if len(best) > 3 else "")
    of_most = f"most stable: {shown} ({most} of {sum(map(len, ranked[0].cells))})"
    return (
        f"{len(failed)} of {len(cells)} cells fail, {len(silent)} of them without a word of the "
        f"engine{lacking}; {of_most if most else 'none is stable'}"
    )


def _holds(cell: MapCell) -> bool:
    return not (cell.failed or cell.unmeasured or cell.outcome == "refused")


def holding(sweep: Survey) -> Iterator[tuple[str, str]]:
    """Say of every trained model at which values it holds, and what breaks first beyond."""
    for panel in sweep.panels:
        if panel.learned:
            yield panel.name, _held([row[0] for row in panel.cells], sweep)


def learned_told(sweep: Survey) -> str:
    """Explain how trained models are judged; "" where there are none."""
    return _LEARNED if any(panel.learned for panel in sweep.panels) else ""


def _held(cells: Sequence[MapCell], sweep: Survey) -> str:
    stable = _runs(cells, _holds, sweep)
    on_course = _runs(cells, lambda cell: cell.outcome == "stable", sweep)
    text = f"stable {stable}, on course {on_course}"
    beyond = next((cell for cell in cells if cell.failed), None)
    if beyond is None:
        return text
    return f"{text}; at {text_of(beyond.value, sweep.unit)} {what_happened(beyond)}, told by nobody"


def _runs(cells: Sequence[MapCell], holds: Callable[[MapCell], bool], sweep: Survey) -> str:
    """Name the values that hold: neighbours as a range."""
    groups = [list(group) for held, group in itertools.groupby(cells, holds) if held]
    return " and ".join(f"at {_range(group, sweep)}" for group in groups) or "nowhere"


def _range(cells: Sequence[MapCell], sweep: Survey) -> str:
    first, last = (text_of(cells[k].value, sweep.unit) for k in (0, -1))
    return first if len(cells) == 1 else f"{first} to {last}"


def name_of(cell: MapCell, sweep: Survey) -> str:
    """Name a cell in one line."""
    where = f"{sweep.quantity} {text_of(cell.value, sweep.unit)}"
    profile = f" ({cell.profile} settings)"
    step = quantity.span(cell.step_s)
    return f"{cell.study}, {where}: {cell.engine} {cell.method}{profile}, step {step}"


def told(cell: MapCell, sweep: Survey) -> Iterator[tuple[str, str]]:
    """Tell all about a cell: what happened, who said so, the figures."""
    yield "outcome", what_happened(cell)
    if cell.failed or cell.outcome == "off course":
        yield "who told", _WHO[cell.told]
    if cell.reason:
        yield "in its words", cell.reason
    figures = ", ".join(_figures(cell))
    if figures:
        yield "figures", figures
    if cell.options:
        yield "options", ", ".join(f"{key} = {value}" for key, value in cell.options.items())
    yield "again", command_of(cell, sweep)


def what_happened(cell: MapCell) -> str:
    """Say what became of a run, with when."""
    text: str = "not measured" if cell.unmeasured else cell.outcome
    if cell.broke_s is not None:
        text += f" from {quantity.span(cell.broke_s)} on"
    if cell.ended_s is not None and cell.ended_s < cell.duration_s - 1e-9:
        text += f", ended at {quantity.span(cell.ended_s)}"
    return text


def command_of(cell: MapCell, sweep: Survey) -> str:
    """Give the command line that runs a cell again."""
    if cell.source:
        return (
            f"mbds-xsim stability {sweep.study} --engines none --models {shlex.quote(cell.source)} "
            f"--value {text_of(cell.value)}"
        )
    profile = "" if cell.profile == "matched" else f" --settings {cell.profile}"
    return (
        f"mbds-xsim stability {sweep.study} --engines {cell.engine} --methods {cell.method}"
        f"{profile} --value {text_of(cell.value)} --step {cell.step_s:g}"
    )


def _figures(cell: MapCell) -> Iterator[str]:
    if cell.energy is not None:
        yield f"energy {cell.energy:+.2g} of its scale"
    if cell.gap is not None:
        yield f"joints open by {quantity.number(cell.gap)} of the length"
    if cell.sunk is not None:
        yield f"sunk by {quantity.number(cell.sunk)} of the length"
    if cell.way is not None:
        yield f"way {cell.way:.2g} of the due one"
    if cell.error is not None:
        yield f"error {quantity.number(cell.error)} of the length"
    if cell.wall_s is not None:
        yield f"{quantity.span(cell.wall_s)} of wall time"


def _alike(cells: tuple[MapCell, ...]) -> str:
    """Say that all cells are refused, or that none is measured; else ""."""
    words = {"refused": "refused", "timed out": "not measured"}
    (first, *others) = {cell.outcome for cell in cells}
    return "" if others else words.get(first, "")
