"""Sizes of effects: zero where they provably do nothing, else the value of theory."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.isolate import HERE, Silent
from mbds_xsim.measure import quick
from mbds_xsim.scene.file import write_scene
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import Starts, draw_batch
from mbds_xsim.scene.sampling_terms import Turn
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene
from mbds_xsim.scene.servo import Servo
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.studies.ablate import _more, ablate, present
from mbds_xsim.studies.ablate.analyse import (
    Ablation,
    Floor,
    Size,
    WeakenedEffect,
    Window,
    least_size,
    row_of,
)
from mbds_xsim.studies.ablate.effects import EFFECTS, Effect, variants_of
from tests.command_line import CommandLine

_SECOND = Clock(0.02, 50)
_GRAVITY = 9.81


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path / "cache"))


def _effect(name: str) -> Effect:
    return next(effect for effect in EFFECTS if effect.name == name)


def _ablate(scene: Scene, engines: str = "mujoco,exudyn") -> Ablation:
    return ablate(scene, choice=Choice.parse(engines=engines), starts=Starts(), conduct=HERE)


def _row(ablation: Ablation, effect: str, factor: float) -> WeakenedEffect:
    return next(row for row in ablation.rows if (row.effect, row.factor) == (effect, factor))


def _compound_pendulum(arm: float, moment: float, angle: float) -> Scene:
    return Scene(
        name="compound",
        bodies=(Body("bob", inertia=Inertia(1.0, (moment,) * 3, com=(0.0, 0.0, -arm))),),
        joints=(Joint("pivot", "hinge", "world", "bob", (0.0, 0.0, 0.0), (0, 1, 0), start=angle),),
        length=1.0,
        clock=_SECOND,
    )


@pytest.mark.usefixtures("search")
def test_settings_that_a_search_does_not_find_are_not_searched_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    engines: list[object] = []
    monkeypatch.setattr(quick, "_search", lambda *task: engines.append(task[3]))

    _ablate(_compound_pendulum(0.5, 0.1, 0.05), "mujoco")

    assert engines == ["mujoco"]


def test_each_piece_of_work_is_counted_by_itself() -> None:
    class Count(Silent):
        def __init__(self) -> None:
            self.pieces: list[list[int]] = []

        def begin(self, total: int, done: int = 0) -> None:
            self.pieces.append([total, done])

        def advance(self, work: str) -> None:
            del work
            self.pieces[-1][1] += 1

    count = Count()
    conduct = dataclasses.replace(HERE, meter=count)

    ablate(
        _compound_pendulum(0.5, 0.1, 0.05), choice=Choice.parse(engines="mujoco"), conduct=conduct
    )

    assert [total for total, _ in count.pieces] == [done for _, done in count.pieces]


def test_the_inertia_of_a_compound_pendulum_is_worth_what_its_period_says() -> None:
    arm, moment, angle = 0.5, 0.1, 0.05
    ablation = _ablate(_compound_pendulum(arm, moment, angle))
    turned = [
        angle * math.cos(math.sqrt(_GRAVITY * arm / (own + arm**2))) for own in (moment, moment / 2)
    ]
    # Stand-ins for particles: six points at the radius of gyration around the centre of mass.
    reach = math.sqrt(arm**2 + (2 / 3) * (1.5 * moment))
    expected = 2 * reach * math.sin(abs(turned[1] - turned[0]) / 2)
    row = _row(ablation, "rotary inertia", 0.5)
    assert row.verdict == "needed"
    # The period of a swing of 0.05 rad is longer by 0.05² / 16.
    assert row.change_1s_m == pytest.approx(expected, rel=2e-3)
    assert row.change_1s_median_m == pytest.approx(row.change_1s_m)
    about = _row(ablation, "inertia about hinges", 0.5)
    assert about.change_1s_m == pytest.approx(row.change_1s_m, rel=1e-6)
    assert present(ablation).conclusion == "2 of 2 effects are needed in full"


def test_spin_inertia_of_rods_that_do_not_spin_is_worth_nothing() -> None:
    scene = msgspec.structs.replace(registry.load_scene("2pendulum"), clock=_SECOND)
    ablation = _ablate(scene)
    for factor in (0.0, 0.5):
        row = _row(ablation, "spin inertia of rods", factor)
        assert row.verdict == "not needed"
        assert row.change_m is not None
        assert row.change_m < 1e-9
    own = _row(ablation, "own inertia of particles", 0.0)
    assert own.change_m is not None
    assert own.change_m > 1e-4
    plane = _row(ablation, "third dimension", 0.0)
    assert plane.verdict == "not possible"
    assert "joints['joint" in plane.sentence
    more = {size.engine: (size.more_coordinates, size.more_constraints) for size in ablation.sizes}
    assert more == {"mujoco": (0, 0), "exudyn": (6, 6)}


def test_friction_is_worth_the_way_that_a_ball_slides_on() -> None:
    scene = msgspec.structs.replace(registry.load_scene("ballscroll"), clock=_SECOND, noise=0.0)
    ablation = _ablate(scene)
    assert scene.ground is not None
    batch, radius = draw_batch(scene, range(3)), scene.contacts[0].radius
    speed, spin = batch.velocity[:2, 0, 0], batch.angular_velocity[:2, 0, 1]
    way = {mu: _rolled(speed, radius * spin, mu * scene.ground.friction) for mu in (0.0, 0.5, 1.0)}
    for factor in (0.0, 0.5):
        row = _row(ablation, "friction", factor)
        assert row.verdict == "needed"
        assert row.change_1s_m == pytest.approx(np.abs(way[factor] - way[1.0]).max(), rel=1e-6)
        assert _row(ablation, "restitution", factor).change_m == 0.0
    assert "noise" not in {row.effect for row in ablation.rows}


def _rolled(speed: Array, rim: Array, friction: float) -> Array:
    """Return the distance in 1 s of a ball that slides, then rolls [m]."""
    if friction == 0.0:
        return speed
    brake = friction * _GRAVITY
    slides = np.minimum(1.0, (speed - rim) * 2 / (7 * brake))
    rolling = np.where(slides < 1.0, (5 * speed + 2 * rim) / 7, 0.0)
    return np.asarray(speed * slides - brake * slides**2 / 2 + rolling * (1.0 - slides))


def test_a_pendulum_that_swings_in_a_plane_needs_no_third_dimension() -> None:
    pendulum = registry.load_scene("2pendulum")
    first, second = pendulum.bodies
    pushed = msgspec.structs.replace(first, angular_velocity=(0.0, 2.0, 0.0))
    scene = msgspec.structs.replace(
        pendulum, bodies=(pushed, second), clock=_SECOND, sampling=(), noise=0.0
    )
    ablation = _ablate(scene)
    plane = _row(ablation, "third dimension", 0.0)
    assert plane.verdict == "not needed"
    assert plane.change_m is not None
    assert plane.change_m < 1e-8
    assert _row(ablation, "listed velocities", 0.0).verdict == "needed"


def test_a_ladder_needs_its_second_rope() -> None:
    ladder = registry.load_scene("1ladder")
    swings = tuple(draw for draw in ladder.sampling if isinstance(draw, Turn))
    scene = msgspec.structs.replace(ladder, clock=Clock(0.02, 15), sampling=swings, noise=0.0)
    ablation = _ablate(scene)
    assert _row(ablation, "closed loops", 0.0).verdict == "needed"
    assert _row(ablation, "third dimension", 0.0).verdict == "not possible"
    assert "sideways forces" not in {row.effect for row in ablation.rows}
    assert ablation.loop_conditions == 3


def test_sideways_forces_are_those_along_y() -> None:
    scene = registry.load_scene("2pendulum")
    batch = draw_batch(scene, range(3))
    (dropped, _) = variants_of(scene, [_effect("sideways forces")], batch, 0)
    assert not dropped.batch.force[..., 1].any()
    np.testing.assert_array_equal(dropped.batch.force[..., ::2], batch.force[..., ::2])
    np.testing.assert_array_equal(dropped.batch.position, batch.position)


@pytest.mark.slow
def test_without_a_unique_solution_an_engine_is_the_judge() -> None:
    scene = msgspec.structs.replace(registry.load_scene("particlecar"), clock=Clock(0.02, 6))
    ablation = _ablate(scene, "mujoco,dart")
    assert ablation.judge.startswith(("mujoco", "dart"))
    assert _row(ablation, "friction", 0.0).verdict == "needed"
    assert _row(ablation, "hinge rates", 0.0).verdict == "needed"


@pytest.mark.parametrize("name", registry.PAPER_SCENES)
def test_an_effect_at_full_strength_is_the_scene_itself(name: str) -> None:
    scene = registry.load_scene(name)
    full = Mechanism.of(scene)
    for effect in EFFECTS:
        same = effect.weaken(scene, 1.0) if effect.factors[-1] == 0.5 else None
        if same is None:
            continue
        mechanism = Mechanism.of(same)
        np.testing.assert_allclose(mechanism.inertia, full.inertia, rtol=0, atol=1e-14)
        np.testing.assert_allclose(mechanism.com, full.com, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(mechanism.mass, full.mass)
        if effect.starts == "redrawn":
            again, batch = draw_batch(same, range(3)), draw_batch(scene, range(3))
            np.testing.assert_array_equal(again.velocity, batch.velocity)
            np.testing.assert_array_equal(again.force, batch.force)


@pytest.mark.parametrize("name", registry.PAPER_SCENES)
def test_weaker_starts_are_the_same_in_all_but_the_effect(name: str) -> None:
    scene = registry.load_scene(name)
    batch = draw_batch(scene, range(3), seed=5)
    weakened = set()
    for effect in (effect for effect in EFFECTS if effect.starts == "redrawn"):
        weaker = effect.weaken(scene, 0.5)
        if weaker is None:
            continue
        weakened.add(effect.name)
        half = draw_batch(weaker, range(3), seed=5)
        np.testing.assert_allclose(half.position, batch.position, rtol=0, atol=1e-12)
        changed = {
            key
            for key in ("velocity", "angular_velocity", "force", "torque")
            if not np.array_equal(getattr(half, key), getattr(batch, key))
        }
        assert changed, effect.name
        assert changed <= _TOUCHES[effect.name], effect.name
    assert "noise" in weakened
    quiet = draw_batch(msgspec.structs.replace(scene, noise=0.0), range(3), seed=5)
    half = draw_batch(msgspec.structs.replace(scene, noise=scene.noise / 2), range(3), seed=5)
    np.testing.assert_allclose(2 * half.force, quiet.force + batch.force, rtol=0, atol=1e-12)


_TOUCHES = {
    "noise": {"force"},
    "wind": {"force"},
    "gusts": {"force"},
    "drives": {"torque"},
    "start velocity": {"velocity", "angular_velocity"},
    "start spin": {"velocity", "angular_velocity"},
    "hinge rates": {"velocity", "angular_velocity"},
}


@pytest.mark.parametrize(
    ("name", "freedom", "coordinates", "conditions", "spheres"),
    [
        ("6pendulum", 18, 18, 0, 0),
        ("3ladder", 108, 117, 9, 0),
        ("particlecar", 10, 10, 0, 4),
        ("simplecubli", 9, 9, 0, 8),
        ("balldrop", 3, 3, 0, 1),
        ("ballscroll", 2, 2, 0, 1),
    ],
)
def test_the_smallest_model(
    name: str, freedom: int, coordinates: int, conditions: int, spheres: int
) -> None:
    least = least_size(registry.load_scene(name))
    assert (least.degrees_of_freedom, least.joint_coordinates) == (freedom, coordinates)
    assert (least.loop_conditions, least.contact_spheres) == (conditions, spheres)


def test_one_is_told_as_one() -> None:
    assert _more(Size("exudyn", 2, 1, 1, 1, 1, 0)).startswith(
        "models 1 coordinate and 1 constraint "
    )


def _judged(
    change: float,
    frames: int,
    apart: float,
    lost_from: int = 11,
    lost: str = "",
    end: float = 1.0,
) -> WeakenedEffect:
    """Judge a constant change on one start, mostly of 1 s, that is compared over some frames."""
    time = np.linspace(0.0, end, 11)
    window = Window(
        judged=(np.arange(11) < frames)[None],
        weight=np.ones((1, 11)),
        time=time,
        apart=np.full((1, 11), apart),
        regular=np.array([True]),
        ends="" if frames == 11 else "chaos",
    )
    floor = Floor(apart if frames == 11 else None, apart, 1e-3, 1e-3)
    changes = np.where(np.arange(11) < lost_from, change, np.nan)[None]
    return row_of(_effect("noise"), 0.0, changes, window, floor, lost)


@pytest.mark.parametrize(
    ("change", "frames", "apart", "verdict"),
    [
        (2e-3, 11, 1e-4, "needed"),
        (5e-4, 11, 1e-4, "not needed"),
        (2e-3, 11, 3e-3, "not needed"),
        (5e-4, 5, 3e-4, "not resolvable"),
        (9.9e-4, 5, 3e-4, "needed"),
        (2e-3, 5, 1e-3, "needed"),
        (0.0, 5, 3e-4, "not resolvable"),
    ],
)
def test_the_verdict_follows_the_larger_of_disagreement_and_budget(
    change: float, frames: int, apart: float, verdict: str
) -> None:
    assert _judged(change, frames, apart).verdict == verdict


@pytest.mark.parametrize(("end", "told"), [(1.0, "at 1 s"), (2.0, "at 1 s"), (0.4, "at 0.4 s")])
def test_a_scene_that_ends_before_1_s_has_no_distance_there(end: float, told: str) -> None:
    assert f"their distance {told}, clear is" in _judged(5e-4, 4, 3e-4, end=end).sentence


@pytest.mark.parametrize(
    ("end", "compared"), [(1.0, True), (3.3, True), (20.0, True), (0.9, False)]
)
def test_a_frame_near_1_s_stands_for_it(end: float, compared: bool) -> None:
    change = _judged(5e-4, 11, 1e-4, end=end).change_1s_m
    assert change == (pytest.approx(5e-4) if compared else None)


@pytest.mark.parametrize(
    ("change", "lost_from", "verdict"),
    [(5e-4, 11, "not needed"), (5e-4, 4, "not resolvable"), (2e-3, 4, "needed")],
)
def test_what_is_lost_without_an_effect_does_not_tell_that_it_is_not_needed(
    change: float, lost_from: int, verdict: str
) -> None:
    row = _judged(change, 11, 1e-4, lost_from, "1 of 1 starts: it blew up")

    assert row.verdict == verdict
    assert row.sentence.endswith("; 1 of 1 starts: it blew up")
    assert ("until what is left without it ends" in row.sentence) is (verdict == "not resolvable")


@pytest.mark.usefixtures("in_process")
def test_the_command_writes_what_it_found(run: CommandLine, here: Path) -> None:
    scene = here / "p.toml"
    short = msgspec.structs.replace(registry.load_scene("1pendulum"), clock=Clock(0.02, 10))
    scene.write_text(write_scene(short), "utf-8")
    page, data = here / "a.md", here / "a.json"
    words = ["--engines", "mujoco,exudyn", "--trajectories", "1"]
    ended = run("ablate", "p.toml", *words, "--markdown", "a.md", "--json", "a.json")
    assert ended.code == 0
    assert "1pendulum: " in ended.out
    result = json.loads(data.read_text("utf-8"))
    assert {row["effect"] for row in result["rows"]} >= {"noise", "start velocity"}
    assert "| noise | dropped |" in page.read_text("utf-8")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["teapot"], "'teapot'"),
        (["2pendulum", "--engines", "ode"], "'ode'"),
        (["2pendulum", "--settings", "fast"], "'fast'"),
        (["2pendulum", "--json", "a", "--markdown", "a"], "both name"),
    ],
)
def test_bad_input_is_one_line(words: list[str], told: str, run: CommandLine) -> None:
    assert told in run("ablate", *words).refusal


def test_stops_and_saturation_can_be_left_out() -> None:
    pin = Joint("pin", "hinge", "world", "rod", (0.0, 0.0, 0.0), (0, 1, 0), limits=(-0.5, 0.5))
    rod = Body("rod", inertia=Inertia(1.0, (0.1,) * 3, com=(0.0, 0.0, -0.5)))
    servo = Servo("pin", (1.0,), stiffness=20.0, limit=2.0)
    scene = Scene("led", (rod,), 1.0, joints=(pin,), servos=(servo,), clock=_SECOND)
    batch = draw_batch(scene, [0])
    effects = [_effect("stops"), _effect("saturation")]
    free, unsaturated = variants_of(scene, effects, batch, 0)

    assert not Mechanism.of(free.scene).limited
    np.testing.assert_array_equal(free.batch.torque, batch.torque)
    assert not batch.torque.any()
    assert not Mechanism.of(unsaturated.scene).drives
    np.testing.assert_array_equal(unsaturated.batch.torque, 20.0)
