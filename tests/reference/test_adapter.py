"""The reference as a simulator like others: it keeps its tolerance and does not judge itself."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

import mbds_xsim
from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.checks import agreement
from mbds_xsim.measure.result import EngineResult, Validation
from mbds_xsim.reference.solution import confirmed
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.simulator import EngineMethod
from mbds_xsim.studies.diff.read import read_views
from mbds_xsim.studies.tradeoff import curves_of
from mbds_xsim.studies.tradeoff.words import main_curves
from tests.command_line import CommandLine

NAME = registry.REFERENCE


@pytest.fixture
def scene() -> Scene:
    return msgspec.structs.replace(registry.load_scene("2pendulum"), clock=Clock(0.02, 60))


@pytest.fixture(scope="module")
def validation() -> Validation:
    return mbds_xsim.validate("2pendulum", engines=[NAME, "mujoco"], workers=0)


def test_the_error_falls_as_the_tolerance_does(scene: Scene) -> None:
    """The exact solution is from other code in other coordinates, a hundred times tighter."""
    adapter, batch = registry.load_adapter(NAME), draw_batch(scene, [1])
    truth, errors = confirmed(scene, batch, False), []
    tried = (5, 7, 9, 11)
    for digits in tried:
        settings = EngineMethod(NAME, "adaptive", counts=(digits,), digits=True)
        with adapter.open(scene, settings.settings(scene, digits)) as run:
            motion = run.rollout(batch)
        errors.append(agreement.particle_error(Mechanism.of(scene), motion, truth).max())

    assert errors == sorted(errors, reverse=True)
    assert errors[0] > 1e2 * errors[-1]
    assert np.all(np.array(errors) < [10.0**-digits * scene.length for digits in tried])


def _row(validation: Validation) -> EngineResult:
    return next(row for row in validation.engines if row.engine == NAME)


def test_its_distance_to_itself_is_no_figure(validation: Validation) -> None:
    row = _row(validation)

    assert (row.verdict, row.rtol) == ("pass", 1e-9)
    assert (row.error_1s_m, row.error_max_m, row.error_weighted_m) == (None, None, None)
    checked = {finding.check for finding in row.findings}
    assert {"gap", "energy"} <= checked
    assert not [check for check in checked if check.startswith(("error", "consistency"))]


def test_it_has_one_vote(validation: Validation) -> None:
    assert validation.names == ("mujoco matched", "reference")


def test_the_command_says_so(run: CommandLine) -> None:
    ended = run("validate", "2pendulum", "--engines", f"{NAME},mujoco", "--workers", "1")

    assert ended.code == 0
    assert "its distance to itself is no figure" in " ".join(ended.out.split())
    assert "rtol" in ended.out


@pytest.mark.parametrize("name", ["simplecubli", "particlecar"])
def test_contact_without_a_unique_motion_is_refused(name: str) -> None:
    scene = registry.load_scene(name)

    with pytest.raises(Unsupported, match="no unique motion"):
        Choice.parse(engines=NAME).contenders(scene)
    _, left_out = curves_of(scene, (NAME, "mujoco"))
    assert "no unique motion" in left_out["reference adaptive"]


def test_its_curve_goes_over_tolerances(scene: Scene, here: Path) -> None:
    del here
    study = mbds_xsim.tradeoff(scene, engines=f"{NAME},mujoco", starts=1, limit=1.0, workers=0)
    alone, batch = (curve for curve in study.curves if curve.engine == NAME)

    assert [point.rtol for point in alone.points] == [10.0**-n for n in range(5, 13)]
    errors = [point.error_m or 0.0 for point in alone.points]
    assert errors[0] > 1e2 * errors[-1] > 0.0
    assert all(point.kind == "done" and not point.broken for point in alone.points)
    Path("study.json").write_bytes(msgspec.json.encode(study))
    (view,) = read_views(Path("study.json"))[1].values()
    assert "reference adaptive, rtol 1e-12" in view.entries
    assert [curve.name for curve in main_curves(study)][:2] == [alone.name, batch.name]
    # A batch fills eight lanes, a single trajectory one.
    one, share = ([point.cpu_s or 0.0 for point in each.points] for each in (alone, batch))
    assert np.median(np.divide(one, share)) > 2.0


def test_a_ball_has_a_cost_and_no_error(here: Path) -> None:
    del here
    scene = msgspec.structs.replace(registry.load_scene("balldrop"), clock=Clock(0.02, 60))
    study = mbds_xsim.tradeoff(scene, engines=f"{NAME}", starts=1, limit=1.0, workers=0)

    for point in study.curves[0].points:
        assert point.kind == "done"
        assert (point.error_m, point.error_weighted_m) == (None, None)
        assert point.wall_s is not None


def test_a_step_is_refused_where_it_would_be_ignored(scene: Scene) -> None:
    with pytest.raises(InputError, match="chooses its steps"):
        Choice.parse(engines=NAME, step=0.001).contenders(scene)


def test_it_is_no_engine() -> None:
    assert NAME not in Choice.parse().engines
    assert NAME in Choice.parse(also=(NAME,)).engines
