"""Which engines run: named ones must be able to, others are left out with the reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mbds_xsim.base.errors import EngineMissing, Unsupported
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, DistanceLink, Inertia, Joint, Particle, Scene
from mbds_xsim.simulate import choice, registry
from mbds_xsim.simulate.adapter import Adapter
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.timed import simulate
from tests.plugins import installed

ENDS = ((0.0, 0.0, 0.0), (0.0, 0.0, -1.0))
LINKED = Scene(
    "linked",
    (Body("ball", particles=(Particle((0.0, 0.0, -1.0)),)),),
    length=1.0,
    distance_links=(DistanceLink("rope", ("world", "ball"), ENDS),),
)


def _there(*engines: str) -> set[str]:
    """Leave out engines that are not installed, as none is missing in CI."""
    return set(engines) & set(registry.installed_engines())


def test_engines_that_cannot_do_a_scene_are_left_out_with_the_reason() -> None:
    contenders, left_out = Choice.parse().contenders(LINKED)
    assert {contender.engine for contender in contenders} == _there(
        "drake", "mujoco", "mujoco-warp", "exudyn"
    )
    assert set(left_out) == {"dart", "pinocchio", "pybullet"}
    assert all("distance link" in reason for reason in left_out.values())


def test_an_engine_asked_for_by_name_must_be_able_to() -> None:
    with pytest.raises(Unsupported, match=r"distance link.*use --engines exudyn"):
        Choice.parse(engines="pybullet,exudyn").contenders(LINKED)


def test_some_engine_must_be_able_to() -> None:
    with pytest.raises(Unsupported, match="no engine given here can"):
        Choice(("pybullet", "dart"), named=False).contenders(LINKED)


def test_settings_of_an_engine_that_is_not_installed_keep_no_other_from_running(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Settings that a package ships for a scene are there without the engine."""
    load = registry.load_adapter

    def without(name: str) -> Adapter:
        if name == "drake":
            raise EngineMissing(name)
        return load(name)

    monkeypatch.setattr(registry, "load_adapter", without)
    monkeypatch.setattr(choice, "_shipped", choice._shipped.__wrapped__)
    (contender,), _ = Choice.parse(engines="mujoco").contenders(registry.load_scene("3ladder"))
    assert contender.settings.step == pytest.approx(0.02 / 3)
    assert choice.is_stored(registry.load_scene("3ladder"), "drake")


@pytest.mark.parametrize(
    ("text", "place", "reason"),
    [
        ("steps = 2", "shipped", "6pendulum.toml: outside: Object contains unknown field `steps`"),
        ("steps_per_frame = 2", "shipped", "no method of outside is called 'RK9'"),
        ("", "missing.settings", "there is no package missing, which its entry point names"),
    ],
)
def test_wrong_settings_that_a_package_ships_leave_out_its_engine_alone(
    text: str, place: str, reason: str, tmp_path: Path
) -> None:
    folder, scene = tmp_path / "outside", registry.load_scene("6pendulum")
    (folder / "shipped").mkdir(parents=True)
    (folder / "shipped" / "6pendulum.toml").write_text(f"[outside]\nmethod = 'RK9'\n{text}\n")
    module = "from mbds_xsim_adapters.mujoco import MuJoCo\nclass X(MuJoCo): name = 'outside'"
    with installed(
        folder, {"outside": module}, {"outside": "outside:X"}, matched={"outside": place}
    ):
        alone = Choice.parse(engines="mujoco").contenders(scene)
        both = Choice(("mujoco", "outside"), named=False).contenders(scene)
        with pytest.raises(Unsupported, match=r"its package ships.*no engine given here can"):
            Choice.parse(engines="outside").contenders(scene)

    assert both[0] == alone[0]
    assert alone[1] == {}
    assert both[1].keys() == {"outside"}
    assert both[1]["outside"].startswith("outside matched: the settings that its package ships: ")
    assert reason in both[1]["outside"]


def test_settings_that_a_package_ships_for_no_built_in_scene_are_of_no_account(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "outside"
    (folder / "shipped").mkdir(parents=True)
    (folder / "shipped" / "linked.toml").write_text("[mujoco]\nmethod = 3\n")
    with installed(folder, {}, matched={"mujoco": "shipped"}):
        assert not choice.is_stored(LINKED, "mujoco")


def _hinged(moment: float, mass: float) -> Scene:
    """A rod that falls on a hinge 1 mm from its centre of mass."""
    inertia = Inertia(mass, (moment, moment, moment))
    rod = Body("rod", inertia=inertia, position=(1e-3, 0.0, 0.0))
    pin = Joint("pin", "hinge", "world", "rod", (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    return Scene("small", (rod,), length=2e-3, joints=(pin,), clock=Clock(0.001, 20))


def test_engines_that_hold_no_body_so_small_are_left_out_with_the_reason() -> None:
    small = _hinged(8e-20, 2e-15)

    contenders, left_out = Choice.parse().contenders(small)

    able = _there("dart", "drake", "exudyn", "pinocchio")
    assert {contender.engine for contender in contenders} == able
    assert left_out["mujoco"] == (
        "mujoco cannot represent a value of the scene: 'rod' has 2e-15 kg and 8e-20 kg·m², "
        "MuJoCo's compiler takes masses of 1e-15 kg and principal moments of 1e-14 kg·m², or more"
    )
    assert "PyBullet moves 2.22e-16 or more" in left_out["pybullet"]
    with pytest.raises(Unsupported, match=r"a value of the scene: 'rod'.*use --engines dart"):
        Choice.parse(engines="mujoco,dart").contenders(small)


@pytest.mark.parametrize(
    ("name", "moment", "mass"),
    [
        ("mujoco", 1.001e-14, 1.001e-8),
        ("mujoco", 1.001e-14, 1.001e-15),
        ("pybullet", 2.23e-16, 2.23e-16),
        ("dart", 1e-30, 1e-24),
        ("exudyn", 1e-30, 1e-24),
        ("pinocchio", 1e-30, 2.23e-16),
        ("mujoco-warp", 1.001e-14, 1.001e-8),
        ("mujoco-warp", 1.001e-14, 1.001e-15),
        ("drake", 1e-30, 1e-24),
    ],
)
def test_what_an_engine_holds_it_moves(name: str, moment: float, mass: float) -> None:
    """A tiny body falls like one of 10⁶ times the mass and moment."""
    scenes = [_hinged(moment * scale, mass * scale) for scale in (1.0, 1e6)]
    small, large = (
        simulate(scene, draw_batch(scene, [0]), name, contender.settings)
        for scene in scenes
        for contender in Choice((name,)).contenders(scene)[0]
    )

    moved = small.trajectory.orientation - small.trajectory.orientation[:, :1]
    assert np.abs(moved).max() > 1e-8
    np.testing.assert_allclose(
        small.trajectory.orientation, large.trajectory.orientation, rtol=0, atol=1e-6
    )
