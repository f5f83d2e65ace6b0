"""What a scene models and could do without: each effect, and the scene in which it is weaker.

An effect is a function of the scene and a factor: 0 drops it, ½ halves it. It is found in the
scene itself; where there is no such effect the function gives None. Gravity is none of them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import msgspec
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.assembly import check_joints
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import INTERVALS, Levels
from mbds_xsim.scene.scene import Body, Inertia, Joint, Scene
from mbds_xsim.scene.state import Batch

DROP, HALF = 0.0, 0.5
Weaken = Callable[[Scene, float], Scene | None]
_replace = msgspec.structs.replace
_TURNED = ("hinge", "fixed")


@dataclass(frozen=True)
class Effect:
    """One thing that a scene may model."""

    name: str
    dropped: str
    """What is left without it."""
    weaken: Weaken
    """The scene in which the effect is the factor times as strong; None where there is none.

    Raises SceneError where no such scene can be."""
    factors: tuple[float, ...] = (DROP, HALF)
    starts: Literal["kept", "redrawn", "in plane"] = "kept"
    """Whether starts and inputs stay those of the full scene; or the effect is a part of them,
    which are then drawn from the same random numbers; or only forces along y are weaker."""


def _part(*paths: str, least: float = 0.0) -> Weaken:
    """Scale numbers of a scene: ranges too, so that the same random numbers give the same start.

    Args:
        paths: Names of fields from the scene on, with dots between them; of a tuple all members are
            meant, or those of the kind that stands before a colon: `sampling.wind:mean`.
        least: What is left at least of what may not be zero.
    """

    def weaken(scene: Scene, factor: float) -> Scene | None:
        def scaled(share: float) -> Any:
            steps = (path.split(".") for path in paths)
            return functools.reduce(lambda one, path: _scaled_at(one, path, share), steps, scene)

        # Halved, they differ exactly where there is something to scale.
        return None if scaled(HALF) == scene else scaled(max(factor, least))

    return weaken


def _scaled_at(value: Any, path: Sequence[str], factor: float) -> Any:
    """Scale what a path leads to: a number, a range, ranges by interval, or a tuple of these."""
    if isinstance(value, tuple):
        return tuple(_scaled_at(part, path, factor) for part in value)
    if isinstance(value, Levels):
        return Levels(*(_scaled_at(getattr(value, name), path, factor) for name in INTERVALS))
    if not path or value is None:
        return None if value is None else factor * value
    kind, _, name = path[0].rpartition(":")
    if kind and value.__struct_config__.tag != kind:
        return value
    return _replace(value, **{name: _scaled_at(getattr(value, name), path[1:], factor)})


def _ground(scene: Scene, _: float) -> Scene | None:
    draws = tuple(draw for draw in scene.sampling if draw.__struct_config__.tag != "roll")
    left = {"ground": None, "collisions": None, "contacts": (), "sampling": draws}
    return _replace(scene, **left) if scene.contacts else None


def _loops(scene: Scene, _: float) -> Scene | None:
    """Open all loops: the joints that close them go, and so do distance links."""
    closing = {joint.name for joint in Mechanism.of(scene).loops}
    if not closing and not scene.distance_links:
        return None
    kept = tuple(joint for joint in scene.joints if joint.name not in closing)
    return _replace(scene, joints=kept, distance_links=())


def _gears(scene: Scene, _: float) -> Scene | None:
    return _replace(scene, couplings=()) if scene.couplings else None


def _stops(scene: Scene, _: float) -> Scene | None:
    stopped = {joint.name for joint in scene.joints if joint.limits}
    replaced = functools.partial(msgspec.structs.replace, limits=None, restitution=0.0)
    return _with_joints(scene, stopped, replaced)


def _saturation(scene: Scene, _: float) -> Scene | None:
    if not any(servo.limit for servo in scene.servos):
        return None
    servos = (msgspec.structs.replace(servo, limit=None) for servo in scene.servos)
    return _replace(scene, servos=tuple(servos))


def _loop_axes(scene: Scene, _: float) -> Scene | None:
    """Close loops by points alone."""
    closing = {joint.name for joint in Mechanism.of(scene).loops if joint.kind in _TURNED}
    return _with_joints(
        scene, closing, lambda j: Joint(j.name, "ball", j.parent, j.child, j.anchor)
    )


def _third_dimension(scene: Scene, _: float) -> Scene | None:
    """Keep motion in the x–z plane: ball joints of the tree become hinges about y."""
    tree = [link.joint for link in Mechanism.of(scene).links]
    names = {joint.name for joint in tree if joint is not None and joint.kind == "ball"}
    if scene.dimension < 3 or len(names) < len(tree):
        return None
    if Mechanism.of(scene).loops:
        msg = (
            "hinges about y in closed loops repeat conditions, with which the reference cannot step"
        )
        raise SceneError(msg)
    return _with_joints(
        scene, names, lambda joint: _replace(joint, kind="hinge", axis=(0.0, 1.0, 0.0))
    )


def _with_joints(
    scene: Scene, names: Collection[str], changed: Callable[[Joint], Joint]
) -> Scene | None:
    joints = tuple(changed(joint) if joint.name in names else joint for joint in scene.joints)
    return _replace(scene, joints=joints) if names else None


def _sideways(scene: Scene, _: float) -> Scene | None:
    blown = any(draw.__struct_config__.tag == "wind" for draw in scene.sampling)
    return scene if scene.dimension == 3 and (scene.noise or scene.forces or blown) else None


# Bodies with less inertia, with the same masses and centres of mass. No body can do without any:
# its spin would be undefined. Dropped means that a thousandth is left.

LEAST = 1e-3  # of an inertia that is dropped
_ON_LINE = 1e-9  # of the longest arm


def rotary_inertia(scene: Scene, factor: float) -> Scene | None:
    """Weaken the whole inertia of bodies; None where it is their particles' own alone."""
    if all(len(body.particles) == 1 for body in scene.bodies):
        return None
    mechanism, kept = Mechanism.of(scene), max(factor, LEAST)
    return _with_inertia(mechanism, {k: kept * t for k, t in enumerate(mechanism.inertia)})


def rod_inertia(scene: Scene, factor: float) -> Scene | None:
    """Weaken the inertia about the line on which a body's ball joints and centre of mass lie."""
    return _about_axes(scene, _rod_axis, factor)


def wheel_inertia(scene: Scene, factor: float) -> Scene | None:
    """Weaken the inertia of bodies about the hinge by which the spanning tree holds them."""
    return _about_axes(scene, _hinge_axis, factor)


def _about_axes(
    scene: Scene, axis_of: Callable[[Mechanism, int], Array | None], factor: float
) -> Scene | None:
    mechanism = Mechanism.of(scene)
    axes = {body: axis_of(mechanism, body) for body in range(mechanism.body_count)}
    tensors = {
        body: _less_about(mechanism.inertia[body], axis, max(factor, LEAST))
        for body, axis in axes.items()
        if axis is not None
    }
    return _with_inertia(mechanism, tensors) if tensors else None


def _less_about(tensor: Array, axis: Array, kept: float) -> Array:
    """Scale the moment about a unit axis; the moments about normals of it stay."""
    return np.asarray(tensor - (1.0 - kept) * (axis @ tensor @ axis) * np.outer(axis, axis))


def _rod_axis(mechanism: Mechanism, body: int) -> Array | None:
    """Direction of a rod; None for a body that another joint holds, or that is no rod."""
    own = [joint for joint in mechanism.joints if body in (joint.parent, joint.child)]
    arms = np.array([j.in_child if j.child == body else j.in_parent for j in own]).reshape(-1, 3)
    lengths = np.linalg.norm(arms, axis=1)
    if any(joint.kind != "ball" for joint in own) or not lengths.max(initial=0.0) > 0:
        return None
    axis = np.asarray(arms[lengths.argmax()] / lengths.max())
    off = np.linalg.norm(np.cross(arms, axis), axis=1).max()
    return axis if off <= _ON_LINE * lengths.max() else None


def _hinge_axis(mechanism: Mechanism, body: int) -> Array | None:
    joint = next(link.joint for link in mechanism.links if link.body == body)
    return joint.axis if joint is not None and joint.kind == "hinge" else None


def _with_inertia(mechanism: Mechanism, tensors: Mapping[int, Array]) -> Scene:
    """Give bodies the inertia about their centres of mass in N, in place of their particles."""
    bodies = list(mechanism.scene.bodies)
    for k, tensor in tensors.items():
        bodies[k] = _given(bodies[k], mechanism.mass[k], mechanism.com[k], tensor)
    # The skeleton is drawn between particles, and some are gone.
    return _replace(mechanism.scene, bodies=tuple(bodies), edges=(), anchors=())


def _given(body: Body, mass: float, com: Array, tensor: Array) -> Body:
    turn = rotation.matrix(np.array(body.orientation))
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (turn.T @ tensor @ turn).tolist()
    x, y, z = (turn.T @ (com - np.array(body.position))).tolist()
    inertia = Inertia(float(mass), (xx, yy, zz), (xy, xz, yz), (x, y, z))
    return _replace(body, particles=(), inertia=inertia)


EFFECTS = (
    Effect(
        "own inertia of particles",
        "particles are points",
        _part("bodies.particles.inertia", least=LEAST),
    ),
    Effect(
        "spin inertia of rods",
        "no inertia about the line through a body's ball joints and centre of mass",
        rod_inertia,
    ),
    Effect(
        "inertia about hinges",
        "half the inertia of bodies about the hinge that holds them",
        wheel_inertia,
        (HALF,),
    ),
    Effect("rotary inertia", "half the inertia of every body", rotary_inertia, (HALF,)),
    Effect("ground", "no contact at all", _ground, (DROP,)),
    Effect("friction", "smooth contact", _part("ground.friction", "collisions.friction")),
    Effect(
        "restitution",
        "impacts without rebound",
        _part("ground.restitution", "collisions.restitution"),
    ),
    Effect("springs", "dampers alone", _part("springs.stiffness")),
    Effect("damping", "springs without damping", _part("springs.damping")),
    Effect("springs of joints", "joints without springs", _part("joints.stiffness")),
    Effect("damping of joints", "joints without dampers", _part("joints.damping")),
    Effect("armature", "joints without rotors", _part("joints.armature")),
    Effect("dry friction", "joints without dry friction", _part("joints.friction")),
    Effect("stops", "joints without limits", _stops, (DROP,)),
    Effect("saturation", "servos without limits", _saturation, (DROP,), starts="redrawn"),
    Effect("gears", "joints that follow none", _gears, (DROP,)),
    Effect("closed loops", "joints and links that close loops are left out", _loops, (DROP,)),
    Effect("axes in loops", "loops closed by ball joints", _loop_axes, (DROP,)),
    Effect("third dimension", "hinges about y for ball joints", _third_dimension, (DROP,)),
    Effect("sideways forces", "forces in x and z alone", _sideways, starts="in plane"),
    *(
        Effect(name, dropped, _part(*paths), starts="redrawn")
        for name, dropped, *paths in (
            ("wind", "no wind", "sampling.wind:mean"),
            ("gusts", "a constant wind", "sampling.wind:deviation"),
            ("drives", "no hinge torques", "sampling.hinge_torque:torque"),
            (
                "listed loads",
                "without the scene's own series",
                "forces.series",
                "torques.series",
            ),
            ("noise", "no random forces", "noise"),
            (
                "listed velocities",
                "starts at rest",
                "bodies.velocity",
                "bodies.angular_velocity",
                "joints.rate",
            ),
            (
                "start velocity",
                "drawn starts at rest",
                "sampling.swing:speed",
                "sampling.turn:rate",
                "sampling.throw:velocity",
            ),
            (
                "start spin",
                "starts without spin",
                "sampling.throw:angular_velocity",
                "sampling.roll:share",
            ),
            ("hinge rates", "hinges start at rest", "sampling.hinge_rate:rate"),
        )
    ),
)
"""All effects, in the order of the tables."""


@dataclass(frozen=True, eq=False)
class AblatedScene:
    """An effect made weaker: the scene and its starts, or why there are none."""

    effect: Effect
    factor: float
    scene: Scene
    batch: Batch
    reason: str = ""


def variants_of(
    scene: Scene, effects: Sequence[Effect], batch: Batch, seed: int
) -> list[AblatedScene]:
    """Weaken each effect that a scene has by each of its factors, for starts drawn with a seed."""
    found = []
    for effect in effects:
        for factor in effect.factors:
            try:
                ablated = effect.weaken(scene, factor)
                if ablated is None:
                    continue
                starts = _starts(scene, ablated, effect, factor, batch, seed)
            except SceneError as error:
                reason = str(error).removeprefix("sampling: ").split(", allowed")[0]
                found.append(AblatedScene(effect, factor, scene, batch, reason))
            else:
                found.append(AblatedScene(effect, factor, ablated, starts))
    return found


def _starts(
    scene: Scene, ablated: Scene, effect: Effect, factor: float, batch: Batch, seed: int
) -> Batch:
    if effect.starts == "redrawn":
        return draw_batch(ablated, batch.index, seed=seed)
    if effect.starts == "in plane":
        return dataclasses.replace(batch, force=batch.force * [1.0, factor, 1.0])
    return _kept(scene, ablated, batch)


def _kept(scene: Scene, ablated: Scene, batch: Batch) -> Batch:
    """Give the full scene's starts and inputs to the ablated one; raise where joints forbid it."""
    mechanism, other = Mechanism.of(scene), Mechanism.of(ablated)
    native = mechanism.native_rotation(batch.orientation)
    check_joints(other, BodyStates(batch.position, native, batch.velocity, batch.angular_velocity))
    torque = np.zeros((len(batch), batch.steps, len(other.hinges)))
    columns = {joint.name: k for k, joint in enumerate(mechanism.hinges)}
    for k, joint in enumerate(other.hinges):
        if joint.name in columns:
            torque[:, :, k] = batch.torque[:, :, columns[joint.name]]
    return dataclasses.replace(batch, torque=torque)
