"""The scenes in which faults are planted: built-in ones, cut short or started in another way."""

from __future__ import annotations

import functools

import msgspec

from mbds_xsim.scene.budget import Budget
from mbds_xsim.scene.collisions import Collisions
from mbds_xsim.scene.coupling import Coupling
from mbds_xsim.scene.sampling_terms import Draw, HingeRate, HingeTorque, Roll, Throw
from mbds_xsim.scene.scene import Body, Scene
from mbds_xsim.scene.servo import Servo
from mbds_xsim.simulate import registry

__all__ = ["SCENES", "scene_of"]

SCENES = {
    "3pendulum": 50,
    "2ladder": 25,
    "workbench": 16,
    "workbench with sprung joints": 16,
    "workbench with a limited servo": 8,
    "workbench with rotors": 8,
    "workbench with a gear": 16,
    "workbench with dry friction": 16,
    "workbench with stops": 16,
    "workbench with rebounds": 16,
    "ballscroll": 40,
    "ballscroll at 45°": 40,
    "balldrop": 75,
    "particlecar": 10,
    "particlecar for 0.8 s": 40,
    "particlecar at 100 rad/s": 12,
    "particlecar with damped axles": 10,
    "ballscroll with another ball": 14,
    "simplecubli": 50,
    "simplecubli for 3 s": 150,
    "simplecubli in flight": 18,
    "simplecubli set down": 15,
}
"""Number of recorded frames: a second, or enough for the faults planted in the scene."""

_NONE = (0.0, 0.0)
_SPUN = (_NONE, _NONE, (150.0, 160.0))


@functools.cache
def scene_of(name: str, frames: int | None = None) -> Scene:
    """Load a scene, change it as its name says, and cut it to `frames` or its usual length."""
    scene = registry.load_scene(name.split()[0])
    clock = msgspec.structs.replace(scene.clock, steps=frames or SCENES[name])
    scene = msgspec.structs.replace(scene, clock=clock)
    changes = {
        "ballscroll at 45°": _across,
        "ballscroll with another ball": _colliding,
        "particlecar at 100 rad/s": _fast,
        "particlecar with damped axles": _damped,
        "simplecubli set down": _set_down,
        "workbench with sprung joints": _sprung,
        "workbench with a limited servo": _driven,
        "workbench with rotors": _geared,
        "workbench with a gear": _coupled,
        "workbench with dry friction": _braked,
        "workbench with stops": _stopped,
        "workbench with rebounds": _rebounding,
    }
    return changes[name](scene) if name in changes else scene


def _across(scene: Scene) -> Scene:
    """Throw the ball between x and y, without spin."""
    throw = Throw("ball", velocity=((3.0, 3.0), (3.0, 3.0), _NONE))
    return _started(msgspec.structs.replace(scene, dimension=3), throw, Roll("ball", share=_NONE))


def _colliding(scene: Scene) -> Scene:
    """Throw the ball at another one, off its middle, without ground and gravity."""
    ball, sphere = scene.bodies[0], scene.contacts[0]
    x, y, z = sphere.center
    other = msgspec.structs.replace(sphere, body="other", center=(x + 0.5, y + 0.02, z))
    mass = ball.particles[0]
    hit = Body("other", (msgspec.structs.replace(mass, position=other.center),))
    throw = Throw("ball", velocity=((2.5, 3.0), (-0.1, 0.1), _NONE), angular_velocity=_SPUN)
    alone = msgspec.structs.replace(
        scene,
        bodies=(ball, hit),
        contacts=(sphere, other),
        ground=None,
        collisions=Collisions((("ball", "other"),), 0.2, 0.8),
        gravity=(0.0, 0.0, 0.0),
        noise=0.0,
        edges=(),
        dimension=3,
        budget=Budget(),
    )
    return _started(alone, throw)


def _fast(scene: Scene) -> Scene:
    """Drive a car whose wheels are about to pass 100 rad/s."""
    wheels = tuple(joint.name for joint in scene.joints)
    rolling = (scene.contacts[0].radius, 0.0, 0.0)
    rate = HingeRate(wheels, rate=(99.8, 99.9), travel=rolling)
    return _started(scene, rate, HingeTorque(wheels, torque=(1.5, 2.0), hold=scene.clock.steps))


def _damped(scene: Scene) -> Scene:
    """Damp the axles of a car."""
    joints = (msgspec.structs.replace(joint, damping=0.02) for joint in scene.joints)
    return msgspec.structs.replace(scene, joints=tuple(joints))


def _set_down(scene: Scene) -> Scene:
    """Set a cube down on four corners, on ground whose low restitution soon stops rebounds."""
    assert scene.ground is not None
    drop = min(sphere.center[2] - sphere.radius for sphere in scene.contacts)
    throw = Throw("frame", displacement=(_NONE, _NONE, (-drop, -drop)))
    ground = msgspec.structs.replace(scene.ground, restitution=0.5)
    return _started(msgspec.structs.replace(scene, noise=0.0, ground=ground), throw)


def _sprung(scene: Scene) -> Scene:
    """Give a hinge and a slider springs and dampers of their own, and another hinge a servo."""
    laws = {
        "elbow": {"stiffness": 4.0, "damping": 0.1, "rest": 0.3},
        "rail": {"stiffness": 20.0, "damping": 1.0, "rest": 0.05},
    }
    joints = (msgspec.structs.replace(j, **laws.get(j.name, {})) for j in scene.joints)
    servo = Servo("shoulder", position=(0.3,), stiffness=20.0, damping=1.0)
    return msgspec.structs.replace(scene, joints=tuple(joints), servos=(servo,))


def _driven(scene: Scene) -> Scene:
    """Give the arm a servo that has to push as hard as it can on the way to its target."""
    servo = Servo("shoulder", position=(1.0,), stiffness=60.0, damping=3.0, limit=8.0)
    return msgspec.structs.replace(_sprung(scene), servos=(servo,))


def _geared(scene: Scene) -> Scene:
    """Give two hinges of the arm rotors, which DART cannot have in scenes with loops."""
    joints = (
        msgspec.structs.replace(j, armature=0.05) if j.name in ("shoulder", "elbow") else j
        for j in scene.joints
    )
    return msgspec.structs.replace(scene, joints=tuple(joints))


def _coupled(scene: Scene) -> Scene:
    """Let the arm's rotor follow its elbow by a coupling, which DART and Exudyn cannot have."""
    draws = (draw for draw in scene.sampling if not isinstance(draw, HingeRate))
    coupling = Coupling("rotor axle", "elbow", ratio=3.0)
    return msgspec.structs.replace(scene, sampling=tuple(draws), couplings=(coupling,))


def _braked(scene: Scene) -> Scene:
    """Brake two hinges of the arm and the cart."""
    friction = {"shoulder": 0.3, "elbow": 0.2, "rail": 0.5}
    joints = (msgspec.structs.replace(j, friction=friction.get(j.name, 0.0)) for j in scene.joints)
    return msgspec.structs.replace(scene, joints=tuple(joints))


_LIMITS = {"elbow": (-1.0, 0.25), "rail": (-0.06, -0.03)}
"""Limits within reach of the sprung workbench."""


def _stopped(scene: Scene, restitution: float = 0.0) -> Scene:
    """Let the elbow and the cart run into stops."""
    law = {name: {"limits": pair, "restitution": restitution} for name, pair in _LIMITS.items()}
    scene = _sprung(scene)
    joints = (msgspec.structs.replace(j, **law.get(j.name, {})) for j in scene.joints)
    return msgspec.structs.replace(scene, joints=tuple(joints))


def _rebounding(scene: Scene) -> Scene:
    """Let these stops give half of a speed back, which only MuJoCo's stops can."""
    return _stopped(scene, 0.5)


def _started(scene: Scene, *sampling: Draw) -> Scene:
    return msgspec.structs.replace(scene, sampling=sampling)
