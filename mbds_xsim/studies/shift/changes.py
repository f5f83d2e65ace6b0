"""Costs of changing engine or settings: which model survives which change, then each pair."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Sequence

from mbds_xsim.base.text import counted
from mbds_xsim.learn.shift.evaluation import RESTART
from mbds_xsim.learn.shift.interaction import BEARABLE, FALSE, OTHER, by_change
from mbds_xsim.learn.shift.result import INTERVALS, ErrorFloor, Interaction, PairRatio, Shift
from mbds_xsim.learn.shift.worth import NOTABLE
from mbds_xsim.report.blocks import Column, Table, table_of
from mbds_xsim.report.quantity import NONE, ratio


def change_tables(shift: Shift, place: int) -> Iterator[Table]:
    """Yield the tables from the last known frame on, then those from the first contact on."""
    parts = [(shift.interactions, place, f"at t = {shift.frames[place]}")]
    if shift.after_contact:
        later = shift.contact_place(shift.frames[place])
        trajectories = counted(shift.contact_trajectories, "trajectory")
        when = f"{shift.contact_frames[later]} frames after the first contact ({trajectories})"
        parts.append((shift.after_contact, later, when))
    for part in parts:
        yield survivors(*part, _noticeable_pairs(shift, *part[:2]))
        yield _pairs(*part)


def _noticeable_pairs(
    shift: Shift, interactions: Sequence[Interaction], place: int
) -> set[tuple[str, frozenset[str]]] | None:
    """Return models with the pairs of domains that differ by more than the model's own error.

    Older results lack `noticed`: there the gaps tell, but after the first contact nothing does.
    """
    if all(each.noticed for each in interactions):
        return {(e.model, frozenset((e.first, e.second))) for e in interactions if e.noticed[place]}
    if interactions is shift.after_contact:
        return None
    return {
        (gap.model, frozenset((gap.training, gap.test)))
        for gap in shift.gaps
        if (own := gap.own[place]) is not None
        and (apart := gap.engine_floor[place]) is not None
        and own < apart
    }


def survivors(
    interactions: Sequence[Interaction],
    place: int,
    when: str,
    noticed: Collection[tuple[str, frozenset[str]]] | None,
) -> Table:
    """Return a table with a row for each change and a column for each model.

    `noticed` has models with the pairs of domains that differ by more than the model's own error;
    None if that is not known.
    """
    models = list(dict.fromkeys(each.model for each in interactions))

    def cell(whole: Sequence[Interaction], model: str) -> str:
        own = [e for e in whole if e.model == model and e.value[place] is not None]
        pairs = {(model, frozenset((each.first, each.second))) for each in own}
        return _cost(own, None if noticed is None else not pairs.isdisjoint(noticed), place)

    rows = (
        (f"{OTHER[change]} {where}", *(cell(whole, model) for model in models))
        for (change, where), whole in by_change(interactions).items()
    )
    return titled_table(
        f"Which model survives which change {when}",
        "How many times the squared error grows by the costliest significant change of its kind, "
        "with its 95 % interval, and which change it is. A model survives if no significant cost "
        f"can be {NOTABLE:g} or more, it errs less on its own data than the two data sets differ "
        f"or a smaller cost is significant, and all intervals end below {BEARABLE:g} times; it "
        "does not notice the change if it errs more than they differ and nothing is significant. "
        "Gains to 0.8: no cost is significant, but a smaller error is, of which the smallest ratio "
        "is named. Below 1.1: where the highest interval ends",
        ("change", *models),
        rows,
    )


def _cost(own: Sequence[Interaction], noticed: bool | None, place: int) -> str:
    """State the cost of the costliest pair, or if no cost is notable, how certain that is.

    `noticed` says whether the model errs less than any of these domains differ; None: not known.
    """
    resolved = [(each.value[place] or 0.0, each) for each in own if each.resolved[place]]
    losses = [each for value, each in resolved if value > 1.0]
    gains = [value for value, _ in resolved if value < 1.0]
    notable = [each for each in losses if (each.high[place] or 0.0) >= NOTABLE]
    if notable:
        most = max(notable, key=lambda each: each.value[place] or 0.0)
        value, low, high = texts_of(most, place)
        return f"{value} [{low}, {high}], {between(most.first, most.second)}"
    bounds = [bound for each in own if (bound := each.high[place]) is not None]
    if not bounds or len(bounds) < len(own):
        return NONE
    bound = max(bounds)
    if noticed is False and not resolved:
        verdict = "not noticed"
    elif bound >= BEARABLE:
        verdict = "cannot be told"
    else:
        verdict = "survives" if noticed or losses else "no significant loss"
    gain = f", gains to {ratio(min(gains), significant=True)}" if gains and not losses else ""
    return f"{verdict}{gain}, below {_rounded_up(bound)}"


def _rounded_up(bound: float) -> str:
    """Write an upper bound: an interval that ends at 1.002 is below 1.01, not below 1."""
    if bound <= 0.0 or not math.isfinite(bound):
        return ratio(bound)
    unit = 10.0 ** (math.floor(math.log10(bound)) - 2)
    return ratio(math.ceil(bound / unit - 1e-9) * unit)


def texts_of(pair: PairRatio, place: int) -> tuple[str, str, str]:
    """Write a ratio and the ends of its interval."""
    figures = (pair.value[place], pair.low[place], pair.high[place])
    value, low, high = (ratio(x, significant=pair.resolved[place]) for x in figures)
    return value, low, high


def between(first: str, second: str, *, where: bool = False) -> str:
    """Name the engines or settings that differ in two domains; `where` adds what is common."""
    (engine, variant), (other, another) = (n.rpartition("-")[::2] for n in (first, second))
    if variant == another:
        return f"{variant}: {engine} ↔ {other}" if where else f"{engine} ↔ {other}"
    return f"{engine}: {variant} ↔ {another}" if where else f"{variant} ↔ {another}"


def other_engines(shift: Shift, test: str) -> list[ErrorFloor]:
    """Return the distances of other engines that go on from a domain's last known frame."""
    engine = test.rpartition("-")[0]  # at other settings it is no other engine
    return [
        floor
        for floor in shift.floors
        if (floor.kind, floor.test, floor.interval) == (RESTART, test, INTERVALS[0])
        and floor.first.rpartition("-")[0] != engine
    ]


def _pairs(interactions: Sequence[Interaction], place: int, when: str) -> Table:
    texts = [(each, *texts_of(each, place)) for each in interactions]
    rows = (
        (
            f"{each.model}, {between(each.first, each.second, where=True)}",
            str(each.seeds),
            value,
            f"{low} … {high}",
            "significant" if each.resolved[place] else "",
        )
        for each, value, low, high in texts
    )
    return titled_table(
        f"What a change of engine or settings costs {when}",
        "√(R_ij R_ji / (R_ii R_jj)), R_ij the mean squared error of the training on i, tested on "
        "j: 1 is no loss by the change, 2 twice the squared error. 95 % by paired bootstrap over "
        "trajectories and seeds; significant: of all pairs together, by the rule of Benjamini "
        f"and Hochberg, at most {FALSE:.0%} of them false",
        ("model, engines", "seeds", "ratio", "95 %", ""),
        rows,
    )


def titled_table(
    title: str, note: str, heading: Sequence[str], rows: Iterable[tuple[str, ...]]
) -> Table:
    """Make a table whose first column has words, and the others figures."""
    columns = [Column(text, words=not place) for place, text in enumerate(heading)]
    return table_of(columns, tuple(rows), title=title, note=note)
