"""A stability study in words and maps: limits, what breaks first, and who reported it.

A cell that goes wrong with no warning from the engine is hatched.
"""

from __future__ import annotations

import itertools
import shlex
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from mbds_xsim.report import quantity
from mbds_xsim.report.themed import GREY, INK
from mbds_xsim.studies.stability import MapCell, Outcome, Panel, Study, Survey, Value, text_of

_REPORTERS = {
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


def axis_label(study: Study | Survey) -> str:
    """Name the swept quantity, with its unit."""
    return f"{study.quantity} [{study.unit}]" if study.unit else study.quantity


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
    # Trained models take no steps.
    tried = "" if all(panel.learned for panel in sweep.panels) else f"of {steps} tried "
    return (
        f"in ms, {tried}over {sweep.duration_s:g} s; in brackets the largest one that is "
        f"on course too; {quantity.NONE}: none"
    )


def first_failures(sweep: Survey) -> Iterator[tuple[str, str]]:
    """Describe for each panel what breaks, how often, and how often silently."""
    for panel in sweep.panels:
        wrong = [c for row in panel.cells for c in row if c.failed or c.outcome == "off course"]
        counts = Counter(cell.outcome for cell in wrong)
        late = sum(cell.unmeasured for row in panel.cells for cell in row)
        silent = sum(cell.silent for cell in wrong)
        parts = [f"{outcome} {count}×" for outcome, count in counts.most_common()]
        text = ", ".join(parts + [f"not measured {late}×"] * bool(late))
        if text:
            cells = sum(len(row) for row in panel.cells)
            yield panel.name, f"{text}, of {cells} cells; {silent} without a word from the engine"


def conclusion(sweep: Survey) -> str:
    """State in one line how many cells fail, how many silently, and what is most stable."""
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
        f"{len(failed)} of {len(cells)} cells fail, {len(silent)} of them without a word from the "
        f"engine{lacking}; {of_most if most else 'none is stable'}"
    )


def _holds(cell: MapCell) -> bool:
    return not (cell.failed or cell.unmeasured or cell.outcome == "refused")


def stable_ranges(sweep: Survey) -> Iterator[tuple[str, str]]:
    """List where each trained model is stable, what breaks first beyond, and how it is judged."""
    learned = [panel for panel in sweep.panels if panel.learned]
    for panel in learned:
        yield panel.name, _describe_stability([row[0] for row in panel.cells], sweep)
    yield from [("trained models", _LEARNED)] * bool(learned)


def _describe_stability(cells: Sequence[MapCell], sweep: Survey) -> str:
    stable = _runs(cells, _holds, sweep)
    on_course = _runs(cells, lambda cell: cell.outcome == "stable", sweep)
    text = f"stable {stable}, on course {on_course}"
    beyond = next((cell for cell in cells if cell.failed), None)
    if beyond is None:
        return text
    who = _REPORTERS[beyond.told].partition(":")[0]
    text += f"; at {text_of(beyond.value, sweep.unit)} {outcome_text(beyond)}, told by {who}"
    return f"{text}: {beyond.reason}" if beyond.outcome == "crashed" else text


def _runs(cells: Sequence[MapCell], holds: Callable[[MapCell], bool], sweep: Survey) -> str:
    """List the values that hold, neighbouring ones as a range."""
    groups = [list(group) for good, group in itertools.groupby(cells, holds) if good]
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


def facts_of(cell: MapCell, sweep: Survey) -> Iterator[tuple[str, str]]:
    """List the facts about a cell: what happened, who reported it, figures, and how to rerun it."""
    yield "outcome", outcome_text(cell)
    if cell.failed or cell.outcome == "off course":
        yield "who told", _REPORTERS[cell.told]
    if cell.reason:
        yield "in its words", cell.reason
    figures = ", ".join(_figures(cell))
    if figures:
        yield "figures", figures
    if cell.options:
        yield "options", ", ".join(f"{key} = {value}" for key, value in cell.options.items())
    yield "again", command_of(cell, sweep)


def outcome_text(cell: MapCell) -> str:
    """Describe the outcome of a run, with its times."""
    text: str = "not measured" if cell.unmeasured else cell.outcome
    if cell.broke_s is not None:
        text += f" from {quantity.span(cell.broke_s)} on"
    if cell.ended_s is not None and cell.ended_s < cell.duration_s - 1e-9:
        text += f", ended at {quantity.span(cell.ended_s)}"
    return text


def command_of(cell: MapCell, sweep: Survey) -> str:
    """Return the command line that runs a cell again."""
    if cell.source:
        return (
            f"mbds-xsim stability {sweep.study} --engines none --models {shlex.quote(cell.source)} "
            f"--value {_exactly(cell.value)}"
        )
    return (
        f"mbds-xsim stability {sweep.study} --engines {cell.engine} --methods {cell.method} "
        f"--settings {cell.profile} --value {_exactly(cell.value)} --step {_exactly(cell.step_s)}"
    )


def _exactly(value: Value) -> str:
    """Write a value so that reading it gives the same one, up to rounding."""
    return value if isinstance(value, str) else f"{value:.12g}"


def _figures(cell: MapCell) -> Iterator[str]:
    words: tuple[tuple[float | None, Callable[[float], str]], ...] = (
        (cell.energy, lambda value: f"energy {value:+.2g} of its scale"),
        (cell.gap, lambda value: f"joints open by {quantity.number(value)} of the length"),
        (cell.sunk, lambda value: f"sunk by {quantity.number(value)} of the length"),
        (cell.way, lambda value: f"way {value:.2g} of the due one"),
        (cell.error, lambda value: f"error {quantity.number(value)} of the length"),
        (cell.wall_s, lambda value: f"{quantity.span(value)} of wall time"),
    )
    return (say(value) for value, say in words if value is not None)


def _alike(cells: tuple[MapCell, ...]) -> str:
    """Return words for cells that are all refused, or all not measured; else ""."""
    words = {"refused": "refused", "timed out": "not measured"}
    (first, *others) = {cell.outcome for cell in cells}
    return "" if others else words.get(first, "")


@dataclass(frozen=True)
class Look:
    """Look of an outcome on the maps, and its meaning."""

    colour: str
    letter: str
    meaning: str
    dark: bool = False


# Letters go with the colours, none of which is an engine's or a model's.
LOOKS: dict[Outcome, Look] = {
    "stable": Look("#8fd6b9", "", "stable and on course"),
    "off course": Look("#e9efb5", "o", "stable, but more than a tenth of the length off"),
    "gains energy": Look("#ff7f6e", "E", "gains energy"),
    "loses energy": Look("#a9c9ff", "L", "loses energy"),
    "comes apart": Look("#e2b3e6", "A", "joints come apart"),
    "sinks in": Look("#a37a5c", "S", "spheres sink into the ground", dark=True),
    "stuck": Look("#ffd59e", "F", "hardly moves"),
    "clamped": Look("#f0e442", "K", "cut to what the engine allows"),
    "blows up": Look("#8c2d2d", "X", "blows up between two frames", dark=True),
    "gives up": Look("#5b5ea6", "N", "the engine gives up to solve a step", dark=True),
    "ends early": Look("#9c8f8f", "?", "ends early for another reason", dark=True),
    "crashed": Look("#2f3a3d", "C", "the process crashes", dark=True),
    "timed out": Look("#7f8fa6", "T", "not measured: no answer in time", dark=True),
    "refused": Look("#e4e4e4", "–", "cannot be represented"),
}
_HATCH = "////"
_LETTER = 0.068  # height of a letter in an upright name [in]
_UPRIGHT: dict[bool, dict[str, Any]] = {False: {}, True: {"rotation": 90, "fontsize": 7.5}}
_CELL = (0.36, 0.30)  # [in]
_MARGIN = (1.15, 0.85)  # [in]


def looks_of(sweep: Survey) -> list[Look]:
    """Return the looks of the outcomes that occur."""
    outcomes = {cell.outcome for cell in sweep.cells}
    return [look for outcome, look in LOOKS.items() if outcome in outcomes]


def charts_of(sweep: Survey) -> tuple[list[tuple[int, ...]], tuple[int, ...]]:
    """Return the places of the panels of each engine method's map, and of the map of all models."""
    places = range(len(sweep.panels))
    models = tuple(k for k in places if sweep.panels[k].learned)
    return [(k,) for k in places if k not in models], models


def size_of(sweep: Survey, places: Sequence[int] = ()) -> tuple[float, float]:
    """Return width and height of one map [in]; without `places`, of an engine's map."""
    panels = [sweep.panels[place] for place in places]
    columns = sum(len(panel.steps_s) for panel in panels) or len(sweep.steps_s)
    labels = 0.075 * max(len(text_of(value)) for value in sweep.values)
    learned = [panel for panel in panels if panel.learned]
    names = max((_LETTER * len(name) for name in _training_and_names(learned)[1]), default=0.0)
    width = max(_CELL[0] * columns, 1.6)
    return (_MARGIN[0] + labels + width, _MARGIN[1] + names + _CELL[1] * len(sweep.values))


def draw_map(
    axes: Any, sweep: Survey, places: Sequence[int], *, labelled: bool = True, columns: int = 0
) -> None:
    """Draw a map of panels side by side.

    Args:
        axes: Axes to draw on.
        sweep: The study.
        places: Places of the panels: that of an engine's method, or those of all models.
        labelled: Whether to label the vertical axis; not needed next to another map.
        columns: Least number of columns to leave room for.
    """
    panels = [sweep.panels[place] for place in places]
    begin = 0
    for place, panel in zip(places, panels, strict=True):
        for row, cells in enumerate(panel.cells):
            for k, cell in enumerate(cells):
                _draw_cell(axes, cell, begin + k, row, f"tip-{place}-{row * len(cells) + k}")
        begin += len(panel.steps_s)
    title, x_label, ticks = _heading(panels)
    axes.set_xticks(range(begin), ticks, **_UPRIGHT[panels[0].learned])
    axes.set_yticks(range(len(sweep.values)), [text_of(value) for value in sweep.values])
    axes.set_xlim(-0.5, max(begin, columns) - 0.5)
    axes.set_ylim(-0.5, len(sweep.values) - 0.5)
    axes.set_xlabel(x_label, loc="left" if panels[0].learned else "center")
    axes.set_ylabel(_short(axis_label(sweep)) if labelled else "")
    axes.set_title(title, fontsize=9, loc="left", color=INK)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    for side in axes.spines.values():
        side.set_visible(False)


def _heading(panels: Sequence[Panel]) -> tuple[str, str, list[str]]:
    """Return the title, and label and ticks of the columns."""
    if panels[0].learned:
        return ("trained models, frame by frame", *_training_and_names(panels))
    steps = [milliseconds(step) for step in panels[0].steps_s]
    return panels[0].name, "step [ms]", steps


def _training_and_names(panels: Sequence[Panel]) -> tuple[str, list[str]]:
    """Return the models' common training and their names; names state trainings that differ."""
    trainings = {panel.name.removeprefix(panel.engine).strip() for panel in panels}
    if len(trainings) == 1:
        return trainings.pop(), [panel.engine for panel in panels]
    return "", [panel.name for panel in panels]


def draw_legend(figure: Any, sweep: Survey, *, columns: int) -> None:
    """Explain the colours that occur, and the hatching, below the maps."""
    from matplotlib.patches import Patch

    patches = [
        Patch(fc=look.colour, ec=GREY, lw=0.4, label=f"{look.letter}  {look.meaning}".strip())
        for look in looks_of(sweep)
    ]
    label = "hatched: without a word from the engine"
    patches.append(Patch(fc="white", ec=INK, lw=0.0, hatch=_HATCH, label=label))
    look = {"ncols": columns, "frameon": False, "fontsize": 8}
    figure.legend(handles=patches, loc="outside lower left", **look)


def tips(sweep: Survey) -> dict[str, str]:
    """Return the text shown when a cell is pointed at, keyed by the gid of its artist."""
    return {
        f"tip-{place}-{row * len(cells) + column}": "\n".join(
            [name_of(cell, sweep), *map(": ".join, facts_of(cell, sweep))]
        )
        for place, panel in enumerate(sweep.panels)
        for row, cells in enumerate(panel.cells)
        for column, cell in enumerate(cells)
    }


def _draw_cell(axes: Any, cell: MapCell, column: int, row: int, gid: str) -> None:
    from matplotlib.patches import Rectangle

    look = LOOKS[cell.outcome]
    ink = "#ffffff" if look.dark else "#1a1a1a"
    area = ((column - 0.47, row - 0.45), 0.94, 0.9)
    axes.add_patch(Rectangle(*area, fc=look.colour, lw=0, gid=gid))
    if cell.silent:
        axes.add_patch(Rectangle(*area, fc="none", ec=ink, lw=0, hatch=_HATCH, alpha=0.55))
    if look.letter:
        back = {"facecolor": look.colour, "edgecolor": "none", "pad": 0.8}
        axes.text(
            column, row, look.letter, ha="center", va="center", fontsize=7, color=ink, bbox=back
        )


def _short(text: str) -> str:
    """Break a long axis label into two lines."""
    if len(text) < 28:
        return text
    middle = text.rfind(" ", 0, len(text) // 2 + 4)
    return f"{text[:middle]}\n{text[middle + 1 :]}"
