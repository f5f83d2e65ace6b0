"""Models that are right, slightly wrong, and of another order than they declare."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.checks import Finding
from mbds_xsim.checks.consistency import Consistency
from mbds_xsim.checks.extrapolation import extrapolate
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Inertia, Joint, Scene
from mbds_xsim.scene.state import Failure, Trajectory
from mbds_xsim.simulate.claims import Method

METHODS = {
    "euler_reduced": (Method("Euler", "semi-implicit Euler", 1), (2, 4, 8)),
    "midpoint": (Method("midpoint", "trapezoidal", 2), (2, 4, 8)),
    "rk4": (Method("RK4", "RK4", 4), (1, 2, 4)),
}


def consistency(*about: Any, **more: Any) -> list[Finding]:
    return Consistency(*about, **more).findings


def _lighter(scene: Scene) -> Scene:
    return msgspec.structs.replace(scene, gravity=(0.0, 0.0, -9.80))


def _heavier(scene: Scene) -> Scene:
    bodies = list(scene.bodies)
    (particle,) = bodies[1].particles
    heavy = msgspec.structs.replace(particle, mass=1.01 * particle.mass)
    bodies[1] = msgspec.structs.replace(bodies[1], particles=(heavy,))
    return msgspec.structs.replace(scene, bodies=tuple(bodies))


def _same(scene: Scene) -> Scene:
    return scene


@pytest.fixture(scope="module")
def runs(
    pendulum: Any, simulate: Callable[..., Trajectory]
) -> Callable[[str, Callable[[Scene], Scene]], list[Trajectory]]:
    known: dict[tuple[str, Callable[[Scene], Scene]], list[Trajectory]] = {}

    def give(stepper: str, change: Callable[[Scene], Scene]) -> list[Trajectory]:
        if (stepper, change) not in known:
            scene = change(pendulum.scene)
            known[stepper, change] = [
                simulate(scene, pendulum.batch, count, stepper) for count in METHODS[stepper][1]
            ]
        return known[stepper, change]

    return give


@pytest.mark.parametrize("stepper", METHODS)
def test_a_right_model_converges_to_the_reference(pendulum: Any, runs: Any, stepper: str) -> None:
    findings = _found(pendulum, runs, stepper, _same)
    assert [finding.check for finding in findings] == [
        "consistency of positions",
        "consistency of energy",
    ]
    for finding in findings:
        assert finding.passed.all()
        assert (np.isfinite(finding.series).sum(axis=1) >= 10).all()


@pytest.mark.parametrize("change", [_lighter, _heavier])
@pytest.mark.parametrize("stepper", METHODS)
def test_a_slightly_wrong_model_shows(
    pendulum: Any, runs: Any, stepper: str, change: Callable[[Scene], Scene]
) -> None:
    """Gravity is off by 0.1 % or one particle by 1 %, both within the accuracy budget."""
    for finding in _found(pendulum, runs, stepper, change):
        assert not finding.passed.any()


def _found(
    pendulum: Any, runs: Any, stepper: str, change: Callable[[Scene], Scene]
) -> list[Finding]:
    method = METHODS[stepper][0]
    motions = runs(stepper, change)
    scene, batch, exact = pendulum.scene, pendulum.batch, pendulum.exact
    return consistency(scene, batch, motions, exact, method, resolution=1e-8)


def test_two_runs_pass_a_right_model_and_show_a_wrong_one(pendulum: Any, runs: Any) -> None:
    for change, passes in ((_same, True), (_lighter, False)):
        for finding in consistency(
            pendulum.scene,
            pendulum.batch,
            runs("rk4", change)[:2],
            pendulum.exact,
            METHODS["rk4"][0],
            resolution=1e-8,
        ):
            assert (finding.passed == passes).all()


def test_a_method_of_another_order_than_declared_does_not_pass(pendulum: Any, runs: Any) -> None:
    declared = METHODS["midpoint"][0]
    for finding in consistency(
        pendulum.scene, pendulum.batch, runs("euler_reduced", _same), pendulum.exact, declared
    ):
        assert not finding.passed.any()
        assert np.isnan(finding.figure).all()
        assert finding.where[0].startswith(("order 0.9", "order 1.0"))


class _Constrained(Method):
    """Method whose velocities carry constraint forces of first order."""

    def velocity_order_for(self, scene: Scene) -> int:
        return self.order_for(scene) - 1


@pytest.mark.parametrize("change", [_same, _lighter])
def test_energies_may_have_the_order_that_is_declared_of_velocities(
    pendulum: Any, runs: Any, change: Callable[[Scene], Scene]
) -> None:
    off = [
        dataclasses.replace(run, velocity=run.velocity * (1.0 + 4e-3 * 0.5**k))
        for k, run in enumerate(runs("midpoint", change))
    ]
    strict = METHODS["midpoint"][0]
    lax = _Constrained(strict.name, strict.family, strict.order)

    about = (pendulum.scene, pendulum.batch, off, pendulum.exact)
    places, energy = consistency(*about, lax, resolution=1e-8)
    right = change is _same
    assert places.passed.all() == right
    assert energy.passed.all() == right
    assert np.isfinite(energy.figure).all()
    assert "order 2 of positions and 1 of velocities declared" in energy.note
    assert not consistency(*about, strict, resolution=1e-8)[1].passed.any()


def test_times_of_large_growth_are_not_judged(pendulum: Any, runs: Any) -> None:
    growth = np.ones((3, 41))
    growth[:, 15:] = 200.0
    for finding in consistency(
        pendulum.scene,
        pendulum.batch,
        runs("midpoint", _same),
        pendulum.exact,
        METHODS["midpoint"][0],
        growth=growth,
    ):
        assert np.isnan(finding.series[:, 15:]).all()
        assert finding.passed.all()


def test_the_limit_of_a_series_in_the_step_is_found_within_its_uncertainty() -> None:
    """Extrapolation of the values 1 + h + 0.3 h² leaves an error from the square."""

    def at(h: float) -> Array:
        return np.full((1, 1, 1), 1.0 + h + 0.3 * h**2)

    floor = np.full((1, 1), 1e-12)
    estimate = extrapolate([at(0.1), at(0.05), at(0.025)], 1, floor)
    error = abs(estimate.limit[0, 0, 0] - 1.0)
    assert error == pytest.approx(0.3 * 0.05 * 0.025)  # 0.3 · h · h/2 is the remainder
    assert 0.5 * error < estimate.uncertainty[0, 0] < 2 * error
    assert estimate.asymptotic.all()
    assert estimate.order[0, 0] == pytest.approx(1.0, abs=0.05)


def test_faster_convergence_than_declared_is_no_fault() -> None:
    """The two terms of 1 + c h² + h⁴, declared of order 2, may cancel in a difference."""

    def at(h: float, second: float) -> Array:
        return np.full((1, 1, 1), 1.0 + second * h**2 + h**4)

    for second in (0.0, 3e-4, -3e-4, -0.8e-3):
        runs = [at(h, second) for h in (0.1, 0.05, 0.025)]
        estimate = extrapolate(runs, 2, np.full((1, 1), 1e-12))
        assert estimate.asymptotic.all()
        assert estimate.order[0, 0] > 2.25
        error = abs(estimate.limit[0, 0, 0] - 1.0)
        assert 0.1 * estimate.uncertainty[0, 0] < error < estimate.uncertainty[0, 0]


def test_a_wrong_model_shows_though_it_converges_faster_than_declared(
    pendulum: Any, runs: Any
) -> None:
    declared = METHODS["euler_reduced"][0]
    for change, passes in ((_same, True), (_lighter, False)):
        places = consistency(
            pendulum.scene,
            pendulum.batch,
            runs("midpoint", change),
            pendulum.exact,
            declared,
            resolution=1e-8,
        )[0]
        assert places.passed.all() == passes


def test_one_run_cannot_be_extrapolated() -> None:
    with pytest.raises(InputError, match="allowed are 2 or 3"):
        extrapolate([np.zeros((1, 1, 1))], 1, np.zeros((1, 1)))


def test_short_motions_are_judged_from_their_first_frame(pendulum: Any, runs: Any) -> None:
    def cut(motion: Trajectory) -> Trajectory:
        fields = ("position", "orientation", "velocity", "angular_velocity")
        first = {name: getattr(motion, name)[:, :8] for name in fields}
        return dataclasses.replace(motion, time=motion.time[:8], **first)

    for finding in consistency(
        pendulum.scene,
        pendulum.batch.truncated(7),
        [cut(motion) for motion in runs("midpoint", _same)],
        cut(pendulum.exact),
        METHODS["midpoint"][0],
        resolution=1e-8,
    ):
        assert np.isfinite(finding.series).all()
        assert finding.passed.all()


def _off(
    exact: Trajectory, errors: Sequence[float] | NDArray[Any], stops: int | None = None
) -> list[Trajectory]:
    """Return runs raised by `errors` at the end, and in proportion to time before [m]."""
    share = np.linspace(0.0, 1.0, len(exact.time))[None, :, None, None] * np.array([0.0, 0.0, 1.0])
    runs = [dataclasses.replace(exact, position=exact.position + e * share) for e in errors]
    if stops is not None:
        fields = ("position", "orientation", "velocity", "angular_velocity")
        lost = {name: getattr(runs[0], name).copy() for name in fields}
        for values in lost.values():
            values[:, stops:] = np.nan
        end = (Failure(stops, "its solver gave up"),) * len(exact)
        runs[0] = dataclasses.replace(runs[0], **lost, failures=end)
    return runs


_SECOND = Method("RK4", "RK4", 2)
# MuJoCo's errors on a slider-crank at 10, 5, 2.5 ms and so on [m]: the order passes the declared
# one on its way from 0 to nearly 4.
_RISING = (4.27e-4, 2.34e-4, 7.35e-5, 1.595e-5, 2.52e-6, 3.2e-7)


@pytest.mark.parametrize("first", [0, 1])
def test_an_order_that_rises_through_the_declared_one_fails_nobody(
    pendulum: Any, first: int
) -> None:
    runs = _off(pendulum.exact, _RISING)
    about = (pendulum.scene, pendulum.batch)

    assert Consistency(*about, runs[first : first + 3], pendulum.exact, _SECOND).unsettled
    for finding in consistency(*about, runs[first : first + 5], pendulum.exact, _SECOND):
        assert finding.passed.all()
        assert np.isfinite(finding.figure).all()
    assert not Consistency(*about, runs[first : first + 5], pendulum.exact, _SECOND).unsettled


def test_an_order_that_stays_below_is_not_measurable_while_it_rises(pendulum: Any) -> None:
    runs = _off(pendulum.exact, (1.37e-3, 5.7e-4, 1.7e-4, 5e-5))
    for finding in consistency(
        pendulum.scene, pendulum.batch, runs, pendulum.exact, Method("RK4", "RK4", 4)
    ):
        assert finding.passed.all()
        assert not finding.applies.any()
        assert (
            "trajectory 0, 1, 2: not measurable, because the order still rises as steps are "
            "halved, order 1.00, 1.74"
        ) in finding.note


@pytest.mark.parametrize("order", [1.0, 0.0], ids=["first order", "none"])
def test_a_lower_order_than_declared_or_none_is_told_by_four_runs(
    pendulum: Any, order: float
) -> None:
    moves = np.cumsum([2e-3 * 2.0 ** (-order * k) * (-1.0) ** (k * (order == 0)) for k in range(5)])
    runs = _off(pendulum.exact, moves[-1] - moves)
    for finding in consistency(pendulum.scene, pendulum.batch, runs, pendulum.exact, _SECOND):
        assert not finding.passed.any()
        assert "nowhere as high as declared" in finding.where[0]


def test_three_runs_refuse_no_order_where_joints_run_into_stops(pendulum: Any) -> None:
    """Errors at stops fall irregularly: the change between finer runs may be the larger one."""
    joints = list(pendulum.scene.joints)
    hinge = Joint("pin", "hinge", "world", "stopped", (0, 0, 0), (1, 0, 0), limits=(-1.0, 1.0))
    body = Body("stopped", inertia=Inertia(1.0, (0.1,) * 3), position=(0.0, 0.0, -1.0))
    bodies = (*pendulum.scene.bodies, body)
    scene = msgspec.structs.replace(pendulum.scene, bodies=bodies, joints=(*joints, hinge))
    batch = draw_batch(scene, pendulum.batch.index.tolist())
    exact = solve(scene, batch, cache=False)

    def findings(errors: Sequence[float]) -> list[Finding]:
        return consistency(scene, batch, _off(exact, errors), exact, METHODS["rk4"][0])

    for finding in findings((9e-4, 6e-4, 2e-5)):
        assert finding.passed.all()
        assert not finding.applies.any()
        assert "three runs do not tell how errors of bumps fall, order -0.95" in finding.note
    for finding in findings((9e-2, 8e-2, 7e-2)):
        assert not finding.passed.any()
    for finding in findings((0.0, 1e-3, -1e-3, 3e-3, -5e-3)):
        assert "nowhere as high as declared" in finding.where[0]


def test_an_impact_just_before_a_frame_shows_in_what_runs_differ_by_at_the_next() -> None:
    """All runs have the same error at frame 12, and different errors after it."""
    late = np.maximum(np.arange(25) - 12, 0)
    runs = [
        (1e-6 * (late >= 0) * (np.arange(25) >= 12) + h * late)[None, :, None] for h in (4, 2, 1)
    ]
    floor = np.full((1, 25), 1e-9)

    estimate = extrapolate(runs, 1, floor, bumps=True)

    assert (np.abs(estimate.limit[..., 0]) <= 3.0 * estimate.uncertainty)[0, :13].all()
    assert (estimate.uncertainty[0, :12] <= 1e-8).all()


def test_a_wrong_limit_shows_though_the_order_cannot_be_measured(pendulum: Any) -> None:
    errors = 3e-2 + np.array((9e-4, 8e-4, 6.3e-4, 4e-4))
    runs = _off(pendulum.exact, errors)
    about = pendulum.scene, pendulum.batch, runs, pendulum.exact, Method("RK4", "RK4", 4)
    for finding in consistency(*about):
        assert not finding.passed.any()
        assert "further from the reference than any explains" in finding.where[0]
    assert not Consistency(*about).unsettled


def test_a_run_of_the_check_that_stops_is_told_and_a_finer_one_asked_for(pendulum: Any) -> None:
    errors = 1e-4 * 4.0 ** -np.arange(4)
    runs = _off(pendulum.exact, errors, stops=6)
    about = (pendulum.scene, pendulum.batch)

    assert Consistency(*about, runs[:3], pendulum.exact, _SECOND).unsettled
    for finding in consistency(*about, runs[:3], pendulum.exact, _SECOND):
        assert finding.passed.all()
        assert "not measurable, because the coarsest run" in finding.note
    assert not Consistency(*about, runs, pendulum.exact, _SECOND).unsettled
    for finding in consistency(*about, runs, pendulum.exact, _SECOND):
        assert finding.passed.all()
        assert finding.where[0] == "judged from 0.00 to 0.80 s"
        assert "stopped at frame 6 (its solver gave up)" in finding.note


def test_the_declared_order_over_little_of_the_motion_asks_for_finer_runs(pendulum: Any) -> None:
    runs = _off(pendulum.exact, 1e-4 * 4.0 ** -np.arange(3))
    late = dataclasses.replace(runs[2], position=runs[2].position.copy())
    late.position[:, 15:] += 1e-3
    about = (pendulum.scene, pendulum.batch)

    assert not Consistency(*about, runs, pendulum.exact, _SECOND).unsettled
    assert Consistency(*about, [*runs[:2], late], pendulum.exact, _SECOND).unsettled
