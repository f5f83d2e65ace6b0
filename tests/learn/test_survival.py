"""Which model survives which change: one word or figure for each kind of change."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from benchmarks.harness import stored
from mbds_xsim.learn.shift.result import Interaction, Shift
from mbds_xsim.report.quantity import NONE
from mbds_xsim.studies.shift.changes import change_tables, survivors, texts_of

_PAIR = ("mujoco-native", "dart-native")
_SEEN = {("gns", frozenset(_PAIR))}


def _between(
    first: str, second: str, value: float, low: float, high: float, *, resolved: bool
) -> Interaction:
    return Interaction("gns", first, second, 3, (value,), (low,), (high,), (resolved,))


@pytest.mark.parametrize(
    ("pair", "noticed", "words"),
    [
        ((12.0, 4.0, 30.0, True), True, "12 [4, 30], mujoco ↔ dart"),
        ((12.0, 4.0, 30.0, True), False, "12 [4, 30], mujoco ↔ dart"),
        ((1.02, 0.9, 1.3, False), True, "survives, below 1.3"),
        ((1.02, 0.3, 7.0, False), True, "cannot be told, below 7"),
        ((1.02, 0.9, 1.3, False), False, "not noticed, below 1.3"),
        ((1.02, 0.9, 1.3, False), None, "no significant loss, below 1.3"),
        ((1.02, 0.3, 7.0, False), None, "cannot be told, below 7"),
        ((1.001, 1.0, 1.002, True), None, "survives, below 1.01"),
        ((0.2, 0.1, 0.4, True), True, "survives, gains to 0.2, below 0.4"),  # no loss
        ((0.2, 0.1, 0.4, True), False, "no significant loss, gains to 0.2, below 0.4"),
        ((0.5, 0.1, 2.4, True), False, "cannot be told, gains to 0.5, below 2.4"),
        ((1.001, 1.0, 1.002, True), True, "survives, below 1.01"),  # resolved, and yet tiny
        ((1.001, 1.0, 1.002, True), False, "survives, below 1.01"),
        ((1.3, 1.0004, 1.72, True), True, "1.3 [1.0004, 1.72], mujoco ↔ dart"),  # never [1, …]
        ((0.996, 0.99, 0.9998, True), True, "survives, gains to 0.996, below 1"),
        ((1.02, 0.3, 2.004, False), True, "cannot be told, below 2.01"),  # and not below 2
        ((1.02, 0.3, 23.41, False), True, "cannot be told, below 23.5"),
    ],
)
def test_a_change_is_survived_if_it_is_noticed_and_costs_little(
    pair: tuple[float, float, float, bool], noticed: bool | None, words: str
) -> None:
    value, low, high, resolved = pair
    interactions = [_between(*_PAIR, value, low, high, resolved=resolved)]
    seen = {True: _SEEN, False: set[tuple[str, frozenset[str]]](), None: None}[noticed]
    table = survivors(interactions, 0, "at t = 1", seen)
    assert [row.texts for row in table.rows] == [("another engine on native data", words)]


def test_what_was_noticed_in_flight_is_not_survived_after_a_contact() -> None:
    """Older results say nothing of what models notice after the first contact."""
    path = Path(__file__).parents[2] / "reports/shift/balldrop-factors.json.gz"
    study = stored(path, Shift)
    older = tuple(msgspec.structs.replace(each, noticed=()) for each in study.after_contact)
    (table,) = [
        table
        for table in change_tables(msgspec.structs.replace(study, after_contact=older), 1)
        if "survives which change 10 frames after" in table.title
    ]
    (row,) = [row.texts for row in table.rows if row.texts[0] == "other settings in dart"]
    assert [text.split(",")[0] for text in row[1:]] == ["no significant loss"] * 4


def test_a_significant_ratio_never_reads_as_none() -> None:
    """Three digits as in the answers, and more where they would read as 1."""
    loss = _between(*_PAIR, 1.0213, 1.0004, 1234.5, resolved=True)
    none = _between(*_PAIR, 1.0213, 0.99996, 1.0417, resolved=False)

    assert texts_of(loss, 0) == ("1.02", "1.0004", "1234")
    assert texts_of(none, 0) == ("1.02", "1", "1.04")


def test_no_significant_pair_of_a_stored_study_reads_as_none() -> None:
    path = Path(__file__).parents[2] / "reports/shift/5pendulum-factors.json.gz"
    (table, *_) = [
        table
        for table in change_tables(stored(path, Shift), 0)
        if table.columns[2].heading == "ratio"
    ]

    significant = [row.texts[2:4] for row in table.rows if row.texts[4]]
    assert significant
    assert [row for row in significant if "1" in (row[0], *row[1].split())] == []


def test_the_dearest_pair_of_a_change_is_named_by_what_differs() -> None:
    interactions = [
        _between("mujoco-fine", "mujoco-coarse", 3.0, 2.0, 5.0, resolved=True),
        _between("mujoco-fine", "mujoco-soft", 8.0, 6.0, 9.0, resolved=True),
        _between("mujoco-coarse", "mujoco-soft", 1.0, 0.9, 1.1, resolved=False),
    ]
    table = survivors(interactions, 0, "at t = 1", set())
    assert [row.texts for row in table.rows] == [
        ("other settings in mujoco", "8 [6, 9], fine ↔ soft")
    ]


def test_a_pair_that_is_not_noticed_does_not_hide_one_that_cannot_be_told() -> None:
    interactions = [
        _between(*_PAIR, 1.0, 0.5, 3.0, resolved=False),
        _between("mujoco-native", "pybullet-native", 1.0, 0.99, 1.01, resolved=False),
    ]
    table = survivors(interactions, 0, "at t = 1", _SEEN)
    assert table.rows[0].texts[1] == "cannot be told, below 3"


def test_a_pair_that_cannot_be_told_is_not_hidden_by_one_that_is_survived() -> None:
    """All intervals count, also those of pairs that are neither noticed nor significant."""
    wide = _between("mujoco-native", "pybullet-native", 3.0, 0.8, 9.0, resolved=False)
    for first in (
        _between(*_PAIR, 1.01, 0.98, 1.05, resolved=False),
        _between(*_PAIR, 1.01, 1.0, 1.02, resolved=True),
    ):
        table = survivors([first, wide], 0, "at t = 1", _SEEN)
        assert table.rows[0].texts[1] == "cannot be told, below 9"
    unknown = Interaction("gns", *_PAIR, 3, (1.0,), (None,), (None,), (False,))
    assert survivors([wide, unknown], 0, "at t = 1", set()).rows[0].texts[1] == NONE


def test_a_gain_is_named_unless_a_loss_is_significant() -> None:
    gain = _between(*_PAIR, 0.74, 0.62, 0.87, resolved=True)
    loss = _between("mujoco-native", "pybullet-native", 1.05, 1.02, 1.085, resolved=True)
    words = [
        survivors(pairs, 0, "at t = 1", set()).rows[0].texts[1] for pairs in ([gain], [gain, loss])
    ]
    assert words == ["no significant loss, gains to 0.74, below 0.87", "survives, below 1.09"]
