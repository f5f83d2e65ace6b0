"""Quantities are written for reading."""

from __future__ import annotations

import math

import pytest

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
        (2.5e7, "2e+07 m"),
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
