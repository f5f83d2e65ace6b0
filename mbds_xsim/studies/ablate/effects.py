"""What a scene models and could do without: each effect, and the scene in which it is weaker.

An effect is a function of the scene and a factor: 0 drops it, ½ halves it. It is found in the
scene itself; where there is no such effect the function gives None. Gravity is none of them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import msgspec
import numpy as np

from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.assembly import check_joints
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import INTERVALS, Levels
from mbds_xsim.scene.scene import Joint, Scene, Vector
from mbds_xsim.scene.state import Batch
from mbds_xsim.studies.ablate.inertia import own_inertia, rod_inertia, rotary_inertia, wheel_inertia

DROP, HALF = 0.0, 0.5
_replace = msgspec.structs.replace
_TURNED = ("hinge", "fixed")


@dataclass(frozen=True)
class Effect:
    """One thing that a scene may model."""

    name: str
    dropped: str
    """What is left without it."""
    weaken: Callable[[Scene, float], Scene | None]
    """The scene in which the effect is the factor times as strong; None where there is none.

    Raises SceneError where no such scene can be."""
    factors: tuple[float, ...] = (DROP, HALF)
    starts: Literal["kept", "redrawn", "in plane"] = "kept"
    """Whether starts and inputs stay those of the full scene; or the effect is a part of them,
    which are then drawn from the same random numbers; or only forces along y are weaker."""


def _friction(scene: Scene, factor: float) -> Scene | None:
    if scene.ground is None or scene.ground.friction == 0.0:
        return None
    ground = _replace(scene.ground, friction=factor * scene.ground.friction)
    return _replace(scene, ground=ground)


def _restitution(scene: Scene, factor: float) -> Scene | None:
    if scene.ground is None or scene.ground.restitution == 0.0:
        return None
    ground = _replace(scene.ground, restitution=factor * scene.ground.restitution)
    return _replace(scene, ground=ground)


def _ground(scene: Scene, _: float) -> Scene | None:
    draws = tuple(draw for draw in scene.sampling if draw.__struct_config__.tag != "roll")
    return _replace(scene, ground=None, contacts=(), sampling=draws) if scene.contacts else None


def _springs(scene: Scene, factor: float) -> Scene | None:
    if not any(spring.stiffness for spring in scene.springs):
        return None
    springs = tuple(_replace(s, stiffness=factor * s.stiffness) for s in scene.springs)
    return _replace(scene, springs=springs)


def _damping(scene: Scene, factor: float) -> Scene | None:
    if not any(spring.damping for spring in scene.springs):
        return None
    springs = tuple(_replace(s, damping=factor * s.damping) for s in scene.springs)
    return _replace(scene, springs=springs)


def _loops(scene: Scene, _: float) -> Scene | None:
    """Open all loops: the joints that close them go, and so do distance links."""
    closing = {joint.name for joint in Mechanism.of(scene).loops}
    if not closing and not scene.distance_links:
        return None
    kept = tuple(joint for joint in scene.joints if joint.name not in closing)
    return _replace(scene, joints=kept, distance_links=())


def _loop_axes(scene: Scene, _: float) -> Scene | None:
    """Close loops by points alone."""
    closing = {joint.name for joint in Mechanism.of(scene).loops if joint.kind in _TURNED}
    if not closing:
        return None
    return _replace(
        scene, joints=tuple(_as_ball(j) if j.name in closing else j for j in scene.joints)
    )


def _as_ball(joint: Joint) -> Joint:
    return Joint(joint.name, "ball", joint.parent, joint.child, joint.anchor)


def _third_dimension(scene: Scene, _: float) -> Scene | None:
    """Keep motion in the x–z plane: ball joints of the tree become hinges about y."""
    tree = [link.joint for link in Mechanism.of(scene).links]
    if scene.dimension < 3 or any(joint is None or joint.kind != "ball" for joint in tree):
        return None
    if Mechanism.of(scene).loops:
        msg = (
            "hinges about y in closed loops repeat conditions, with which the reference cannot step"
        )
        raise SceneError(msg)
    names = {joint.name for joint in tree if joint is not None}
    return _replace(
        scene, joints=tuple(_as_hinge(j) if j.name in names else j for j in scene.joints)
    )


def _as_hinge(joint: Joint) -> Joint:
    return _replace(joint, kind="hinge", axis=(0.0, 1.0, 0.0))


def _sideways(scene: Scene, _: float) -> Scene | None:
    blown = any(draw.__struct_config__.tag == "wind" for draw in scene.sampling)
    return scene if scene.dimension == 3 and (scene.noise or scene.forces or blown) else None


def _noise(scene: Scene, factor: float) -> Scene | None:
    return _replace(scene, noise=factor * scene.noise) if scene.noise else None


def _listed_loads(scene: Scene, factor: float) -> Scene | None:
    forces = tuple(
        _replace(f, series=tuple((factor * x, factor * y, factor * z) for x, y, z in f.series))
        for f in scene.forces
    )
    torques = tuple(_replace(t, series=tuple(factor * x for x in t.series)) for t in scene.torques)
    return _replace(scene, forces=forces, torques=torques) if forces or torques else None


def _listed_velocities(scene: Scene, factor: float) -> Scene | None:
    bodies = tuple(
        _replace(
            b,
            velocity=_times(b.velocity, factor),
            angular_velocity=_times(b.angular_velocity, factor),
        )
        for b in scene.bodies
    )
    joints = tuple(
        _replace(j, rate=None if j.rate is None else factor * j.rate) for j in scene.joints
    )
    ablated = _replace(scene, bodies=bodies, joints=joints)
    return ablated if ablated != scene else None


def _times(vector: Vector | None, factor: float) -> Vector | None:
    return None if vector is None else (factor * vector[0], factor * vector[1], factor * vector[2])


def _drawn(*fields: tuple[str, str]) -> Callable[[Scene, float], Scene | None]:
    return functools.partial(_scaled_draws, fields=fields)


# Scenes whose draws are weaker: ranges scaled, so that the same random numbers give the same
# start and the same inputs but for one factor.


def _scaled_draws(
    scene: Scene, factor: float, *, fields: Collection[tuple[str, str]]
) -> Scene | None:
    """Scale fields of the scene's draws.

    Args:
        scene: What is sampled.
        factor: What the fields are multiplied by.
        fields: Kind of draw and name of a field of it.

    Returns:
        The scene, or None where no such draw has anything but 0 in these fields.
    """
    draws = []
    for draw in scene.sampling:
        names = [name for kind, name in fields if kind == draw.__struct_config__.tag]
        values = {name: _scaled(getattr(draw, name), factor) for name in names}
        draws.append(msgspec.structs.replace(draw, **values))
    # Doubled, they differ exactly where there is something to scale.
    if factor != 2.0 and _scaled_draws(scene, 2.0, fields=fields) == scene:
        return None
    return msgspec.structs.replace(scene, sampling=tuple(draws))


def _scaled(value: Any, factor: float) -> Any:
    """Scale a number, a range, ranges by interval, or a tuple of these."""
    if isinstance(value, Levels):
        return Levels(**{name: _scaled(getattr(value, name), factor) for name in INTERVALS})
    if isinstance(value, tuple):
        return tuple(_scaled(part, factor) for part in value)
    return factor * value


EFFECTS = (
    Effect("own inertia of particles", "particles are points", own_inertia),
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
    Effect("friction", "a smooth ground", _friction),
    Effect("restitution", "impacts without rebound", _restitution),
    Effect("springs", "dampers alone", _springs),
    Effect("damping", "springs without damping", _damping),
    Effect("closed loops", "joints and links that close loops are left out", _loops, (DROP,)),
    Effect("axes in loops", "loops closed by ball joints", _loop_axes, (DROP,)),
    Effect("third dimension", "hinges about y for ball joints", _third_dimension, (DROP,)),
    Effect("sideways forces", "forces in x and z alone", _sideways, starts="in plane"),
    Effect("wind", "no wind", _drawn(("wind", "mean")), starts="redrawn"),
    Effect("gusts", "a constant wind", _drawn(("wind", "deviation")), starts="redrawn"),
    Effect("drives", "no hinge torques", _drawn(("hinge_torque", "torque")), starts="redrawn"),
    Effect("listed loads", "without the scene's own series", _listed_loads, starts="redrawn"),
    Effect("noise", "no random forces", _noise, starts="redrawn"),
    Effect("listed velocities", "starts at rest", _listed_velocities, starts="redrawn"),
    Effect(
        "start velocity",
        "drawn starts at rest",
        _drawn(("swing", "speed"), ("turn", "rate"), ("throw", "velocity")),
        starts="redrawn",
    ),
    Effect(
        "start spin",
        "starts without spin",
        _drawn(("throw", "angular_velocity"), ("roll", "share")),
        starts="redrawn",
    ),
    Effect(
        "speed of wheels", "wheels start at rest", _drawn(("hinge_rate", "rate")), starts="redrawn"
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
    """Weaken each effect that a scene has, by each of its factors.

    Args:
        scene: The full scene.
        effects: What may be weakened.
        batch: Starts and inputs of the full scene.
        seed: Seed of these.
    """
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
