"""What changes of engine and settings cost: which model survives which, then each pair."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Sequence

from mbds_xsim.base.text import counted
from mbds_xsim.learn.shift.interaction import BEARABLE, FALSE, OTHER, by_change
from mbds_xsim.learn.shift.result import Interaction, Shift
from mbds_xsim.learn.shift.worth import NOTABLE
from mbds_xsim.report.blocks import Column, Table, table_of
from mbds_xsim.report.quantity import NONE, number


def change_tables(shift: Shift, place: int) -> Iterator[Table]:
    """From the last known frame on, and from the first contact on."""
    when, found = f"at t = {shift.frames[place]}", shift.interactions
    yield survivors(found, place, when, _noticed(shift, found, place))
    yield _pairs(found, place, when)
    if shift.after_contact:
        frames = [frame for frame in shift.contact_frames if frame <= shift.frames[place]]
        taken = counted(shift.contact_trajectories, "trajectory")
        when = f"{frames[-1]} frames after the first contact ({taken})"
        place, found = len(frames) - 1, shift.after_contact
        yield survivors(found, place, when, _noticed(shift, found, place))
        yield _pairs(found, place, when)


def _noticed(
    shift: Shift, found: Sequence[Interaction], place: int
) -> set[tuple[str, frozenset[str]]]:
    """Models and pairs of domains that are further apart than the model errs where it learned."""
    if all(each.noticed for each in found):
        return {(e.model, frozenset((e.first, e.second))) for e in found if e.noticed[place]}
    place = shift.frames.index(shift.at)  # earlier results know it of no other frames
    return {
        (gap.model, frozenset((gap.training, gap.test)))
        for gap in shift.gaps
        if (own := gap.own[place]) is not None
        and (apart := gap.engine_floor[place]) is not None
        and own < apart
    }


def survivors(
    found: Sequence[Interaction],
    place: int,
    when: str,
    noticed: Collection[tuple[str, frozenset[str]]],
) -> Table:
    """Give a table with a row for each change and a column for each model.

    Noticed are models and pairs of domains that are further apart than the model errs at home.
    """
    models = list(dict.fromkeys(each.model for each in found))

    def cell(whole: Sequence[Interaction], model: str) -> str:
        own = [e for e in whole if e.model == model and e.value[place] is not None]
        seen = [e for e in own if (model, frozenset((e.first, e.second))) in noticed]
        return _cost(own, seen, place)

    rows = (
        (f"{OTHER[change]} {where}", *(cell(whole, model) for model in models))
        for (change, where), whole in by_change(found).items()
    )
    return titled(
        f"Which model survives which change {when}",
        "How many times the squared error grows by the costliest significant change of its kind, "
        "with its 95 % interval, and which change it is. A model survives if no significant cost "
        f"can be {NOTABLE:g} or more, it errs less on its own data than the two data sets differ "
        f"or a smaller cost is significant, and all intervals end below {BEARABLE:g} times; it "
        "does not notice the change if it errs more than they differ and nothing is significant. "
        "Below 1.1: where the highest interval ends",
        ("change", *models),
        rows,
    )


def _cost(own: Sequence[Interaction], noticed: Sequence[Interaction], place: int) -> str:
    """Say what the dearest pair costs, or how sure it is that none costs anything."""
    told = [each for each in own if each.resolved[place] and (each.value[place] or 0.0) > 1.0]
    dear = [each for each in told if (each.high[place] or 0.0) >= NOTABLE]
    if dear:
        most = max(dear, key=lambda each: each.value[place] or 0.0)
        low, high = number(most.low[place]), number(most.high[place])
        return f"{number(most.value[place])} [{low}, {high}], {between(most.first, most.second)}"
    seen = [*noticed, *told]
    rooms = [room for e in seen or own if (room := e.high[place]) is not None]
    if not rooms:
        return NONE
    room = max(rooms)
    sure = "survives" if room < BEARABLE else "cannot be told"
    # 1.002 ends above 1, and below 1.01.
    below = f"{math.ceil(100.0 * room) / 100.0:g}" if room < BEARABLE else number(room)
    return f"{sure if seen else 'not noticed'}, below {below}"


def between(first: str, second: str, *, where: bool = False) -> str:
    """Name what differs of two domains, engines or settings, and before it what does not."""
    (engine, variant), (other, another) = (n.rpartition("-")[::2] for n in (first, second))
    if variant == another:
        return f"{variant}: {engine} ↔ {other}" if where else f"{engine} ↔ {other}"
    return f"{engine}: {variant} ↔ {another}" if where else f"{variant} ↔ {another}"


def _pairs(found: Sequence[Interaction], place: int, when: str) -> Table:
    rows = (
        (
            f"{each.model}, {between(each.first, each.second, where=True)}",
            str(each.seeds),
            number(each.value[place]),
            f"{number(each.low[place])} … {number(each.high[place])}",
            "significant" if each.resolved[place] else "",
        )
        for each in found
    )
    return titled(
        f"What a change of engine or settings costs {when}",
        "√(R_ij R_ji / (R_ii R_jj)), R_ij the mean squared error of the training on i, tested on "
        "j: 1 is no loss by the change, 2 twice the squared error. 95 % by paired bootstrap over "
        "trajectories and seeds; significant: of all pairs together, by the rule of Benjamini "
        f"and Hochberg, at most {FALSE:.0%} of them false",
        ("model, engines", "seeds", "ratio", "95 %", ""),
        rows,
    )


def titled(title: str, note: str, heading: Sequence[str], rows: Iterable[tuple[str, ...]]) -> Table:
    """Give a table whose first column has words, and others figures."""
    columns = [Column(text, words=not place) for place, text in enumerate(heading)]
    return table_of(columns, tuple(rows), title=title, note=note)
