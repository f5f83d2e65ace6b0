"""Trade-offs with contact: when the error is taken, and what it is held against."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base.isolate import HERE
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Clock
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.simulator import EngineMethod
from mbds_xsim.studies.tradeoff import bench
from mbds_xsim.studies.tradeoff.bench import LIMIT_COUNT
from mbds_xsim.studies.tradeoff.curves import OWN_LIMIT, curve_results
from tests.study.tradeoffs import ROW, curve_of, shortened, studied

pytestmark = pytest.mark.usefixtures("few_steps")


def test_a_row_says_when_the_error_of_its_own_start_was_taken() -> None:
    short = shortened("simplecubli", 40)
    starts = draw_batch(short, [1, 4], seed=0)
    known = reference.solve(short, starts)
    ends = [failure.frame * short.clock.frame for failure in known.failures if failure]
    truths = [bench.Truth(known[[row]], np.ones((1, starts.steps + 1))) for row in range(2)]
    workbench = bench.StartBench(short, starts, truths, 0, 30.0, HERE)

    cases = [workbench._case(bench.Job(EngineMethod("mujoco", "RK4"), 1, row)) for row in range(2)]

    last = [pytest.approx(end - short.clock.frame) for end in ends]
    assert [case.row.horizon_s for case in cases] == last
    assert len({case.row.horizon_s for case in cases}) == 2
    assert workbench.horizon == min(case.row.horizon_s for case in cases)


def test_contact_without_a_unique_answer_ends_the_error_at_the_first_impact() -> None:
    short = shortened("simplecubli", 60)

    study = studied(short, "mujoco", starts=1)

    assert study.reference_ends_s is not None
    assert study.horizon_s <= study.reference_ends_s < 0.8
    assert study.horizon_s > 0.2
    assert curve_of(study, "mujoco RK4").points[0].error_m < 1e-6
    assert not any("error at 1 s" in point.broken for c in study.curves for point in c.points)


def test_contact_from_the_start_holds_each_method_to_its_own_limit() -> None:
    short = shortened("particlecar", 4)

    study = studied(short, "pybullet")

    assert study.own_limit == LIMIT_COUNT
    points = curve_of(study, "pybullet semi-implicit-euler").points
    errors = [point.error_m for point in points]
    assert all(coarse > fine > 0 for coarse, fine in pairwise(errors))
    assert all("error at 1 s" not in point.broken for point in points)
    allowed = short.budget.error_1s * short.length
    assert [OWN_LIMIT in point.broken for point in points] == [e > allowed for e in errors]
    assert max(point.steps_per_frame for point in points) < LIMIT_COUNT
    assert studied(short, "pybullet").measured == 0


def test_a_limit_of_other_options_is_another_and_its_time_is_a_frame() -> None:
    short = shortened("particlecar", 4)
    slow = msgspec.structs.replace(short, clock=Clock(0.3, 4))
    starts = draw_batch(slow, [1], seed=0)
    unknown = bench.Truth(reference.solve(slow, starts), np.ones((1, 5)))
    curve = EngineMethod("exudyn", "trapezoidal", own_options={})

    def key(usual: float, own: float) -> str:
        usually = replace(curve, own_options={"slip_speed": usual})
        known = {("exudyn", "trapezoidal"): usually}
        workbench = bench.StartBench(slow, starts, [unknown], 0, 30.0, HERE, usual=known)
        changed = replace(curve, own_options={"slip_speed": own})
        row = workbench._case(bench.Job(changed, 2, 0)).row
        assert row.horizon_s == workbench.horizon == pytest.approx(0.9)
        return row.key

    assert key(1e-3, 1e-4) == key(1e-3, 1e-4)
    assert len({key(1e-3, 1e-4), key(1e-4, 1e-4), key(1e-2, 1e-4)}) == 3


@pytest.mark.parametrize("own_limit", [True, False])
def test_without_a_limit_of_its_own_nothing_is_near_it(own_limit: bool) -> None:
    car = registry.load_scene("particlecar")
    curve = EngineMethod("pybullet", "semi-implicit-euler", own_options={})

    (result,) = curve_results(car, [curve], [[[ROW]]], own_limit=own_limit)

    assert result.points[0].broken == ((OWN_LIMIT,) if own_limit else ())


@pytest.mark.parametrize("own_limit", [True, False])
def test_a_run_is_not_compared_with_itself(own_limit: bool) -> None:
    """Fifty contact substeps at 1 ms are the same steps as five at 0.1 ms, the limit's own."""
    car = registry.load_scene("particlecar")
    curve = EngineMethod("exudyn", "trapezoidal", variation="contact_substeps = 50", own_options={})
    row = msgspec.structs.replace(ROW, error_m=0.0, error_weighted_m=0.0)

    (result,) = curve_results(car, [curve], [[[row]]], own_limit=own_limit)

    (point,) = result.points
    assert (point.error_m is None, point.on_front) == (own_limit, not own_limit)
    assert not point.broken
