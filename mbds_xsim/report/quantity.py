"""Quantities in readable form: two digits, and a unit that suits the size."""

from __future__ import annotations

import math

from mbds_xsim.base.text import apart

NONE = "–"
"""Text for a missing figure."""

_PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))
_SMALLEST = 0.1
_PLAIN = ("", "1")
_THREE_DIGITS = 999.5
"""Number that needs no digit after the point to be written in three."""
_ROUNDED = 15
"""Number of digits above which division by a prefix can make two numbers equal."""


def length(metres: float | None) -> str:
    """Write a length [m]: `1.2 mm`."""
    return with_unit(metres, "m")


def span(seconds: float | None) -> str:
    """Write a time [s]: `35 ms`."""
    return with_unit(seconds, "s")


def pace(step: float, rtol: float | None) -> str:
    """Write a step [s], or the relative tolerance in its place: `rtol 1e-09`."""
    return span(step) if rtol is None else f"rtol {rtol:.0e}"


def beside(
    figure: float | None, budget: float | None, unit: str, *, passed: bool = False
) -> tuple[str, str]:
    """Write a figure and its budget, with more digits if a broken budget would read as kept.

    A figure over its budget that has `passed` is within the uncertainty of its check.
    """
    if figure is None or budget is None:
        return with_unit(figure, unit), with_unit(budget, unit)
    texts = apart(figure, budget, lambda value, digits: with_unit(value, unit, digits), 2)
    return (texts[0], f"{texts[1]} + uncertainty") if passed and figure > budget else texts


def number(value: float | None, digits: int = 2) -> str:
    """Write a plain number; very small and large ones with an exponent: `3.2e-07`, `1.5`, `0`."""
    if value is None or math.isnan(value):
        return NONE
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if digits > 2 or 0.01 <= abs(value) < 99.5:
        return f"{value:.{digits}g}"
    return f"{value:.0f}" if value == 0 or 1 <= abs(value) < 1e4 else f"{value:.1e}"


def ratio(value: float | None, *, significant: bool = False) -> str:
    """Write a ratio in three digits; one that differs from 1 significantly never reads as 1."""
    if value is None or not math.isfinite(value) or abs(value) >= _THREE_DIGITS:
        return number(value)
    texts = (f"{value:.{digits}g}" for digits in range(3, _ROUNDED))
    return next((text for text in texts if not significant or text != "1"), "1")


def with_unit(value: float | None, unit: str, digits: int = 2) -> str:
    """Write a value with a prefix before its unit if that is m or s, else as a number."""
    if value is None or not math.isfinite(value) or value == 0 or unit not in ("m", "s"):
        text = number(value, digits)
        return text if text == NONE or unit in _PLAIN else f"{text} {unit}"
    if digits > _ROUNDED:
        return f"{value:.{digits}g} {unit}"
    scale, prefix = next((p for p in _PREFIXES if abs(value) >= 0.9995 * p[0]), _PREFIXES[-1])
    scaled = value / scale
    if digits > 2:
        return f"{scaled:.{digits}g} {prefix}{unit}"
    if abs(scaled) < _SMALLEST:
        return f"<{_SMALLEST} {prefix}{unit}"
    return f"{_two_digits(scaled)} {prefix}{unit}"


def _two_digits(value: float) -> str:
    """Write two digits, or all before the point: `1.2`, `12`, `123`, from 10 000 on `1.5e+04`."""
    if abs(value) >= 1e4:
        return f"{value:.1e}"
    return f"{value:.1f}" if abs(value) < 9.95 else f"{value:.0f}"
