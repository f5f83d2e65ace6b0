"""Mechanisms with closed-form solutions, from files as a user writes them: no sound engine fails.

Their true errors are known from solutions in minimal coordinates to a relative tolerance of 1e-12,
from which the reference differs by less than 3e-10 m: Bennett's linkage (overconstrained), two
slider-cranks (one in space, as in Haug, Computer Aided Kinematics and Dynamics, 1989) and a
four-bar under load.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from mbds_xsim.base.isolate import HERE
from mbds_xsim.scene.file import read_scene
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.choice import Choice, Matched
from mbds_xsim.studies.validate import validate_with_evidence

_FOLDER = Path(__file__).parent / "mechanisms"
_FRAMES = {"bennett": 50, "fourbar-load": 50, "slider-crank": 100, "slider-crank-3d": 50}

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("search")]


def _scene(name: str, frames: int) -> Scene:
    scene = read_scene(_FOLDER / f"{name}.toml")
    clock = msgspec.structs.replace(scene.clock, steps=frames)
    return msgspec.structs.replace(scene, clock=clock)


@pytest.mark.parametrize(("name", "frames"), _FRAMES.items())
def test_every_engine_keeps_the_budgets_at_settings_that_a_quick_search_found(
    name: str, frames: int
) -> None:
    """Settings are searched here unless a file of settings belongs to the mechanism."""
    scene = _scene(name, frames)
    path = _FOLDER / "settings" / f"{name}.toml"

    choice = Choice.parse(profiles=str(path) if path.is_file() else "matched")
    validation, _ = validate_with_evidence(scene, choice=choice, conduct=HERE)

    assert {row.engine: row.reasons for row in validation.engines} == dict.fromkeys(
        registry.engine_names(), ()
    )
    assert validation.trajectories == (0,)


@pytest.mark.parametrize(
    ("name", "sound", "frames", "worst"),
    [
        pytest.param("slider-crank", "mujoco", 200, 7.35e-5, id="order rises from 0 to 4"),
        pytest.param("slider-crank", "mujoco", 50, 1.31e-7, id="velocities of lower order"),
        pytest.param("slider-crank-3d", "mujoco", 200, 3.2e-4, id="in space"),
        pytest.param("bennett", "exudyn", 100, 9.22e-7, id="coarser runs stop"),
    ],
)
def test_consistency_fails_no_engine_whose_error_is_far_below_its_budget(
    name: str, sound: str, frames: int, worst: float
) -> None:
    scene = _scene(name, frames)
    preset = registry.load_adapter(sound).settings(scene, "matched")
    matched = Matched(preset.method, preset.substeps(scene.clock.frame), dict(preset.options))

    choice = Choice((sound,), settings={"matched": {sound: matched}})
    validation, _ = validate_with_evidence(scene, choice=choice, conduct=HERE)

    (row,) = validation.engines
    assert row.reasons == ()
    assert row.error_max_m == pytest.approx(worst, rel=0.05)
    findings = {finding.check: finding for finding in row.findings}
    for check in ("consistency of positions", "consistency of energy"):
        assert findings[check].figures[0] is not None, findings[check].note
    stopped = "the coarsest run of the check stopped" in findings["consistency of energy"].note
    assert stopped == (sound == "exudyn")
