"""Report of a stability study, descriptions of its cells, and a picture of its maps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

from mbds_xsim.base.text import counted
from mbds_xsim.report import blocks, quantity, themed
from mbds_xsim.report.themed import INK
from mbds_xsim.studies.stability import Study, Survey, text_of, words

_ACROSS = 4
"""Largest number of maps side by side in a picture."""
_CELL = 0.5
"""Width of a cell of the map of models in a picture [in]."""
_NARROW = 11.0
"""Width of a picture up to which the legend has three columns [in]."""
_HEAD = 0.9
"""Height of title and legend of a picture [in]."""
_CELL_COLUMNS = (
    "engine and method", ">value", ">step", "what happened", "who told", "in its words", "figures",
)  # fmt: skip


def listing(studies: Iterable[Study]) -> blocks.Table:
    """List the studies, one per row."""
    rows: list[list[blocks.Cell | str]] = [
        [
            blocks.Cell(study.name, "strong"),
            words.axis_label(study),
            ", ".join(map(text_of, study.values)),
            study.sentence,
        ]
        for study in studies
    ]
    return blocks.table_of(("study", "what is swept", "values", "what it is about"), rows)


def present(sweep: Survey) -> blocks.Report:
    """Report the conclusion of a study, with the limits, maps and cells behind it."""
    versions = ", ".join(f"{name} {version}" for name, version in sweep.versions.items())
    return blocks.Report(
        title=sweep.study,
        what="largest stable step [ms]",
        description=sweep.sentence,
        conclusion=words.conclusion(sweep),
        blocks=tuple(_blocks(sweep)),
        command=sweep.command,
        made=f"{sweep.machine}, {counted(sweep.workers, 'process')} at a time, "
        f"{counted(sweep.measured, 'cell')} measured, {sweep.kept} kept from earlier, in "
        f"{quantity.span(sweep.wall_s)}; {versions}",
    )


def _blocks(sweep: Survey) -> Iterator[blocks.Block]:
    yield _limits(sweep)
    yield blocks.Remarks.of(
        [
            ("reading", words.reading(sweep)),
            ("stable", sweep.criteria.removeprefix("stable: ")),
            *words.first_failures(sweep),
            *words.stable_ranges(sweep),
            *((f"{name} left out", reason) for name, reason in sweep.left_out.items()),
            *((f"no reference at {name}", reason) for name, reason in sweep.unknown.items()),
        ]
    )
    yield blocks.Section("What breaks first", tuple(_maps(sweep)), on=blocks.PAGE)
    title = "All cells that are not stable and on course"
    yield blocks.Section(title, (_cells(sweep),), folded=True, on=blocks.PAGE)


def _limits(sweep: Survey) -> blocks.Table:
    first = f"engine and method / {words.axis_label(sweep)}"
    rows = [
        [panel.name, *(words.limit(panel, row) for row in range(len(sweep.values)))]
        for panel in sweep.panels
    ]
    return blocks.table_of([first, *(f">{text_of(value)}" for value in sweep.values)], rows)


def _maps(sweep: Survey) -> Iterator[blocks.Block]:
    yield blocks.Text(
        f"Across: the step; upwards: {words.axis_label(sweep)}. The colour says what breaks first "
        f"within {sweep.duration_s:g} s; hatched cells go wrong without a word from the engine. "
        "Point at a cell for its figures and the command that runs it again"
    )
    keys = [
        blocks.Key(look.meaning, look.colour, look.letter, dark=look.dark)
        for look in words.looks_of(sweep)
    ]
    yield blocks.Legend((*keys, blocks.Key("without a word from the engine", hatched=True)))
    (engines, models), tooltips = words.charts_of(sweep), words.tips(sweep)
    charts = [*engines, models] if models else engines
    maps = tuple(_map(sweep, places, tooltips) for places in charts)
    yield blocks.FigureGroup(maps, least=275)


def _map(sweep: Survey, places: tuple[int, ...], tooltips: dict[str, str]) -> blocks.Figure:
    title = f"{sweep.study}: {', '.join(sweep.panels[place].name for place in places)}"
    draw = partial(words.draw_map, sweep=sweep, places=places)
    return blocks.chart(title, draw, words.size_of(sweep, places), tips=tooltips)


def _cells(sweep: Survey) -> blocks.Table:
    rows: list[list[blocks.Cell | str]] = [
        [
            f"{cell.engine} {cell.method}{'' if cell.profile == 'matched' else f' {cell.profile}'}",
            text_of(cell.value),
            quantity.span(cell.step_s),
            words.outcome_text(cell),
            blocks.Cell(cell.told, "over" if cell.silent else ""),
            cell.reason,
            dict(words.facts_of(cell, sweep)).get("figures", ""),
        ]
        for cell in sweep.cells
        if cell.outcome != "stable"
    ]
    return blocks.table_of(_CELL_COLUMNS, rows)


def cells_of(sweep: Survey) -> Iterator[blocks.Block]:
    """Describe what happened in each cell, and why."""
    for cell in sweep.cells:
        yield blocks.Text(words.name_of(cell, sweep), "strong")
        outcome, *others = (blocks.Remark(*fact) for fact in words.facts_of(cell, sweep))
        yield blocks.Remarks((replace(outcome, mark="fail" if cell.failed else ""), *others))
    yield blocks.Remarks.of(
        [
            ("stable", sweep.criteria.removeprefix("stable: ")),
            *((f"{name} left out", reason) for name, reason in sweep.left_out.items()),
        ]
    )


def to_png(sweeps: list[Survey], stored: bytes = b"") -> bytes:
    """Return a PNG of the maps of each study with their legend; `stored` is the CSV behind it."""
    parts = [(partial(_draw_study, sweep=sweep), _picture(sweep)) for sweep in sweeps]
    return themed.stacked(parts, stored)


def _picture(sweep: Survey) -> tuple[float, float]:
    engines, models = words.charts_of(sweep)
    width, height = words.size_of(sweep)
    rows = math.ceil(len(engines) / _ACROSS)
    below = words.size_of(sweep, models) if models else (0.0, 0.0)
    wide = max(width * min(_ACROSS, len(engines)), below[0], 9.0)
    return wide, height * rows + below[1] + _HEAD


def _draw_study(figure: Any, sweep: Survey) -> None:
    engines, models = words.charts_of(sweep)
    across, rows = min(_ACROSS, len(engines)), math.ceil(len(engines) / _ACROSS)
    grid = figure.add_gridspec(rows + bool(models), max(across, 1))
    for k, places in enumerate(engines):
        axes = figure.add_subplot(grid[k // across, k % across])
        words.draw_map(axes, sweep, places, labelled=not k % across)
    if models:
        room = round(_picture(sweep)[0] / _CELL)
        words.draw_map(figure.add_subplot(grid[-1, :]), sweep, models, columns=room)
    words.draw_legend(figure, sweep, columns=4 if _picture(sweep)[0] > _NARROW else 3)
    title = f"{sweep.study}: {sweep.sentence}; what breaks first within {sweep.duration_s:g} s"
    figure.suptitle(title, fontsize=11, x=0.01, ha="left", color=INK)
