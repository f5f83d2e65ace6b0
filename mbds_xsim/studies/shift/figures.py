"""Heat maps and curves of shift studies."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mbds_xsim.learn.curves import looks
from mbds_xsim.learn.model import TRIVIAL
from mbds_xsim.learn.shift.interaction import by_change
from mbds_xsim.learn.shift.result import INTERVALS, ErrorCell, Shift
from mbds_xsim.report import themed
from mbds_xsim.report.quantity import number, ratio
from mbds_xsim.studies.shift.changes import between, other_engines

Pick = Callable[[ErrorCell], float | None]


@dataclass(frozen=True)
class Matrix:
    """Figures of a model by training (row) and test domain (column): means over seeds."""

    model: str
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    figures: Mapping[tuple[str, str], float | None]

    @property
    def values(self) -> list[list[float | None]]:
        """Rows of figures; None if there is none."""
        return [[self.entry(row, column) for column in self.columns] for row in self.rows]

    @property
    def homes(self) -> list[str]:
        """Trainings on a single domain that is also a test domain."""
        return [row for row in self.rows if row in self.columns]

    def entry(self, training: str, test: str) -> float | None:
        """Return a figure; None if there is none."""
        return self.figures.get((training, test))

    def at_home(self, training: str) -> float | None:
        """Return the figure of a training on its own domain; None if there is none."""
        return self.entry(training, training)


def trained_models(shift: Shift) -> list[str]:
    """Return the names of the models that were trained."""
    return list(dict.fromkeys(m.model for m in shift.models if m.engines))


def matrix_of(shift: Shift, model: str, pick: Pick, interval: str = INTERVALS[0]) -> Matrix:
    """Return one figure of all trainings of a model on all domains."""
    cells: dict[tuple[str, str], list[float | None]] = {}
    for cell in shift.cells:
        if (cell.model, cell.interval) == (model, interval):
            cells.setdefault((cell.training, cell.test), []).append(pick(cell))
    rows = tuple(dict.fromkeys(training for training, _ in cells))
    columns = tuple(domain.name for domain in shift.domains)
    return Matrix(model, rows, columns, {key: mean(each) for key, each in cells.items()})


def maps_at(shift: Shift, frame: int) -> list[Matrix]:
    """Return the errors at a frame of each trained model that has any."""
    every = [matrix_of(shift, model, at(shift, frame)) for model in trained_models(shift)]
    return [matrix for matrix in every if any(x is not None for x in matrix.figures.values())]


def best_formula(shift: Shift, pick: Pick, interval: str = INTERVALS[0]) -> dict[str, float]:
    """Return by domain the least figure of the trivial models, if all of them have one."""
    matrices = [matrix_of(shift, name, pick, interval) for name in TRIVIAL]
    best: dict[str, float] = {}
    for domain in matrices[0].columns:
        # There is no row if no trajectory is of the interval.
        row = [matrix.entry(name, domain) for matrix in matrices for name in matrix.rows[:1]]
        known = [figure for figure in row if figure is not None]
        if len(known) == len(TRIVIAL):
            best[domain] = min(known)
    return best


def at(shift: Shift, frame: int) -> Pick:
    """Return a function that picks the mean squared error at a frame."""
    place = shift.frames.index(frame)
    return lambda cell: cell.mse[place]


def mean(figures: Sequence[float | None]) -> float | None:
    """Average figures; None if one of them is None, so that lost runs are not dropped."""
    known = [x for x in figures if x is not None]
    return statistics.fmean(known) if known and len(known) == len(figures) else None


_CELL = (0.95, 0.34)  # width and height [in]
_MARGIN = (2.4, 1.5)
_LEAST_SPREAD = 0.5  # decades to either side: small differences must not look large
_FORMULAS = dict(zip(TRIVIAL, (":", "--", "-."), strict=True))  # line styles
_PALEST = 0.6  # used share of the colours' range: text is legible on all of it
_MIDDLE = 0.55  # share of the colours' range: darker cells have white text


def map_size(matrix: Matrix) -> tuple[float, float]:
    """Return width and height of a heat map [in]."""
    return _size(len(matrix.rows), len(matrix.columns))


def _size(rows: int, columns: int) -> tuple[float, float]:
    return _MARGIN[0] + _CELL[0] * columns, _MARGIN[1] + _CELL[1] * rows


def draw_matrix(axes: Any, matrix: Matrix, spread: tuple[float, float], title: str) -> None:
    """Draw the errors [m²] of a model, one row per training, one column per test domain.

    `spread` has the ends of the colour scale, as logarithms to base 10.
    """
    logs = [[_log(value) for value in row] for row in matrix.values]
    axes.imshow(logs, cmap="cividis", vmin=spread[0], vmax=spread[1], aspect="auto")
    axes.set_title(title, fontsize=10, loc="left")
    _name_cells(axes, matrix.rows, matrix.columns, rotation=35, ha="right")
    for row, values in enumerate(matrix.values):
        for column, value in enumerate(values):
            bright = _log(value) > spread[0] + _MIDDLE * (spread[1] - spread[0])
            home = matrix.rows[row] == matrix.columns[column]
            axes.text(
                column, row, number(value), ha="center", va="center", fontsize=7.5,
                color="black" if bright else "white", weight="bold" if home else "normal",
            )  # fmt: skip


def pairs_of(shift: Shift) -> list[tuple[str, str]]:
    """Return the pairs of domains that have interactions, grouped by what differs in them."""
    ranked = by_change(shift.interactions).values()
    return list(dict.fromkeys((each.first, each.second) for own in ranked for each in own))


def interactions_size(shift: Shift) -> tuple[float, float]:
    """Return width and height of the picture of interactions [in]."""
    return _size(len(pairs_of(shift)), len({each.model for each in shift.interactions}))


def draw_interactions(axes: Any, shift: Shift) -> None:
    """Draw the costs of changes, one row per pair of domains, one column per model."""
    place, pairs = shift.frames.index(shift.at), pairs_of(shift)
    models = list(dict.fromkeys(each.model for each in shift.interactions))
    costs: dict[tuple[int, int], tuple[float | None, bool]] = {}
    for each in shift.interactions:
        cell = pairs.index((each.first, each.second)), models.index(each.model)
        costs[cell] = each.value[place], each.resolved[place]
    draw_costs(axes, costs, [between(*pair, where=True) for pair in pairs], models)


Costs = Mapping[tuple[int, int], tuple[float | None, bool]]
"""Factor by which the error grows, and whether it is significant, keyed by row and column."""


def draw_costs(
    axes: Any, costs: Costs, rows: Sequence[str], columns: Sequence[str], most: float = 1.0
) -> None:
    """Draw costs in colours that diverge around 1, at least to `most`; frame significant ones."""
    from matplotlib.patches import Rectangle

    logs = [[math.nan for _ in columns] for _ in rows]
    for (row, column), (value, significant) in costs.items():
        logs[row][column] = _log(value)
        axes.text(
            column, row, f"× {ratio(value, significant=significant)}", ha="center", va="center",
            fontsize=8, color="black", weight="bold" if significant else "normal",
        )  # fmt: skip
        if significant:
            axes.add_patch(Rectangle((column - 0.46, row - 0.44), 0.92, 0.88, fill=False, lw=1.2))
    known = [abs(x) for line in logs for x in line if math.isfinite(x)]
    ends = max([_LEAST_SPREAD, math.log10(most), *known]) / _PALEST
    axes.imshow(logs, cmap="RdBu_r", vmin=-ends, vmax=ends, aspect="auto")
    _name_cells(axes, rows, columns)


def _name_cells(axes: Any, rows: Sequence[str], columns: Sequence[str], **look: Any) -> None:
    """Name rows and columns of cells, whose columns' names may have a look."""
    axes.grid(visible=False)
    axes.set_xticks(range(len(columns)), columns, **look)
    axes.set_yticks(range(len(rows)), rows)
    axes.tick_params(length=0, labelsize=8)


def spread_of(matrices: Sequence[Matrix]) -> tuple[float, float]:
    """Return the ends of a colour scale that maps share, as logarithms to base 10."""
    logs = [_log(value) for m in matrices for row in m.values for value in row]
    known = [x for x in logs if math.isfinite(x)] or [0.0]
    middle = 0.5 * (min(known) + max(known))
    half = max(0.5 * (max(known) - min(known)), _LEAST_SPREAD)
    return middle - half, middle + half


def curves_of(shift: Shift, model: str, test: str) -> list[ErrorCell]:
    """Return the cells to draw for a model on one domain: trainings of the domain's variant."""
    variant = test.rpartition("-")[2]
    return [
        cell
        for cell in shift.cells
        if (cell.model, cell.test, cell.interval) == (model, test, INTERVALS[0])
        and cell.training.endswith(f"-{variant}")
        and any(value is not None for value in cell.curve)
    ]


def draw_curves(axes: Any, shift: Shift, model: str, test: str) -> None:
    """Draw errors over time on one domain, for a model's trainings of that domain's variant.

    Trivial models and floors are drawn as well.
    """
    time = [shift.frame_s * (k + 1) for k in range(shift.horizon)]
    tested = [c for c in shift.cells if (c.test, c.interval) == (test, INTERVALS[0])]
    cells = curves_of(shift, model, test)
    names = {cell.training: cell.training.rpartition("-")[0] for cell in cells}
    styles = looks(list(dict.fromkeys(names.values())))
    labelled: set[str] = set()
    for cell in cells:
        colour, style = styles[names[cell.training]]
        label = None if cell.training in labelled else cell.training
        labelled.add(cell.training)
        width = 2.2 if cell.training == test else 1.0
        axes.plot(time, _line(cell.curve), ls=style, color=colour, lw=width, label=label)
    for cell in (cell for cell in tested if cell.model in TRIVIAL):
        label, style = cell.model.replace("_", " "), _FORMULAS[cell.model]
        axes.plot(time, _line(cell.curve), style, color=themed.GREY, lw=1, label=label)
    _draw_floors(axes, shift, test, time)
    axes.set_title(f"{model} on {test}", fontsize=9, loc="left")
    axes.set(yscale="log", ylabel="median squared error [m²]")
    axes.set_xlabel("time since the last known frame [s]")


def _draw_floors(axes: Any, shift: Shift, test: str, time: Sequence[float]) -> None:
    """Draw the range of other engines, and the noise and chaos floors."""
    engines = [_line(floor.curve) for floor in other_engines(shift, test)]
    if engines:
        each = list(zip(*engines, strict=True))
        low, high = [min(values) for values in each], [max(values) for values in each]
        look = {"color": themed.GREY, "alpha": 0.25, "lw": 0, "label": "other engines"}
        axes.fill_between(time, low, high, **look)
    for kind, style in (("noise", ":"), ("chaos", "-.")):
        for floor in shift.floors:
            if (floor.kind, floor.interval) == (kind, INTERVALS[0]):
                look = {"color": themed.INK, "lw": 1, "label": f"{kind} floor"}
                axes.plot(time, _line(floor.curve), style, **look)


def _line(curve: Sequence[float | None]) -> list[float]:
    return [value or math.nan for value in curve]


def _log(value: float | None) -> float:
    return math.log10(value) if value is not None and value > 0 else math.nan
