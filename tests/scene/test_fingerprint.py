"""Fingerprints differ where physics or starts differ, and nowhere else."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from mbds_xsim.scene.budget import Budget
from mbds_xsim.scene.file import read_scene, save_scene, write_scene
from mbds_xsim.scene.sampling_terms import HingeTorque, Levels, Wind
from mbds_xsim.scene.scene import Body, Clock, Force, Inertia, Joint, Scene, Torque
from mbds_xsim.scene.servo import Servo
from mbds_xsim.scene.state import fingerprint
from mbds_xsim.simulate.registry import load_scene, scene_names

replace = msgspec.structs.replace


def _heavier(scene: Scene, factor: float) -> Scene:
    first, *others = scene.bodies
    particles = tuple(replace(p, mass=p.mass * factor) for p in first.particles)
    return replace(scene, bodies=(replace(first, particles=particles), *others))


def test_scenes_differ() -> None:
    prints = {name: fingerprint(load_scene(name)) for name in scene_names()}

    assert len(set(prints.values())) == len(prints) > 8


@pytest.mark.parametrize(
    "other",
    [
        lambda s: _heavier(s, 1.0001),
        lambda s: replace(s, gravity=(0.0, 0.0, -9.8)),
        lambda s: replace(s, clock=Clock(frame=0.01)),
        lambda s: replace(s, noise=s.noise + 0.1),
        lambda s: replace(s, sampling=()),
        lambda s: replace(s, joints=s.joints[:-1]),
    ],
)
def test_other_physics_or_starts_are_another(other: Callable[[Scene], Scene]) -> None:
    scene = load_scene("3ladder")

    assert fingerprint(other(scene)) != fingerprint(scene)


@pytest.mark.parametrize(
    "same",
    [
        lambda s: replace(s, name="ladder", description="", source="x"),
        lambda s: replace(s, budget=Budget(gap=1e-3)),
        lambda s: _heavier(s, 1.0 + 1e-13),
        lambda s: replace(s, gravity=(-0.0, 1e-17, s.gravity[2])),
    ],
)
def test_names_budgets_and_rounding_are_the_same(same: Callable[[Scene], Scene]) -> None:
    scene = load_scene("3ladder")

    assert fingerprint(same(scene)) == fingerprint(scene)


def test_keys_that_came_later_leave_scenes_without_them_as_they_were() -> None:
    scene = load_scene("workbench")
    sprung = tuple(replace(j, damping=0.1) if j.kind == "hinge" else j for j in scene.joints)

    assert fingerprint(scene) == "ecc927a0dd760293"
    assert "damping" not in write_scene(replace(scene, springs=()), defaults=True)
    assert fingerprint(replace(scene, joints=sprung)) != fingerprint(scene)


def _speck(moment: float, product: float = 0.0) -> Scene:
    inertia = Inertia(mass=1e-12, moments=(moment,) * 3, products=(product, 0.0, 0.0))
    return Scene("speck", (Body("speck", inertia=inertia),), 1e-5)


def test_small_bodies_differ_and_rounding_errors_of_large_ones_do_not() -> None:
    specks = [_speck(1e-22), _speck(4e-22), _speck(1e-22, 1e-23)]

    assert len({*map(fingerprint, specks)}) == 3
    assert fingerprint(_speck(1e-22, 1e-37)) == fingerprint(specks[0])
    assert fingerprint(_speck(0.1, 1e-17)) == fingerprint(_speck(0.1))


@pytest.mark.parametrize("size", [1e-8, 2.0004e-12, 3e-16, 2e-25])
def test_small_numbers_keep_nine_digits(size: float) -> None:
    hinge = Joint("hinge", "hinge", "world", "mirror", (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    plain = Scene("mirror", (Body("mirror", inertia=Inertia(1e-9, (1e-19,) * 3)),), 1e-5)
    sprung = replace(plain, joints=(hinge,))

    def variants(x: float) -> list[Scene]:
        laws = ("stiffness", "damping", "friction", "armature")
        servo = Servo("hinge", stiffness=1.0, limit=x)
        draws = HingeTorque(("hinge",), (0.0, x)), Wind(Levels((0.0, x), (0.0, x), (0.0, x)))
        return [
            *(replace(plain, joints=(replace(hinge, **{law: x}),)) for law in laws),
            replace(plain, bodies=(Body("mirror", inertia=Inertia(x, (x,) * 3)),)),
            replace(sprung, servos=(servo,)),
            replace(sprung, torques=(Torque("hinge", (x, -x)),)),
            replace(sprung, forces=(Force("mirror", ((x, 0.0, 0.0),)),)),
            *(replace(sprung, sampling=(draw,)) for draw in draws),
            replace(plain, noise=x),
        ]

    sizes = size, size * (1 + 1e-12), size * (1 + 1e-7)
    for scene, same, other in zip(*map(variants, sizes), strict=True):
        assert fingerprint(scene) == fingerprint(same) != fingerprint(other)


def test_loads_next_to_larger_ones_are_rounding_errors() -> None:
    scene = load_scene("simplecubli")
    name = next(joint.name for joint in scene.joints if joint.kind == "hinge")
    series = [(1.0, 0.0), (1.0, 1e-17), (1e-10, 0.0), (1e-10, 1e-25), (1e-10, 1e-17)]
    prints = [fingerprint(replace(scene, torques=(Torque(name, each),))) for each in series]

    assert prints[0] == prints[1]
    assert prints[2] == prints[3]
    assert len(set(prints)) == 3


def test_a_file_of_the_scene_is_the_same(tmp_path: Path) -> None:
    scene = load_scene("balldrop")
    save_scene(scene, path := tmp_path / "copy.toml")

    assert fingerprint(read_scene(path)) == fingerprint(scene)
