"""Quantities are written for reading."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from mbds_xsim.checks.finding import Finding
from mbds_xsim.report import quantity


@pytest.mark.parametrize(
    ("metres", "text"),
    [
        (1.234, "1.2 m"),
        (0.9996, "1.0 m"),
        (0.0123, "12 mm"),
        (0.123, "123 mm"),
        (3.4e-5, "34 µm"),
        (5e-10, "0.5 nm"),
        (1e-15, "<0.1 nm"),
        (0.0, "0 m"),
        (2.5e7, "2.5e+07 m"),
        (14_900.0, "1.5e+04 m"),
        (-0.002, "-2.0 mm"),
        (None, "–"),
        (math.nan, "–"),
        (math.inf, "∞ m"),
    ],
)
def test_a_length_has_two_digits_and_a_fitting_unit(metres: float | None, text: str) -> None:
    assert quantity.length(metres) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(3.21e-7, "3.2e-07"), (0.0547, "0.055"), (1.5, "1.5"), (0.0, "0"), (123.4, "123")],
)
def test_a_number_keeps_its_size(value: float, text: str) -> None:
    assert quantity.number(value) == text


def test_other_units_take_no_prefix() -> None:
    assert quantity.with_unit(2e-5, "rad") == "2.0e-05 rad"
    assert quantity.with_unit(0.5, "") == "0.5"


@pytest.mark.parametrize(
    ("figure", "budget", "unit", "texts"),
    [
        (3.004, 3.0, "1", ("3.004", "3")),
        (1.0301e-3, 1e-3, "m", ("1.03 mm", "1 mm")),
        (1.2e-3, 1e-3, "m", ("1.2 mm", "1.0 mm")),
        (2.999, 3.0, "1", ("3", "3")),
        (2e-11, 1e-11, "m", ("0.02 nm", "0.01 nm")),
        (0.013000000000000001, 0.013, "m", ("0.013000000000000001 m", "0.012999999999999999 m")),
        (None, 1e-3, "m", ("–", "1.0 mm")),
        (1.0, None, "1", ("1", "–")),
    ],
)
def test_a_figure_over_its_budget_never_reads_as_kept(
    figure: float | None, budget: float | None, unit: str, texts: tuple[str, str]
) -> None:
    assert quantity.beside(figure, budget, unit) == texts


def test_a_figure_that_passed_over_its_budget_says_why() -> None:
    assert quantity.beside(22e-3, 4e-3, "s", passed=True) == ("22 ms", "4.0 ms + uncertainty")
    assert quantity.beside(3e-3, 4e-3, "s", passed=True) == ("3.0 ms", "4.0 ms")


@example(0.013, 0.0, "m")
@given(st.floats(1e-15, 1e5), st.floats(0.0, 1e-2), st.sampled_from(["m", "s", "1", "rad"]))
def test_texts_of_a_figure_and_its_budget_differ(budget: float, excess: float, unit: str) -> None:
    figure = math.nextafter(budget * (1.0 + excess), math.inf)
    shown, allowed = quantity.beside(figure, budget, unit)
    assert shown != allowed

    finding = Finding.of("gap", unit, np.array([[[figure]]]), budget=budget)
    line = finding.line(0)
    assert line.removeprefix("gap: ").split(f" {unit}, allowed ")[0] != line.split()[-1]
