"""Effects that a scene may do without, each with the scene in which it is weaker.

An effect is a function of the scene and a factor: 0 drops it, ½ halves it. It is found in the
scene itself; the function returns None if there is no such effect. Gravity is not among them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import msgspec
import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.assembly import check_joints
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mass import with_mass_properties
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import INTERVALS, Levels
from mbds_xsim.scene.scene import Joint, Scene
from mbds_xsim.scene.state import Batch

DROP, HALF = 0.0, 0.5
Weaken = Callable[[Scene, float], Scene | None]
_replace = msgspec.structs.replace
_PLANAR_KINDS = ("hinge", "fixed")


@dataclass(frozen=True)
class Effect:
    """One thing that a scene may model."""

    name: str
    dropped: str
    """Description of the model without it."""
    weaken: Weaken
    """Function that returns the scene with the effect scaled by a factor; None if it has none.

    Raises SceneError if no such scene is possible."""
    factors: tuple[float, ...] = (DROP, HALF)
    starts: Literal["kept", "redrawn", "in plane"] = "kept"
    """Origin of starts and inputs: "kept" from the full scene; "redrawn" from the same random
    numbers, as the effect is a part of them; or "in plane", with only forces along y weaker."""


def _part(*paths: str, least: float = 0.0) -> Weaken:
    """Return a function that scales numbers of a scene.

    It scales ranges too, so that the same random numbers give the same start but for the factor.

    Args:
        paths: Field names from the scene on, joined by dots. In a tuple all members count, or only
            those of the kind that stands before a colon, as in `sampling.wind:mean`.
        least: Smallest factor, for numbers that may not be zero.
    """

    def weaken(scene: Scene, factor: float) -> Scene | None:
        def scaled(share: float) -> Any:
            steps = (path.split(".") for path in paths)
            return functools.reduce(lambda one, path: _scale_at(one, path, share), steps, scene)

        # Halving changes the scene exactly if there is something to scale.
        return None if scaled(HALF) == scene else scaled(max(factor, least))

    return weaken


def _scale_at(value: Any, path: Sequence[str], factor: float) -> Any:
    """Scale the value at a path: a number, a range, ranges by interval, or a tuple of these."""
    if isinstance(value, tuple):
        return tuple(_scale_at(part, path, factor) for part in value)
    if isinstance(value, Levels):
        return Levels(*(_scale_at(getattr(value, name), path, factor) for name in INTERVALS))
    if not path or value is None:
        return None if value is None else factor * value
    kind, _, name = path[0].rpartition(":")
    if kind and value.__struct_config__.tag != kind:
        return value
    return _replace(value, **{name: _scale_at(getattr(value, name), path[1:], factor)})


def _ground(scene: Scene, _: float) -> Scene | None:
    draws = tuple(draw for draw in scene.sampling if draw.__struct_config__.tag != "roll")
    changes = {"ground": None, "collisions": None, "contacts": (), "sampling": draws}
    return _replace(scene, **changes) if scene.contacts else None


def _loops(scene: Scene, _: float) -> Scene | None:
    """Open all loops: remove the joints that close them, and distance links."""
    closing = {joint.name for joint in Mechanism.of(scene).loops}
    if not closing and not scene.distance_links:
        return None
    joints = tuple(joint for joint in scene.joints if joint.name not in closing)
    return _replace(scene, joints=joints, distance_links=())


def _gears(scene: Scene, _: float) -> Scene | None:
    return _replace(scene, couplings=()) if scene.couplings else None


def _stops(scene: Scene, _: float) -> Scene | None:
    limited = {joint.name for joint in scene.joints if joint.limits}
    return _with_joints(scene, limited, lambda j: _replace(j, limits=None, restitution=0.0))


def _saturation(scene: Scene, _: float) -> Scene | None:
    if not any(servo.limit for servo in scene.servos):
        return None
    return _replace(scene, servos=tuple(_replace(servo, limit=None) for servo in scene.servos))


def _loop_axes(scene: Scene, _: float) -> Scene | None:
    """Replace hinges and fixed joints that close loops by ball joints."""
    closing = {joint.name for joint in Mechanism.of(scene).loops if joint.kind in _PLANAR_KINDS}
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
        raise SceneError(
            "hinges about y in closed loops repeat conditions, with which the reference cannot step"
        )
    return _with_joints(scene, names, lambda j: _replace(j, kind="hinge", axis=(0.0, 1.0, 0.0)))


def _with_joints(
    scene: Scene, names: Collection[str], changed: Callable[[Joint], Joint]
) -> Scene | None:
    joints = tuple(changed(joint) if joint.name in names else joint for joint in scene.joints)
    return _replace(scene, joints=joints) if names else None


def _sideways(scene: Scene, _: float) -> Scene | None:
    windy = any(draw.__struct_config__.tag == "wind" for draw in scene.sampling)
    return scene if scene.dimension == 3 and (scene.noise or scene.forces or windy) else None


# Bodies with less inertia, but the same masses and centres of mass. A body without inertia would
# have an undefined spin, so a thousandth of a dropped inertia remains.

LEAST = 1e-3  # remaining share of a dropped inertia
_ON_LINE = 1e-9  # largest offset from a line, over the longest arm


def _rotary_inertia(scene: Scene, factor: float) -> Scene | None:
    """Weaken the whole inertia of bodies; None if every body is a single particle."""
    if all(len(body.particles) == 1 for body in scene.bodies):
        return None
    mechanism, share = Mechanism.of(scene), max(factor, LEAST)
    return _with_inertia(mechanism, {k: share * t for k, t in enumerate(mechanism.inertia)})


def _inertia_about(axis_of: Callable[[Mechanism, int], Array | None]) -> Weaken:
    """Return a function that scales bodies' moments about an axis; those about normals stay."""

    def weaken(scene: Scene, factor: float) -> Scene | None:
        mechanism, share = Mechanism.of(scene), max(factor, LEAST)
        tensors = {}
        for body, tensor in enumerate(mechanism.inertia):
            axis = axis_of(mechanism, body)
            if axis is not None:
                less = (1.0 - share) * (axis @ tensor @ axis)
                tensors[body] = np.asarray(tensor - less * np.outer(axis, axis))
        return _with_inertia(mechanism, tensors) if tensors else None

    return weaken


def _rod_axis(mechanism: Mechanism, body: int) -> Array | None:
    """Return the line through a body's ball joints and centre of mass; None if there is none."""
    own = [joint for joint in mechanism.joints if body in (joint.parent, joint.child)]
    arms = np.array([j.in_child if j.child == body else j.in_parent for j in own]).reshape(-1, 3)
    lengths = np.linalg.norm(arms, axis=1)
    if any(joint.kind != "ball" for joint in own) or not lengths.max(initial=0.0) > 0:
        return None
    axis = np.asarray(arms[lengths.argmax()] / lengths.max())
    offset = np.linalg.norm(np.cross(arms, axis), axis=1).max()
    return axis if offset <= _ON_LINE * lengths.max() else None


def _hinge_axis(mechanism: Mechanism, body: int) -> Array | None:
    """Return the axis of the hinge by which the spanning tree holds a body, if it does."""
    joint = next(link.joint for link in mechanism.links if link.body == body)
    return joint.axis if joint is not None and joint.kind == "hinge" else None


def _with_inertia(mechanism: Mechanism, tensors: Mapping[int, Array]) -> Scene:
    """Replace particles of bodies by inertia tensors about their centres of mass, in N."""
    bodies = list(mechanism.scene.bodies)
    for k, tensor in tensors.items():
        bodies[k] = with_mass_properties(bodies[k], mechanism.mass[k], mechanism.com[k], tensor)
    # The skeleton is drawn between particles, and some are gone.
    return _replace(mechanism.scene, bodies=tuple(bodies), edges=(), anchors=())


EFFECTS = (
    Effect(
        "own inertia of particles",
        "particles are points",
        _part("bodies.particles.inertia", least=LEAST),
    ),
    Effect(
        "spin inertia of rods",
        "no inertia about the line through a body's ball joints and centre of mass",
        _inertia_about(_rod_axis),
    ),
    Effect(
        "inertia about hinges",
        "half the inertia of bodies about the hinge that holds them",
        _inertia_about(_hinge_axis),
        (HALF,),
    ),
    Effect("rotary inertia", "half the inertia of every body", _rotary_inertia, (HALF,)),
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
            ("listed loads", "without the scene's own series", "forces.series", "torques.series"),
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
    """A weakened effect: the scene and its starts, or the reason why there are none."""

    effect: Effect
    factor: float
    scene: Scene
    batch: Batch
    reason: str = ""


def variants_of(
    scene: Scene, effects: Sequence[Effect], batch: Batch, seed: int
) -> list[AblatedScene]:
    """Weaken each effect of a scene by each of its factors, for starts drawn with a seed."""
    variants = []
    for effect in effects:
        for factor in effect.factors:
            try:
                ablated = effect.weaken(scene, factor)
                if ablated is None:
                    continue
                starts = _starts(scene, ablated, effect, factor, batch, seed)
            except SceneError as error:
                reason = str(error).removeprefix("sampling: ").split(", allowed")[0]
                variants.append(AblatedScene(effect, factor, scene, batch, reason))
            else:
                variants.append(AblatedScene(effect, factor, ablated, starts))
    return variants


def _starts(
    scene: Scene, ablated: Scene, effect: Effect, factor: float, batch: Batch, seed: int
) -> Batch:
    if effect.starts == "redrawn":
        return draw_batch(ablated, batch.index, seed=seed)
    if effect.starts == "in plane":
        return dataclasses.replace(batch, force=batch.force * [1.0, factor, 1.0])
    return _fit_batch(scene, ablated, batch)


def _fit_batch(scene: Scene, ablated: Scene, batch: Batch) -> Batch:
    """Fit the full scene's starts and inputs to the ablated one; raise if joints forbid it."""
    mechanism, other = Mechanism.of(scene), Mechanism.of(ablated)
    check_joints(other, BodyStates.of(mechanism, batch))
    torque = np.zeros((len(batch), batch.steps, len(other.hinges)))
    columns = {joint.name: k for k, joint in enumerate(mechanism.hinges)}
    for k, joint in enumerate(other.hinges):
        if joint.name in columns:
            torque[:, :, k] = batch.torque[:, :, columns[joint.name]]
    return dataclasses.replace(batch, torque=torque)
