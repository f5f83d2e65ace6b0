"""Front, cost at an accuracy and measured order, against brute force and hand-made curves."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mbds_xsim.studies.tradeoff.curves import cost_at, front, order_of

# Few values, so that ties and equal pairs are common.
_VALUES = st.sampled_from([0.1, 0.2, 0.5, 1.0, 3.0])
_PAIRS = st.lists(st.tuples(_VALUES, _VALUES), max_size=12)
_POSITIVE = st.floats(1e-9, 1e3)
_CURVE = st.lists(st.none() | st.tuples(_POSITIVE, _POSITIVE), max_size=8)


@given(_PAIRS)
def test_the_front_is_what_nothing_dominates(pairs: list[tuple[float, float]]) -> None:
    def dominated(one: tuple[float, float]) -> bool:
        return any(a <= one[0] and b <= one[1] and (a, b) != one for a, b in pairs)

    assert front(pairs) == {k for k, pair in enumerate(pairs) if not dominated(pair)}


def test_between_points_the_cost_is_interpolated_in_logarithms() -> None:
    curve = [(0.01, 1e-1), (0.1, 1e-3), (1.0, 1e-5)]

    assert cost_at(curve, 1e-2) == pytest.approx(10**-1.5)
    assert cost_at(curve, 1e-3) == pytest.approx(0.1)
    assert cost_at(curve, 1e-4) == pytest.approx(10**-0.5)


def test_beyond_its_points_a_curve_is_not_extended() -> None:
    curve = [(0.01, 1e-1), (0.1, 1e-3)]

    assert cost_at(curve, 1e-4) is None
    assert cost_at(curve, 1.0) == 0.01
    assert cost_at([], 1.0) is None


def test_a_failed_point_is_not_bridged() -> None:
    assert cost_at([(0.01, 1e-1), None, (1.0, 1e-5)], 1e-3) == 1.0


def test_a_detour_of_the_curve_does_not_hide_its_cheapest_crossing() -> None:
    curve = [(0.01, 1e-2), (0.1, 1e-4), (0.2, 1e-2), (1.0, 1e-6)]

    assert cost_at(curve, 1e-3) == pytest.approx(10**-1.5)


@pytest.mark.parametrize("curve", [[(0.01, 0.0), (1.0, 1e-2)], [(0.01, 1e-2), (1.0, 0.0)]])
def test_an_error_of_exactly_0_has_a_cost_like_any_other(curve: list[tuple[float, float]]) -> None:
    cost = cost_at(curve, 1e-3)

    assert cost is not None
    assert 0.01 <= cost <= 1.0


@given(_CURVE, _POSITIVE, _POSITIVE)
def test_more_accuracy_never_costs_less(
    curve: list[tuple[float, float] | None], one: float, other: float
) -> None:
    loose, tight = (cost_at(curve, error) for error in (max(one, other), min(one, other)))

    if tight is not None:
        assert loose is not None
        assert loose <= tight * (1 + 1e-9)
        known = [point[0] for point in curve if point is not None]
        assert min(known) * (1 - 1e-9) <= tight <= max(known) * (1 + 1e-9)


@pytest.mark.parametrize("order", [1.0, 2.0, 4.0])
def test_the_order_is_read_off_the_asymptotic_part(order: float) -> None:
    steps = [0.02 / 2**k for k in range(12)]
    # Saturated at first, then of one order, at last the accuracy of the reference.
    pairs = [(h, min(0.5, (h / 0.01) ** order) + 1e-10) for h in steps]

    measured = order_of(pairs, length=1.0, floor=1e-8)

    assert measured == pytest.approx(order, abs=0.05)


def test_an_error_that_stalls_has_order_zero() -> None:
    pairs = [(0.02 / 2**k, 1e-3) for k in range(6)]

    assert order_of(pairs, length=1.0, floor=1e-9) == pytest.approx(0.0, abs=1e-9)


def test_scattered_or_few_points_have_no_order() -> None:
    scattered = [(0.02 / 2**k, 1e-3 * (10.0 if k % 2 else 1.0)) for k in range(6)]

    assert order_of(scattered, length=1.0, floor=1e-9) is None
    assert order_of([(0.02, 1e-3), (0.01, 5e-4)], length=1.0, floor=1e-9) is None
    assert order_of([(0.02, math.nan)] * 5, length=1.0, floor=1e-9) is None
