"""What tables of an ablation hold, the same on the terminal and in Markdown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mbds_xsim.counted import counted
from mbds_xsim.report import quantity
from mbds_xsim.study.ablate_result import Ablation, Row, Size

__all__ = [
    "COLUMNS",
    "Column",
    "conclusion",
    "floor_line",
    "judge_line",
    "made",
    "model",
    "size_line",
]


@dataclass(frozen=True)
class Column:
    """A column of the effects' table."""

    heading: str
    meaning: str
    cell: Callable[[Row], str]
    text: bool = False
    narrow: bool = True
    """Whether a narrow terminal has it too."""


def made(row: Row) -> str:
    """Say what was done to the effect."""
    return "dropped" if row.factor == 0.0 else f"× {row.factor:g}"


COLUMNS = (
    Column("effect", "what the scene models", lambda row: row.effect, text=True),
    Column("made", "dropped, or how much of it is left", made, text=True),
    Column(
        "at 1 s",
        "RMS change of the particles at 1 s, worst of the low and medium starts",
        lambda row: quantity.length(row.change_1s_m),
    ),
    Column(
        "median",
        "the same, median of these starts",
        lambda row: quantity.length(row.change_1s_median_m),
        narrow=False,
    ),
    Column(
        "overall",
        "largest change over the whole comparison, divided by the growth of a disturbance, worst "
        "of all starts",
        lambda row: quantity.length(row.change_m),
    ),
    Column(
        "median ",
        "the same, median of all starts",
        lambda row: quantity.length(row.change_median_m),
        narrow=False,
    ),
    Column(
        "× floor",
        "the larger of the two changes over its floor",
        lambda row: quantity.number(row.over_floor),
    ),
    Column(
        "× engines",
        "the larger of the two changes over the disagreement between engines alone",
        lambda row: quantity.number(row.over_disagreement),
        narrow=False,
    ),
    Column("verdict", "needed where a change is above its floor", lambda r: r.verdict, text=True),
)


def conclusion(ablation: Ablation) -> str:
    """Name what the scene could do without, in a sentence."""
    dropped = [row for row in ablation.rows if row.factor == 0.0]
    names = [row.effect for row in dropped if row.verdict == "not needed"]
    needed = sum(row.verdict == "needed" for row in dropped)
    count = f"{needed} of {len(dropped)} effects are needed"
    return f"{count}; not needed: {', '.join(names)}" if names else count


def judge_line(ablation: Ablation) -> str:
    """Say what simulated the scene with and without each effect, and for how long."""
    low, high = (quantity.span(value) for value in ablation.judged_s)
    span = high if low == high else f"{low} to {high}"
    text = f"{ablation.judge}, {counted(len(ablation.trajectories), 'start')} compared over {span}"
    return f"{text}; then {ablation.ends}" if ablation.ends else text


def floor_line(ablation: Ablation) -> str:
    """Say what a change must exceed, and where that comes from."""
    floor = ablation.floor
    at_one = "none"
    if floor.disagreement_1s_m is not None:
        at_one = _floor(floor.at_1s, floor.disagreement_1s_m, floor.budget_1s_m)
    overall = _floor(floor.overall, floor.disagreement_m, floor.budget_m)
    return f"{at_one} at 1 s, {overall} overall; engines: {', '.join(ablation.floor_engines)}"


def _floor(floor: float, disagreement: float | None, budget: float) -> str:
    return (
        f"{quantity.length(floor)} (engines {quantity.length(disagreement)}, budget "
        f"{quantity.length(budget)})"
    )


def size_line(ablation: Ablation) -> str:
    """Say what the smallest model is."""
    return (
        f"{ablation.degrees_of_freedom} degrees of freedom; smallest model "
        f"{ablation.joint_coordinates} coordinates, {ablation.loop_conditions} conditions of "
        f"closed loops, {ablation.contact_spheres} contact pairs"
    )


def model(size: Size) -> str:
    """Say what an engine's model has more than the scene needs."""
    more = [
        f"{count} {what}"
        for count, what in (
            (size.more_coordinates, "coordinates"),
            (size.more_constraints, "constraints"),
            (size.more_pairs, "contact pairs"),
        )
        if count > 0
    ]
    return f"models {' and '.join(more)} more than needed" if more else "no more than needed"
