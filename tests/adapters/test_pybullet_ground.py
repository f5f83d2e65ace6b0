"""The ground in Bullet: its contact points, native defaults, failures and refusals."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.scene.collisions import Collisions
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, ContactSphere, Ground, Inertia, Joint
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.readback import compare
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.testing.contact_cases import RADIUS as R
from mbds_xsim.testing.contact_cases import ball, crate, gaps
from tests.adapters.exact import Runs
from tests.over_ground import over_ground

pybullet: Any = pytest.importorskip("pybullet")

ENGINE = load_adapter("pybullet")
METHOD = "semi-implicit-euler"
Vector = tuple[float, float, float]
MU, E = 0.43, 0.9332
STILL = (0.0, 0.0, 0.0)


simulate = Runs(ENGINE, {}).stepped


@pytest.mark.parametrize("profile", ["native", "matched"])
def test_where_a_ball_touched_before_is_forgotten(profile: Any) -> None:
    """A ball put back by a tenth of a radius would still have its old point as a second one."""
    scene = ball(velocity=(0.01, 0.0, 0.0), spin=(0.0, 0.01 / R, 0.0), steps=20)
    batch = draw_batch(scene, [0])
    settings = Settings(METHOD, 1e-3, ENGINE.settings(scene, profile).options)
    with ENGINE.open(scene, settings) as run:
        first, second = run.rollout(batch), run.rollout(batch)
    assert np.array_equal(first.position, second.position)


@pytest.mark.parametrize("part", ["base", "link"])
def test_a_sphere_off_the_centre_touches_where_it_is(part: str) -> None:
    """The sphere is on a free body or one on a hinge, both with turned principal axes."""
    odd = Inertia(1.0, (0.03, 0.05, 0.06), (0.01, -0.004, 0.008), com=(0.1, 0.0, 1.0))
    centre = (0.4, 0.3, 0.9)
    hinge = Joint("hinge", "hinge", "world", "a", (-0.3, 0.0, 0.6), axis=(0.0, 1.0, 0.0))
    joints = (hinge,) if part == "link" else ()
    more = {"joints": joints, "clock": Clock(steps=50)}
    scene = over_ground(Body("a", inertia=odd), centre, 0.15, Ground(MU, E), **more)
    motion = simulate(scene, 200)
    lowest = gaps(scene, motion)[0, :, 0]
    assert (np.diff(lowest) > 0).any()  # it has bounced
    assert -1e-3 < lowest.min() < 0.05


@pytest.mark.parametrize("part", ["base", "link", "hit"])
def test_spheres_beyond_those_that_a_shape_holds_touch_as_the_others_do(part: str) -> None:
    """Sixteen more spheres inside a crate, which come first, change nothing."""
    scene = crate(tilt=0.3, height=0.3, steps=30)
    if part == "link":
        top = Body("top", inertia=Inertia(1.0, (0.1,) * 3), position=(0.0, 0.1, 1.2))
        hinge = Joint("hinge", "hinge", "top", "crate", (0.0, 0.1, 0.8), axis=(0.6, 0.0, 0.8))
        scene = msgspec.structs.replace(scene, bodies=(*scene.bodies, top), joints=(hinge,))
    if part == "hit":
        low = Body("low", inertia=Inertia(1.0, (0.1,) * 3), position=(0.13, 0.25, R))
        law = Collisions(pairs=(("crate", "low"),), friction=0.3, restitution=0.4)
        spheres = (*scene.contacts, ContactSphere("low", low.position, R))
        scene = msgspec.structs.replace(
            scene, bodies=(*scene.bodies, low), contacts=spheres, collisions=law
        )
    inner = (ContactSphere("crate", (0.0, 0.01 * k, 0.5), R) for k in range(16))
    more = msgspec.structs.replace(scene, contacts=(*inner, *scene.contacts))

    motion, wanted = (simulate(each, 50) for each in (more, scene))
    np.testing.assert_allclose(motion.position, wanted.position, atol=1e-9)
    assert (motion.velocity[0, :, 0, 2] > 0).any()  # it has bounced
    settings, batch = ENGINE.settings(more, "matched"), draw_batch(more, [0])
    with ENGINE.open(more, settings) as run:
        assert not compare(Mechanism.of(more), batch, settings, run.readback(batch))


@pytest.mark.parametrize("key", ["lateralFriction", "restitution"])
def test_coefficients_are_read_back_from_every_link(
    key: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All but the first sixteen spheres of a crate are on a link of their own."""
    contact = sys.modules["mbds_xsim_adapters.pybullet.contact"].BulletContact
    set_pair = contact.set_pair

    def set_odd(self: Any, number: int, link: int, body: int) -> None:
        set_pair(self, number, link, body)
        if link == 0:
            self._client.build("changeDynamics", number, link, **{key: 0.1})

    monkeypatch.setattr(contact, "set_pair", set_odd)
    scene = crate(tilt=0.3, height=0.3, steps=30)
    inner = (ContactSphere("crate", (0.0, 0.01 * k, 0.5), R) for k in range(16))
    more = msgspec.structs.replace(scene, contacts=(*inner, *scene.contacts))
    _, (difference,) = Runs(ENGINE, {}).read_back(more, more)
    name = key.removeprefix("lateral").lower()
    assert f"{name} of sphere 16 on crate: got [" in difference
    assert "(8 differ)" in difference


def test_spheres_that_would_pass_through_others_are_refused() -> None:
    hinge = Joint("hinge", "hinge", "world", "crate", (0.0, 0.0, 0.3), axis=(0.0, 1.0, 0.0))
    scene = msgspec.structs.replace(crate(height=0.1), joints=(hinge,))
    many = msgspec.structs.replace(scene, contacts=scene.contacts * 3)
    tip = Body("tip", inertia=Inertia(1.0, (0.1,) * 3), position=(0.0, 0.0, 0.5))
    weld = Joint("weld", "fixed", "crate", "tip", (0.0, 0.0, 0.5))
    welded = msgspec.structs.replace(
        scene,
        bodies=(*scene.bodies, tip),
        joints=(hinge, weld),
        contacts=(ContactSphere("tip", tip.position, R),),
    )
    post = Body("post", inertia=Inertia(1.0, (0.1,) * 3), position=(0.0, 0.0, 1.0))
    stuck = Joint("stuck", "fixed", "world", "post", (0.0, 0.0, 1.0))
    hit = msgspec.structs.replace(
        welded,
        bodies=(*welded.bodies, post),
        joints=(*welded.joints, stuck),
        contacts=(*welded.contacts, ContactSphere("post", post.position, R)),
        ground=None,
        collisions=Collisions(pairs=(("tip", "post"),), friction=0.3, restitution=0.4),
    )
    crowd = msgspec.structs.replace(scene, joints=(), contacts=scene.contacts * 250)
    passing = "PyBullet lets no sphere of 'tip' touch the ground, or others like it; put them on"
    for refused, reason in (
        (many, "'crate' has 24 contact spheres, PyBullet takes 16 if a joint ties it to the world"),
        (welded, passing),
        (hit, passing),
        (crowd, "'crate' carries more sliders, .* or sixteens of contact spheres, than the 121"),
    ):
        with pytest.raises(Unsupported, match=reason):
            ENGINE.open(refused, ENGINE.settings(refused, "matched"))


def test_an_ordinary_user_gets_the_engines_own_contact() -> None:
    """The native profile sets nothing about contact but the pair's coefficients."""
    scene = ball(height=0.3, velocity=(2.0, 0.0, 0.0), ground=Ground(0.5, 0.5), steps=100)
    settings = ENGINE.settings(scene, "native")
    with ENGINE.open(scene, settings) as run:
        motion = run.rollout(draw_batch(scene, [0]))
    p = pybullet
    client = p.connect(p.DIRECT)
    p.setGravity(0, 0, -9.81, physicsClientId=client)
    p.setTimeStep(settings.step, physicsClientId=client)
    plane = p.createMultiBody(
        0.0, p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client), physicsClientId=client
    )
    shape = p.createCollisionShape(p.GEOM_SPHERE, radius=R, physicsClientId=client)
    body = p.createMultiBody(1.0, shape, basePosition=[0, 0, 0.3 + R], physicsClientId=client)
    p.changeDynamics(plane, -1, lateralFriction=1.0, restitution=1.0, physicsClientId=client)
    p.changeDynamics(
        body, -1, lateralFriction=0.5, restitution=0.5, localInertiaDiagonal=[6.17e-4] * 3,
        physicsClientId=client,
    )  # fmt: skip
    p.resetBaseVelocity(body, [2.0, 0.0, 0.0], physicsClientId=client)
    for _ in range(round(2.0 / settings.step)):
        p.stepSimulation(physicsClientId=client)
    end = p.getBasePositionAndOrientation(body, physicsClientId=client)[0]
    p.disconnect(client)
    np.testing.assert_allclose(motion.position[0, -1, 0], end, rtol=0, atol=1e-7)


def test_what_goes_wrong_ends_the_trajectory() -> None:
    fast = ball(velocity=(10.0, 0.0, 0.0), spin=(0.0, 10.0 / R, 0.0))
    sunk = msgspec.structs.replace(ball(height=-1.5 * R), name="sunk")
    for scene, reason in ((fast, "π/4"), (sunk, "contact is lost: sphere 0 on 'ball'")):
        with ENGINE.open(scene, Settings(METHOD, 0.004)) as run:
            motion = run.rollout(draw_batch(scene, [0]))
        failure = motion.failures[0]
        assert failure is not None
        assert failure.frame == 1
        assert reason in failure.reason
        assert np.isnan(motion.position[0, 1:]).all()


def test_what_bullet_would_cut_or_cannot_mean_is_refused() -> None:
    with pytest.raises(Unsupported, match="friction: got 11, allowed is up to 10"):
        ENGINE.open(ball(ground=Ground(11.0, E)), Settings(METHOD, 1e-3))
    for options in (
        {"contact_recovery": 1e-4},
        {"bounce_threshold": -1.0},
        {"contact_reach": -1.0},
    ):
        with pytest.raises(InputError, match=next(iter(options))):
            ENGINE.open(ball(), Settings(METHOD, 1e-3, options))


def test_scenes_without_contact_have_no_ground() -> None:
    scene = load_scene("5pendulum")
    settings = ENGINE.settings(scene, "native")
    with ENGINE.open(scene, settings) as run:
        assert run.size.contact_pairs == 0
        assert "createCollisionShape" not in run.native(draw_batch(scene, [0]))
    assert not any("contact" in name for name in settings.options)


def test_the_listing_runs_without_the_toolkit(tmp_path: Path) -> None:
    scene = load_scene("particlecar")
    batch = draw_batch(scene, [0], noise=False, inputs=False).truncated(20)
    scene = msgspec.structs.replace(scene, clock=Clock(steps=20))
    # A listing only says that friction axes turn, so they are off here.
    with ENGINE.open(scene, Settings(METHOD, 1e-3, {"friction_axes": False})) as run:
        run.rollout(batch)  # an earlier rollout must not change the listing
        end = run.rollout(batch).position[0, -1]
        (tmp_path / "model.py").write_text(run.native(batch))
    done = subprocess.run(
        [sys.executable, tmp_path / "model.py"], capture_output=True, check=True, text=True
    )
    for place in end.tolist():
        assert str(tuple(place)) in done.stdout
