"""Faults of smooth motion: what users and adapters get wrong, each where it can be seen."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import msgspec
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.reference import accelerations
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Body, Inertia, Joint, Particle, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.adapter import Settings

from .bench import ENGINES
from .native import force_off_center, joint_damping, motors_left_on, no_reaction
from .planting import Fault

__all__ = ["SMOOTH", "gravity", "heavier", "stouter"]


_CONSISTENCY = ("consistency of positions", "consistency of energy")


def gravity(value: float) -> Callable[[Scene], Scene]:
    """Give the scene another gravity [m/s²]."""
    return lambda scene: msgspec.structs.replace(scene, gravity=(0.0, 0.0, -value))


def heavier(name: str, share: float) -> Callable[[Scene], Scene]:
    """Make the particles of a body heavier by a share of their mass."""

    def change(body: Body) -> Body:
        return _with_particles(
            body,
            lambda particle: msgspec.structs.replace(particle, mass=particle.mass * (1 + share)),
        )

    return _in_body(name, change)


def stouter(name: str, share: float) -> Callable[[Scene], Scene]:
    """Give a body more inertia, by a share of its largest moment, and no more mass."""

    def change(body: Body) -> Body:
        places = np.array([particle.position for particle in body.particles])
        spread = np.sum((places - places.mean(axis=0)) ** 2, axis=0)
        more = share * float(spread.sum() - spread.min()) / len(places)
        return _with_particles(
            body,
            lambda each: msgspec.structs.replace(each, inertia=each.inertia + more),
        )

    return _in_body(name, change)


def _with_particles(body: Body, change: Callable[[Particle], Particle]) -> Body:
    return msgspec.structs.replace(body, particles=tuple(map(change, body.particles)))


def _in_body(name: str, change: Callable[[Body], Body]) -> Callable[[Scene], Scene]:
    def changed(scene: Scene) -> Scene:
        bodies = tuple(change(body) if body.name == name else body for body in scene.bodies)
        assert bodies != scene.bodies
        return msgspec.structs.replace(scene, bodies=bodies)

    return changed


def _free_particles(scene: Scene) -> Scene:
    """Let particles keep their orientation: a rod then turns without their own inertia.

    What is left of it only keeps the inertia regular.
    """

    def loosen(particle: Particle) -> Particle:
        return msgspec.structs.replace(particle, inertia=1e-3 * particle.inertia)

    bodies = tuple(_with_particles(body, loosen) for body in scene.bodies)
    return msgspec.structs.replace(scene, bodies=bodies)


def _all_heavier(share: float) -> Callable[[Scene], Scene]:
    def changed(scene: Scene) -> Scene:
        for body in scene.bodies:
            scene = heavier(body.name, share)(scene)
        return scene

    return changed


def _thick_rods(scene: Scene) -> Scene:
    def thicken(body: Body) -> Body:
        (particle,) = body.particles
        moments = (particle.inertia, particle.inertia, 2.0 * particle.inertia)
        inertia = Inertia(particle.mass, moments, com=particle.position)
        return msgspec.structs.replace(body, particles=(), inertia=inertia)

    bodies = tuple(map(thicken, scene.bodies))
    return msgspec.structs.replace(scene, bodies=bodies, edges=())


def _swapped_axes(body: Body) -> Body:
    assert body.inertia is not None
    xx, yy, zz = body.inertia.moments
    inertia = msgspec.structs.replace(body.inertia, moments=(yy, xx, zz))
    return msgspec.structs.replace(body, inertia=inertia)


def _flipped(name: str) -> Callable[[Scene], Scene]:
    def flip(joint: Joint) -> Joint:
        if joint.name != name or joint.axis is None:
            return joint
        x, y, z = joint.axis
        return msgspec.structs.replace(joint, axis=(-x, -y, -z))

    def changed(scene: Scene) -> Scene:
        joints = tuple(flip(joint) for joint in scene.joints)
        assert joints != scene.joints
        return msgspec.structs.replace(scene, joints=joints)

    return changed


def _options(**options: float) -> Callable[[Settings], Settings]:
    return lambda settings: dataclasses.replace(settings, options={**settings.options, **options})


def _swapped_start(batch: Batch) -> Batch:
    """Take xyzw for wxyz."""
    return dataclasses.replace(batch, orientation=np.roll(batch.orientation, 1, axis=-1))


def _swapped_recording(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    """Record xyzw where wxyz is published."""
    return dataclasses.replace(motion, orientation=np.roll(motion.orientation, -1, axis=-1))


def _shifted(batch: Batch) -> Batch:
    """Apply each frame's inputs one frame late; the first frame has its own."""
    late = np.maximum(np.arange(batch.steps) - 1, 0)
    return dataclasses.replace(batch, force=batch.force[:, late], torque=batch.torque[:, late])


def _late(
    *, steps: float = 0.0, frames: float = 0.0, places: bool = True, speeds: bool = True
) -> Callable[[Scene, Batch, float, Trajectory], Trajectory]:
    """Record frames some steps or frames late; the first is the start."""

    def record(scene: Scene, batch: Batch, step: float, motion: Trajectory) -> Trajectory:
        delay = steps * step + frames * scene.clock.frame
        linear, angular = _pulls(scene, batch, motion)
        turned = delay * motion.angular_velocity + 0.5 * delay**2 * angular
        late = dataclasses.replace(motion)
        if places:
            moved = motion.position + delay * motion.velocity + 0.5 * delay**2 * linear
            spun = rotation.multiply(rotation.from_vector(turned), motion.orientation)
            late = dataclasses.replace(late, position=moved, orientation=spun)
        if speeds:
            late = dataclasses.replace(
                late,
                velocity=motion.velocity + delay * linear,
                angular_velocity=motion.angular_velocity + delay * angular,
            )
        return _with_first_frame(late, motion)

    return record


def _with_first_frame(late: Trajectory, motion: Trajectory) -> Trajectory:
    changed = {}
    for key in ("position", "orientation", "velocity", "angular_velocity"):
        changed[key] = getattr(late, key).copy()
        changed[key][:, 0] = getattr(motion, key)[:, 0]
    return dataclasses.replace(late, **changed)


def _pulls(scene: Scene, batch: Batch, motion: Trajectory) -> tuple[Array, Array]:
    """Accelerations just after each frame, under the inputs that then begin."""
    mechanism = Mechanism.of(scene)
    states = BodyStates(
        motion.position,
        mechanism.native_rotation(motion.orientation),
        motion.velocity,
        motion.angular_velocity,
    )
    held = np.minimum(np.arange(len(motion.time)), batch.steps - 1)
    return accelerations(mechanism, states, batch.force[:, held], batch.torque[:, held])


SMOOTH = (
    Fault(
        "default damping of 0.04 left on",
        "3pendulum",
        ("pybullet",),
        ("energy", *_CONSISTENCY),
        settings=_options(linear_damping=0.04, angular_damping=0.04),
        odd=True,
    ),
    Fault(
        "joint damping of 0.01 N·m·s left in",
        "3pendulum",
        ("mujoco", "dart"),
        ("energy", *_CONSISTENCY),
        told="damping",
        native=joint_damping,
        odd=True,
    ),
    Fault(
        "joint motors left on",
        "3pendulum",
        ("pybullet",),
        ("energy", "error growth-weighted"),
        native=motors_left_on,
        odd=True,
    ),
    Fault(
        "default solref on the loops",
        "2ladder",
        ("mujoco",),
        ("gap", *_CONSISTENCY),
        settings=_options(loop_time_constant=0.0),
    ),
    Fault(
        "one rung 1 % heavier",
        "2ladder",
        ENGINES,
        _CONSISTENCY,
        told="mass [kg] of rung1",
        model=heavier("rung1", 0.01),
    ),
    Fault(
        "inertia axes swapped",
        "workbench",
        ("mujoco", "pybullet", "dart"),
        _CONSISTENCY,
        told="inertia [kg·m²] of forearm",
        model=_in_body("forearm", _swapped_axes),
    ),
    Fault(
        "quaternion order swapped at the start",
        "3pendulum",
        ("mujoco", "exudyn"),
        ("start",),
        told="start: orientation",
        inputs=_swapped_start,
        odd=True,
    ),
    Fault(
        "quaternion order swapped in the recording",
        "3pendulum",
        ("dart", "pybullet"),
        ("start",),
        motion=_swapped_recording,
    ),
    Fault(
        "hinge axis flipped",
        "workbench",
        ENGINES,
        _CONSISTENCY,
        told="axis of shoulder",
        model=_flipped("shoulder"),
        odd=True,
    ),
    Fault(
        "frames half a step late",
        "3pendulum",
        ENGINES,
        ("kinematics", *_CONSISTENCY),
        motion=_late(steps=0.5),
    ),
    Fault(
        "positions half a step late",
        "3pendulum",
        ENGINES,
        ("kinematics", "velocity lag", *_CONSISTENCY),
        motion=_late(steps=0.5, speeds=False),
    ),
    Fault(
        "velocities half a step late",
        "3pendulum",
        ENGINES,
        ("kinematics", "velocity lag", *_CONSISTENCY),
        motion=_late(steps=0.5, places=False),
    ),
    Fault(
        "velocities half a step late, first order with loops",
        "2ladder",
        ("pybullet", "dart"),
        ("kinematics", "velocity lag"),
        motion=_late(steps=0.5, places=False),
    ),
    Fault(
        "frames half a frame late",
        "3pendulum",
        ENGINES,
        ("error growth-weighted", *_CONSISTENCY),
        motion=_late(frames=0.5),
        odd=True,
    ),
    Fault(
        "force 5 cm off the centre of mass",
        "3pendulum",
        ("pybullet", "dart", "exudyn"),
        _CONSISTENCY,
        native=force_off_center,
    ),
    Fault(
        "hinge torque without its reaction",
        "workbench",
        ENGINES,
        ("momentum", *_CONSISTENCY),
        native=no_reaction,
        odd=True,
    ),
    Fault("inputs a frame late", "3pendulum", ENGINES, _CONSISTENCY, inputs=_shifted),
    Fault(
        "gravity 9.80",
        "3pendulum",
        ENGINES,
        _CONSISTENCY,
        told="gravity [m/s²]",
        model=gravity(9.80),
    ),
    Fault(
        "particles free instead of welded",
        "3pendulum",
        ENGINES,
        _CONSISTENCY,
        told="inertia [kg·m²] of link1",
        model=_free_particles,
        odd=True,
    ),
    Fault(
        "one particle 1 % heavier",
        "3pendulum",
        ENGINES,
        _CONSISTENCY,
        told="mass [kg] of link2",
        model=heavier("link2", 0.01),
    ),
    Fault(
        "all particles 1 % heavier",
        "3pendulum",
        ENGINES,
        _CONSISTENCY,
        told="mass [kg] of link1",
        model=_all_heavier(0.01),
    ),
    Fault(
        "axis of a hinge without a drive flipped",
        "workbench",
        ("mujoco", "dart"),
        (),
        told="axis of rocker pin",
        model=_flipped("rocker pin"),
        unseen=dict.fromkeys(
            ("mujoco", "dart"), "only the sign of the hinge's angle changes, which nothing uses"
        ),
    ),
    Fault(
        "inertia about the rods doubled",
        "3pendulum",
        ENGINES,
        (),
        told="inertia [kg·m²] of link1",
        model=_thick_rods,
        unseen=dict.fromkeys(
            ENGINES, "nothing turns a rod about itself, so no motion depends on it"
        ),
    ),
)
