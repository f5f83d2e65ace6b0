"""Steps that divide a frame."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mbds_xsim.base.errors import InputError
from mbds_xsim.simulate.adapter import Settings, careful_step, nearest_step

INTERVALS = st.floats(1e-6, 10.0)


@given(INTERVALS, INTERVALS, st.integers(1, 1000))
def test_careful_steps_keep_both_bounds(frame: float, longest: float, fewest: int) -> None:
    step = careful_step(frame, longest, fewest)
    count = Settings("any", step).substeps(frame)
    assert step <= longest * (1 + 1e-8)
    assert count >= fewest
    assert count % 4 == 0
    # No finer than the bounds and the multiple ask for.
    coarser = count - 4
    assert coarser < fewest or frame / coarser > longest


def test_no_preset_goes_below_a_microsecond() -> None:
    assert careful_step(0.02, 8.4e-11, 4) == pytest.approx(1e-6)


@pytest.mark.parametrize(("usual", "count"), [(1 / 240, 5), (0.002, 10), (0.001, 20), (1.0, 1)])
def test_usual_steps_are_moved_to_the_nearest_divisor(usual: float, count: int) -> None:
    assert nearest_step(0.02, usual) == pytest.approx(0.02 / count)


@pytest.mark.parametrize("step", [0.0, -0.02, 0.003, 0.04, math.nan, math.inf, 1e-12, 5e-324, "1"])
def test_a_step_that_no_engine_takes_is_refused(step: Any) -> None:
    """Far too short ones as well: an engine cannot count them, which is no fault of its own."""
    with pytest.raises(InputError, match=r"frame interval 0\.02 s divided by a whole number below"):
        Settings("any", step).substeps(0.02)
