"""How far a model moves otherwise with what an engine's reader makes of it."""

from __future__ import annotations

import msgspec
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.reference import solve
from mbds_xsim.scene.imported import Imported, LinkFacts, ModelFacts
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Inertia, Scene

_CLOCK = Clock(frame=0.02, steps=50)
_ROUNDED = 1e-6  # to single precision
_STARTS = (1, 4, 7)  # of the medium interval


def moved(imported: Imported, read: ModelFacts) -> float | None:
    """Solve the motion that the file says and the one that was read, from the same starts.

    Masses, centres of mass, inertias, and places, axes, springs and dampers of joints are taken as
    they were read; what was not read is as the file says.

    Returns:
        RMS distance after 1 s [m] of the points of the bodies that the file has for their centres
        of mass; None where the one that was read has no
        motion: bodies of no inertia, say.
    """
    said = msgspec.structs.replace(imported.scene, clock=_CLOCK)
    try:
        other = _scene_of(said, imported, read)
        points = Mechanism.of(said).com
        ends = [_ends(scene, points) for scene in (said, other)]
    except InputError:
        return None
    return float(np.sqrt(np.mean(np.sum((ends[1] - ends[0]) ** 2, axis=-1))))


def _scene_of(scene: Scene, imported: Imported, read: ModelFacts) -> Scene:
    links = {link.name: link for link in read.links}
    own: dict[str, list[LinkFacts]] = {}
    other = set()
    for link in imported.facts.links:
        found = links.get(link.name, link)
        own.setdefault(link.body, []).append(found)
        if not _alike(found, link):
            other.add(link.body)
    joints = {joint.name: joint for joint in read.joints}
    placed = [
        msgspec.structs.replace(
            joint,
            anchor=tuple(own_joint.anchor),
            axis=tuple(own_joint.axis),
            damping=own_joint.damping,
            stiffness=own_joint.stiffness,
        )
        if (own_joint := joints.get(joint.name)) and joint.axis and any(own_joint.axis)
        else joint
        for joint in scene.joints
    ]
    bodies = [_loaded(b, own[b.name]) if b.name in other else b for b in scene.bodies]
    return msgspec.structs.replace(scene, bodies=tuple(bodies), joints=tuple(placed))


def _alike(read: LinkFacts, said: LinkFacts) -> bool:
    first, second = (np.array([link.mass, *link.com, *link.inertia]) for link in (read, said))
    return bool(np.allclose(first, second, rtol=_ROUNDED, atol=_ROUNDED * np.abs(second).max()))


def _loaded(body: Body, links: list[LinkFacts]) -> Body:
    """Give a body the sum of its links; where they weigh nothing it stays as it is."""
    mass = sum(link.mass for link in links)
    if not mass > 0:
        return body
    com = np.asarray(sum(link.mass * np.array(link.com) for link in links) / mass)
    tensor = np.zeros((3, 3))
    for link in links:
        arm = np.array(link.com) - com
        tensor += link.tensor + link.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    back = rotation.matrix(np.array(body.orientation)).T
    tensor = back @ tensor @ back.T
    inertia = Inertia(
        mass=mass,
        moments=(tensor[0, 0], tensor[1, 1], tensor[2, 2]),
        products=(tensor[0, 1], tensor[0, 2], tensor[1, 2]),
        com=(back @ (com - np.array(body.position))).tolist(),
    )
    return msgspec.structs.replace(body, inertia=inertia)


def _ends(scene: Scene, points: Array) -> Array:
    """Give where points of the bodies are at the end.

    Args:
        scene: What moves.
        points: A point of each body, in W at the reference pose [m], shape (body, 3).

    Returns:
        Their places [m], shape (start, body, 3).
    """
    motion = solve(scene, draw_batch(scene, _STARTS), rtol=1e-9)
    mechanism = Mechanism.of(scene)
    arm = points - mechanism.com
    native = mechanism.native_rotation(motion.orientation[:, -1])
    return np.asarray(motion.position[:, -1] + rotation.rotate(native, arm))
