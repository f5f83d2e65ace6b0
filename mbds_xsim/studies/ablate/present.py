"""An ablation as a report."""

from __future__ import annotations

from collections.abc import Iterator

from mbds_xsim.base.text import counted
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Block, Cell, Column, Mark, Remarks, Report, Row, Table, table_of
from mbds_xsim.studies.ablate.analyse import Ablation, Size, WeakenedEffect

_MARKS: dict[str, Mark] = {"needed": "strong", "not possible": "muted"}
_COLUMNS = (
    Column("effect", "what the scene models", words=True),
    Column("made", "dropped, or how much of it is left", words=True),
    Column("at 1 s", "RMS change of the particles at 1 s, worst of the low and medium starts"),
    Column("median", "the same, median of these starts", narrow=False),
    Column(
        "overall",
        "largest change over the whole comparison, divided by the growth of a disturbance, "
        "worst of all starts",
    ),
    Column("median ", "the same, median of all starts", narrow=False),
    Column("× floor", "the larger of the two changes over its floor"),
    Column(
        "× engines",
        "the larger of the two changes over the disagreement between engines alone",
        narrow=False,
    ),
    Column("verdict", "needed where a change is above its floor", words=True),
)


def present(ablation: Ablation) -> Report:
    """Say what the scene could do without, and what it is held against."""
    versions = ", ".join(f"{name} {version}" for name, version in ablation.versions.items())
    return Report(
        title=ablation.scene,
        what="what it needs",
        description=ablation.description,
        conclusion=_conclusion(ablation),
        blocks=tuple(_blocks(ablation)),
        command=ablation.command,
        made=f"{ablation.machine}, in {quantity.span(ablation.wall_s)}, with {versions}",
    )


def _blocks(ablation: Ablation) -> Iterator[Block]:
    yield Table(_COLUMNS, tuple(map(_row, ablation.rows)), grouped=True)
    yield Remarks.of(
        [
            ("judge", _judge(ablation)),
            ("floor", _floors(ablation)),
            *((f"{engine} failed", reason) for engine, reason in ablation.failed.items()),
            *((f"{engine} left out", reason) for engine, reason in ablation.left_out.items()),
        ]
    )
    yield _sizes(ablation)
    yield Remarks.of([("scene", _smallest(ablation))])


def _row(row: WeakenedEffect) -> Row:
    changes = (row.change_1s_m, row.change_1s_median_m, row.change_m, row.change_median_m)
    texts = (
        row.effect,
        "dropped" if row.factor == 0.0 else f"× {row.factor:g}",
        *map(quantity.length, changes),
        *map(quantity.number, (row.over_floor, row.over_disagreement)),
    )
    above = row.over_floor is not None and row.over_floor > 1.0
    # Figures often say all that led to a verdict.
    plain = row.verdict == ("needed" if above else "not needed") or not row.sentence
    verdict = Cell(row.verdict, _MARKS.get(row.verdict, ""))
    return Row((*map(Cell, texts), verdict), reasons=() if plain else (row.sentence,))


def _sizes(ablation: Ablation) -> Table:
    headings = ("engine", ">coordinates", ">constraints", ">contact pairs", "")
    rows = [
        [s.engine, *map(str, (s.coordinates, s.constraints, s.contact_pairs)), _more(s)]
        for s in ablation.sizes
    ]
    return table_of(headings, rows)


def _conclusion(ablation: Ablation) -> str:
    dropped = [row for row in ablation.rows if row.factor == 0.0]
    names = [row.effect for row in dropped if row.verdict == "not needed"]
    needed = sum(row.verdict == "needed" for row in dropped)
    count = f"{needed} of {len(dropped)} effects are needed"
    return f"{count}; not needed: {', '.join(names)}" if names else count


def _judge(ablation: Ablation) -> str:
    """Say what simulated the scene with and without each effect, and for how long."""
    low, high = (quantity.span(value) for value in ablation.judged_s)
    span = high if low == high else f"{low} to {high}"
    text = f"{ablation.judge}, {counted(len(ablation.trajectories), 'start')} compared over {span}"
    return f"{text}; then {ablation.ends}" if ablation.ends else text


def _floors(ablation: Ablation) -> str:
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


def _smallest(ablation: Ablation) -> str:
    return (
        f"{ablation.degrees_of_freedom} degrees of freedom; smallest model "
        f"{ablation.joint_coordinates} coordinates, {ablation.loop_conditions} conditions of "
        f"closed loops, {ablation.contact_spheres} contact pairs"
    )


def _more(size: Size) -> str:
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
