"""Maps of stability: known limits are met, every way of failing is reported as what it is."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base.errors import InputError, UnknownName
from mbds_xsim.base.isolate import HERE, Conduct
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Failure, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.studies.stability import FRAME, MapCell, Study, Survey
from mbds_xsim.studies.stability import survey as surveys
from mbds_xsim.studies.stability.studies import STUDIES, study_named
from mbds_xsim.studies.stability.survey import SurveyPlan, survey
from mbds_xsim.studies.stability.verdict import judge, meaning, reporter_of, run_cell, signs_of
from tests.plugins import faulty


@pytest.fixture(autouse=True)
def _apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep cells and references apart."""
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path / "cache"))


_BLIND = dataclasses.replace(STUDIES["stiffness"], known=False)
"""Study without the reference, which takes longer than all the rest."""


def _sweep(study: Study, engine: str, method: str, **how: Any) -> Survey:
    plan = SurveyPlan(study, (engine,), (method,), profiles=("matched",), conduct=HERE)
    return survey(dataclasses.replace(plan, **how))


def _cell(engine: str, method: str, stiffness: float, count: int) -> MapCell:
    (cell,) = _sweep(_BLIND, engine, method, values=(stiffness,), counts=(count,)).cells
    return cell


def _stiffness_at(limit: float, count: int) -> float:
    """Stiffness at which a step is `limit` over the spring's rate: h √k = limit."""
    return (limit * count / FRAME) ** 2


@pytest.mark.parametrize(
    ("simulator", "method", "limit"),
    [
        ("mujoco", "Euler", 2.0),
        ("pybullet", "semi-implicit-euler", 2.0),
        ("dart", "semi-implicit-euler", 2.0),
        ("mujoco", "RK4", 2.0 * math.sqrt(2.0)),
        ("dart", "forward-dynamics-RK4", 2.0 * math.sqrt(2.0)),
        ("exudyn", "RK44", 2.0 * math.sqrt(2.0)),
    ],
)
def test_explicit_methods_fail_beyond_their_known_limit(
    simulator: str, method: str, limit: float
) -> None:
    below = _cell(simulator, method, _stiffness_at(0.94 * limit, 10), 10)
    above = _cell(simulator, method, _stiffness_at(1.06 * limit, 10), 10)

    assert not below.failed, below
    assert above.outcome in ("gains energy", "blows up"), above
    assert above.broke_s is not None


@pytest.mark.parametrize("method", ["trapezoidal", "generalised-alpha"])
def test_implicit_methods_bear_any_stiffness(method: str) -> None:
    assert not _cell("exudyn", method, _stiffness_at(20.0, 10), 10).failed


def test_the_engine_that_warns_is_told_from_those_that_do_not() -> None:
    stiffness = _stiffness_at(5.0, 10)

    loud = _cell("mujoco", "RK4", stiffness, 10)
    watched = _cell("pybullet", "semi-implicit-euler", stiffness, 10)
    quiet = _cell("pybullet", "semi-implicit-euler", _stiffness_at(2.1, 2), 2)

    assert (loud.told, loud.silent) == ("engine", False)
    assert "QACC" in loud.reason
    assert (watched.told, watched.silent) == ("adapter", True)
    assert (quiet.told, quiet.silent, quiet.reason) == ("nobody", True, "")


@pytest.mark.parametrize(
    ("reason", "teller", "what"),
    [
        ("DART: Warning Non-finite relative transform detected", "engine", "blows up"),
        ("Nan, Inf or huge value in QACC at DOF 0. The simulation is", "engine", "blows up"),
        ("Newton's method stopped at a residual of 3 after 25 steps", "engine", "gives up"),
        ("the linear solver failed: the system is singular", "engine", "gives up"),
        ("SolverError: reduction of step size reached minimum step size", "engine", "gives up"),
        ("DART's contact solver failed and a pyramid took the place of it", "adapter", "gives up"),
        ("contacts solved to 0.023 m/s only", "adapter", "gives up"),
        ("a body turns by 1.2 rad in a step, the engine cuts that at π/4", "adapter", "clamped"),
        ("hits the ground at 150 m/s: DART cuts rebounds to 100 m/s", "adapter", "clamped"),
        ("blow-up: 1e+06 m/s or rad/s, the engine cuts at 1e+06", "adapter", "blows up"),
        ("a body's speed passes 1e+04 m/s or is not a number", "adapter", "blows up"),
        ("contact sphere 0 is 0.574 m in the ground", "adapter", "sinks in"),
        ("the wire broke", "adapter", "ends early"),
    ],
)
def test_reasons_are_read_as_who_noticed_what(reason: str, teller: str, what: str) -> None:
    failure = Failure(3, reason)

    assert (reporter_of(failure), meaning(failure)) == (teller, what)


@dataclasses.dataclass(frozen=True)
class _Known:
    """A scene with its exact motion, to be spoilt."""

    scene: Scene
    truth: Trajectory

    def verdict(self, **spoilt: Any) -> Any:
        study = STUDIES["swing"]
        motion = dataclasses.replace(self.truth, **spoilt)
        method = registry.load_adapter("mujoco").methods["RK4"]
        record = Record(self.scene, study.batch(self.scene), motion, method, FRAME)
        return SimpleNamespace(**judge(signs_of(record, self.truth), motion.failures[0]))


@pytest.fixture
def known() -> _Known:
    study = STUDIES["swing"]
    scene = study.scene(0.0)
    return _Known(scene, reference.solve(scene, study.batch(scene)))


def test_the_exact_motion_is_stable(known: _Known) -> None:
    verdict = known.verdict()

    assert (verdict.outcome, verdict.told, verdict.broke_s) == ("stable", "nobody", None)
    assert verdict.error == 0.0
    assert verdict.way == 1.0
    assert verdict.ended_s == pytest.approx(1.0)


def test_a_motion_that_stands_still_is_stuck(known: _Known) -> None:
    shape = known.truth.position.shape
    still = {
        name: np.broadcast_to(getattr(known.truth, name)[:, :1], (*shape[:3], size)).copy()
        for name, size in (("position", 3), ("orientation", 4), ("velocity", 3))
    }
    still["angular_velocity"] = np.zeros(shape)

    verdict = known.verdict(**still)

    assert verdict.outcome == "stuck"
    assert verdict.way == 0.0


def test_a_motion_that_passes_its_start_again_is_not_stuck(known: _Known) -> None:
    position = known.truth.position.copy()
    position[:, 1] = position[:, 0]
    position[:, 2] = position[:, 0]

    assert known.verdict(position=position).outcome != "stuck"


def test_a_joint_that_opens_is_told_with_when(known: _Known) -> None:
    position = known.truth.position.copy()
    position[:, 4:, 1, 0] += 0.011 * known.scene.length

    verdict = known.verdict(position=position)

    assert verdict.outcome == "comes apart"
    assert verdict.broke_s == pytest.approx(0.4)
    assert verdict.gap == pytest.approx(0.011, rel=1e-6)


@pytest.mark.parametrize(("factor", "outcome"), [(1.2, "gains energy"), (0.8, "loses energy")])
def test_energy_that_comes_or_goes_is_told(known: _Known, factor: float, outcome: str) -> None:
    velocity = known.truth.velocity.copy()
    velocity[:, 5:] *= factor

    verdict = known.verdict(velocity=velocity)

    assert verdict.outcome == outcome
    assert np.sign(verdict.energy) == np.sign(factor - 1.0)


def test_what_broke_before_the_end_counts_more_than_the_end(known: _Known) -> None:
    fields = ("position", "orientation", "velocity", "angular_velocity")
    motion = {name: getattr(known.truth, name).copy() for name in fields}
    for values in motion.values():
        values[:, 7:] = np.nan
    failure = (Failure(7, "DART: not finite"),)
    plain = known.verdict(**motion, failures=failure)
    motion["position"][:, 5:, 1, 0] += 0.5

    apart = known.verdict(**motion, failures=failure)

    assert (plain.outcome, plain.told) == ("blows up", "engine")
    assert (plain.broke_s, plain.ended_s) == (pytest.approx(0.7), pytest.approx(0.6))
    assert (apart.outcome, apart.told) == ("comes apart", "engine")
    assert apart.broke_s == pytest.approx(0.5)


def test_a_stable_motion_elsewhere_is_off_course(known: _Known) -> None:
    turned = known.truth.position.copy()
    turned[..., :2] *= -1.0  # half a turn about the vertical keeps energy and joints
    orientation = known.truth.orientation[..., [3, 2, 1, 0]] * [-1.0, -1.0, 1.0, 1.0]

    verdict = known.verdict(position=turned, orientation=orientation)

    assert verdict.outcome == "off course"
    assert verdict.error > 0.1


def test_an_interrupted_study_goes_on_where_it_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []

    def counted(*arguments: Any) -> Any:
        if len(calls) == 3:
            calls.append(None)
            raise KeyboardInterrupt
        calls.append(arguments[3])
        return run_cell(*arguments)

    monkeypatch.setattr(surveys, "run_cell", counted)
    how: dict[str, Any] = {"values": (1e2, 1e3), "counts": (5, 10, 20)}
    with pytest.raises(KeyboardInterrupt):
        _sweep(_BLIND, "mujoco", "RK4", **how)

    sweep = _sweep(_BLIND, "mujoco", "RK4", **how)

    assert (sweep.kept, sweep.measured) == (3, 3)
    assert len(calls) == 3 + 1 + 3
    again = _sweep(_BLIND, "mujoco", "RK4", **how)
    assert (again.kept, again.measured, again.panels) == (6, 0, sweep.panels)


def test_other_values_and_a_fresh_run_are_measured() -> None:
    sweep = partial(_sweep, _BLIND, "mujoco", "RK4", counts=(10,))
    sweep(values=(1e2,))

    other = sweep(values=(2e2,))
    fresh = sweep(values=(1e2,), conduct=Conduct(0, fresh=True))

    assert (other.measured, fresh.measured) == (1, 1)


def test_a_run_that_two_profiles_share_is_told_of_each() -> None:
    for fresh in (True, False):  # measured, and kept
        sweep = _sweep(
            _BLIND, "dart", "semi-implicit-euler", values=(1e2,), counts=(10,),
            profiles=("matched", "native"), conduct=Conduct(0, fresh=fresh),
        )  # fmt: skip

        assert [panel.profile for panel in sweep.panels] == ["matched", "native"]
        assert [cell.profile for cell in sweep.cells] == ["matched", "native"]
        assert len({cell.key for cell in sweep.cells}) == 1


@pytest.fixture
def faulty_engines(tmp_path: Path) -> Iterator[None]:
    with faulty(tmp_path / "packages", "aborting", "hanging"):
        yield


@pytest.mark.usefixtures("faulty_engines")
def test_a_crash_and_a_hang_are_results_with_their_reason() -> None:
    how: dict[str, Any] = {"values": (1e2,), "counts": (10, 20), "conduct": Conduct(2)}

    crashed = _sweep(_BLIND, "aborting", "RK4", **how).cells[0]
    hung = _sweep(_BLIND, "hanging", "RK4", limit=2.0, **how).cells[1]

    assert (crashed.outcome, crashed.told, crashed.silent) == ("crashed", "process", False)
    assert "SIGABRT" in crashed.reason
    assert (hung.outcome, hung.told) == ("timed out", "process")
    assert hung.reason == "no answer within 2 s"
    again = _sweep(_BLIND, "aborting", "RK4", **how)
    assert again.measured == 2  # a crash may have come from outside


def test_limits_are_the_longest_step_with_all_shorter_ones_stable() -> None:
    sweep = _sweep(_BLIND, "mujoco", "Euler", values=(_stiffness_at(1.0, 10),))
    (panel,) = sweep.panels

    stable = panel.largest_stable(0)

    assert stable == pytest.approx(FRAME / 10)
    broken = [cell for cell in panel.cells[0] if cell.failed]
    assert broken[-1].step_s == pytest.approx(FRAME / 5)  # h √k = 2 is the limit itself


def test_methods_that_cannot_do_a_scene_are_left_out_with_the_reason() -> None:
    plan = SurveyPlan(
        STUDIES["redundancy"], ("exudyn", "dart"), profiles=("matched",), conduct=HERE
    )

    sweep = survey(dataclasses.replace(plan, values=(2.0,), counts=(20,)))

    assert [panel.name for panel in sweep.panels] == [
        "exudyn trapezoidal", "exudyn generalised-alpha", "dart semi-implicit-euler",
    ]  # fmt: skip
    assert set(sweep.left_out) == {
        "exudyn RK44", "exudyn RK67", "exudyn tree-RK44", "dart forward-dynamics-RK4",
    }  # fmt: skip


def test_settings_that_an_engine_refuses_at_one_value_leave_the_others(tmp_path: Path) -> None:
    study = dataclasses.replace(STUDIES["chain-length"], known=False)

    with faulty(tmp_path / "packages", "choosy"):
        sweep = _sweep(study, "choosy", "Euler", values=(1.0, 16.0), counts=(50,))

    told = [(cell.outcome, cell.reason) for cell in sweep.cells]
    assert told == [("stable", ""), ("refused", "choosy matched: it takes five bodies at most")]


def test_what_cannot_be_run_is_refused_with_the_choice() -> None:
    with pytest.raises(InputError, match="reference adaptive chooses its steps, which a map sets"):
        _sweep(_BLIND, "reference", "adaptive")
    with pytest.raises(UnknownName, match="RK4"):
        _sweep(_BLIND, "mujoco", "RK5")
    with pytest.raises(InputError, match="nothing to run in loops"):
        _sweep(STUDIES["loops"], "exudyn", "RK44", values=(1.0,), counts=(10,))
    with pytest.raises(UnknownName, match="mass-ratio"):
        study_named("mass")
    with pytest.raises(UnknownName, match="3ladder"):
        STUDIES["scenes"].parse("4ladder")
    with pytest.raises(InputError, match="--value: got '-1'"):
        STUDIES["spin"].parse("-1")


@pytest.mark.parametrize("name", ["chain-length", "loops", "links", "redundancy"])
@pytest.mark.parametrize("text", ["2.5", "0", "1e12", "nan", "-2"])
def test_what_is_counted_takes_whole_numbers(name: str, text: str) -> None:
    study = STUDIES[name]

    with pytest.raises(InputError, match=f"got '{text}', allowed is a whole number from [12] to"):
        study.parse(text)
    assert study.parse("3") == 3.0


@pytest.mark.parametrize("study", STUDIES.values(), ids=list(STUDIES))
def test_every_study_makes_a_scene_at_each_of_its_values(study: Study) -> None:
    for value in study.values:
        scene = study.scene(value)
        batch = study.batch(scene)
        assert (scene.clock.frame, batch.steps) == (FRAME, study.frames)
        assert scene.noise == 0.0
        assert study.parse(str(value)) == value
    assert not study.sentence.endswith(".")


@pytest.mark.parametrize(
    ("name", "value", "figure"),
    [
        ("mass-ratio", 1e3, lambda s: sum(p.mass for p in s.bodies[-1].particles)),
        ("spin", 30.0, lambda s: math.hypot(*s.bodies[0].angular_velocity)),
        ("throw", 50.0, lambda s: -float(STUDIES["throw"].batch(s).velocity[0, 0, 2])),
        ("friction", 2.0, lambda s: s.ground.friction),
        ("restitution", 0.5, lambda s: s.ground.restitution),
        ("redundancy", 6.0, lambda s: len(s.bodies) - 1.0),
        ("loops", 2.0, lambda s: sum(b.name.startswith("rung") for b in s.bodies)),
        ("chain-length", 16.0, lambda s: float(len(s.bodies))),
    ],
)
def test_the_swept_value_is_in_the_scene(
    name: str, value: float, figure: Callable[[Scene], float]
) -> None:
    assert figure(STUDIES[name].scene(value)) == pytest.approx(value)


@pytest.mark.parametrize("angle", [0.45, 0.4, 0.35, 0.3, 0.25, 0.2, 0.0])
def test_the_reference_goes_through_the_singular_pose_as_a_parallelogram(angle: float) -> None:
    study = STUDIES["singular"]
    scene = study.scene(angle)

    motion = reference.solve(scene, study.batch(scene))

    assert motion.failures == (None,)
    rates = motion.angular_velocity[0, :, :, 1]
    np.testing.assert_allclose(rates[:, 0], rates[:, 1], atol=1e-9)
    np.testing.assert_allclose(rates[:, 2], 0.0, atol=1e-9)
    assert np.abs(np.diff(rates[:, 0])).max() > 0.3
