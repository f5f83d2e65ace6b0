"""Maps of stability: step across, the swept value upwards, colour for what breaks first.

A cell that goes wrong without a word of the engine is hatched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mbds_xsim.report.themed import GREY, INK
from mbds_xsim.studies.stability import words
from mbds_xsim.studies.stability.definition import text_of
from mbds_xsim.studies.stability.rows import MapCell, Outcome, Panel, Survey


@dataclass(frozen=True)
class Look:
    """How an outcome is drawn, and what it means."""

    colour: str
    letter: str
    meaning: str


# A letter besides each colour; none of the colours is an engine's or a model's.
LOOKS: dict[Outcome, Look] = {
    "stable": Look("#8fd6b9", "", "stable and on course"),
    "off course": Look("#e9efb5", "o", "stable, but more than a tenth of the length off"),
    "gains energy": Look("#ff7f6e", "E", "gains energy"),
    "loses energy": Look("#a9c9ff", "L", "loses energy"),
    "comes apart": Look("#e2b3e6", "A", "joints come apart"),
    "sinks in": Look("#a37a5c", "S", "spheres sink into the ground"),
    "stuck": Look("#ffd59e", "F", "hardly moves"),
    "clamped": Look("#f0e442", "K", "cut to what the engine allows"),
    "blows up": Look("#8c2d2d", "X", "blows up between two frames"),
    "gives up": Look("#5b5ea6", "N", "the engine gives up to solve a step"),
    "ends early": Look("#9c8f8f", "?", "ends early for another reason"),
    "crashed": Look("#2f3a3d", "C", "the process crashes"),
    "timed out": Look("#7f8fa6", "T", "not measured: no answer in time"),
    "refused": Look("#e4e4e4", "–", "cannot be represented"),
}
LIGHT_LOOKS = {
    "stable", "off course", "gains energy", "loses energy", "comes apart", "stuck", "clamped",
    "refused",
}  # fmt: skip
_HATCH = "////"
_LETTER = 0.068  # of an upright name [in]
_UPRIGHT: dict[bool, dict[str, Any]] = {False: {}, True: {"rotation": 90, "fontsize": 7.5}}
_CELL = (0.36, 0.30)  # [in]
_MARGIN = (1.15, 0.85)  # [in]


def charts_of(sweep: Survey) -> list[tuple[int, ...]]:
    """Give the places of the panels of each map: one an engine's method, one of all models."""
    models = tuple(k for k, panel in enumerate(sweep.panels) if panel.learned)
    engines = [(k,) for k, panel in enumerate(sweep.panels) if not panel.learned]
    return [*engines, models] if models else [*engines]


def size_of(sweep: Survey, places: Sequence[int] = ()) -> tuple[float, float]:
    """Width and height of one map [in]; without places of an engine's."""
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
        axes: Where.
        sweep: The study.
        places: Of the panels: one of an engine's method, or those of models.
        labelled: Whether to say what is upwards: not where another map stands to the left.
        columns: Room for so many, where there are fewer.
    """
    panels = [sweep.panels[place] for place in places]
    begin = 0
    for place, panel in zip(places, panels, strict=True):
        for row, cells in enumerate(panel.cells):
            for k, cell in enumerate(cells):
                _draw_cell(axes, cell, begin + k, row, f"tip-{place}-{row * len(cells) + k}")
        begin += len(panel.steps_s)
    title, x_label, ticks = _named(panels)
    axes.set_xticks(range(begin), ticks, **_UPRIGHT[panels[0].learned])
    axes.set_yticks(range(len(sweep.values)), [text_of(value) for value in sweep.values])
    axes.set_xlim(-0.5, max(begin, columns) - 0.5)
    axes.set_ylim(-0.5, len(sweep.values) - 0.5)
    axes.set_xlabel(x_label, loc="left" if panels[0].learned else "center")
    axes.set_ylabel(_short(words.swept(sweep)) if labelled else "")
    axes.set_title(title, fontsize=9, loc="left", color=INK)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    for side in axes.spines.values():
        side.set_visible(False)


def _named(panels: Sequence[Panel]) -> tuple[str, str, list[str]]:
    """Title, label and ticks of the columns."""
    if panels[0].learned:
        return ("trained models, frame by frame", *_training_and_names(panels))
    steps = [words.milliseconds(step) for step in panels[0].steps_s]
    return panels[0].name, "step [ms]", steps


def _training_and_names(panels: Sequence[Panel]) -> tuple[str, list[str]]:
    """What all models were trained on, and their names; of several trainings each says its own."""
    trainings = {panel.name.removeprefix(panel.engine).strip() for panel in panels}
    if len(trainings) == 1:
        return trainings.pop(), [panel.engine for panel in panels]
    return "", [panel.name for panel in panels]


def draw_legend(figure: Any, sweep: Survey, *, columns: int) -> None:
    """Explain the colours that occur, and the hatching, below the maps."""
    from matplotlib.patches import Patch

    seen = {cell.outcome for cell in sweep.cells}
    patches = [
        Patch(facecolor=look.colour, edgecolor=GREY, linewidth=0.4, label=_label(look))
        for outcome, look in LOOKS.items()
        if outcome in seen
    ]
    silent = Patch(
        facecolor="white", edgecolor=INK, linewidth=0.0, hatch=_HATCH,
        label="hatched: without a word of the engine",
    )  # fmt: skip
    figure.legend(
        handles=[*patches, silent], loc="outside lower left", ncols=columns, frameon=False,
        fontsize=8,
    )  # fmt: skip


def tips(sweep: Survey) -> dict[str, str]:
    """Say what each cell is when it is pointed at, by the gid of its artist."""
    return {
        f"tip-{place}-{row * len(cells) + column}": _told(cell, sweep)
        for place, panel in enumerate(sweep.panels)
        for row, cells in enumerate(panel.cells)
        for column, cell in enumerate(cells)
    }


def _draw_cell(axes: Any, cell: MapCell, column: int, row: int, gid: str) -> None:
    from matplotlib.patches import Rectangle

    look = LOOKS[cell.outcome]
    ink = "#1a1a1a" if cell.outcome in LIGHT_LOOKS else "#ffffff"
    box = Rectangle((column - 0.47, row - 0.45), 0.94, 0.9, facecolor=look.colour, linewidth=0)
    box.set_gid(gid)
    axes.add_patch(box)
    if cell.silent:
        axes.add_patch(
            Rectangle(
                (column - 0.47, row - 0.45), 0.94, 0.9, facecolor="none", edgecolor=ink,
                linewidth=0, hatch=_HATCH, alpha=0.55,
            )
        )  # fmt: skip
    if look.letter:
        back = {"facecolor": look.colour, "edgecolor": "none", "pad": 0.8}
        axes.text(
            column, row, look.letter, ha="center", va="center", fontsize=7, color=ink, bbox=back
        )


def _told(cell: MapCell, sweep: Survey) -> str:
    lines = [words.name_of(cell, sweep)]
    lines += [f"{subject}: {text}" for subject, text in words.told(cell, sweep)]
    return "\n".join(lines)


def _label(look: Look) -> str:
    return f"{look.letter}  {look.meaning}" if look.letter else look.meaning


def _short(text: str) -> str:
    """Break a long axis label in two lines."""
    if len(text) < 28:
        return text
    middle = text.rfind(" ", 0, len(text) // 2 + 4)
    return f"{text[:middle]}\n{text[middle + 1 :]}"
