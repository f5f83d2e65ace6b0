"""Facts about a model file as PyBullet's own readers load it, with their default flags."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.imported import JointFacts, LinkFacts, ModelFacts

_KINDS = {0: "hinge", 1: "slider", 2: "ball", 3: "planar", 4: "fixed"}
_JOINT_NAME, _KIND, _DAMPING, _FRICTION, _LOW, _HIGH, _LINK_NAME, _AXIS = 1, 2, 6, 7, 8, 9, 12, 13


def load(path: Path, floating: bool) -> ModelFacts:
    """Read a URDF, SDF or MJCF file; see `mbds_xsim.simulate.registry`."""
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

    client = BulletClient(pybullet.DIRECT)  # it disconnects where it is no longer used
    try:
        if path.suffix.lower() == ".urdf":
            bodies: Any = [client.loadURDF(str(path), useFixedBase=not floating)]
        elif path.suffix.lower() == ".sdf":
            bodies = client.loadSDF(str(path))
        else:
            bodies = client.loadMJCF(str(path))
    except pybullet.error as error:
        raise InputError(str(error)) from error
    links, joints = [], []
    for body in bodies:
        links += list(_links(client, body))
        joints += list(_joints(client, body))
    version = client.getAPIVersion()
    return ModelFacts(f"PyBullet (API {version})", tuple(links), tuple(joints))


def _links(client: Any, body: int) -> Iterator[LinkFacts]:
    place, turn = client.getBasePositionAndOrientation(body)
    base = client.getBodyInfo(body)[0].decode()
    yield _link(client, body, -1, base, np.array(place), turn)
    for j in range(client.getNumJoints(body)):
        name = client.getJointInfo(body, j)[_LINK_NAME].decode()
        place, turn = client.getLinkState(body, j, computeForwardKinematics=True)[:2]
        yield _link(client, body, j, name, np.array(place), turn)


def _link(
    client: Any, body: int, index: int, name: str, com: Array, turn: tuple[float, ...]
) -> LinkFacts:
    mass, _, moments = client.getDynamicsInfo(body, index)[:3]
    axes = _matrix(turn)
    return LinkFacts.of(name, mass, com, axes @ np.diag(moments) @ axes.T)


def _joints(client: Any, body: int) -> Iterator[JointFacts]:
    for j in range(client.getNumJoints(body)):
        info = client.getJointInfo(body, j)
        state = client.getLinkState(body, j, computeForwardKinematics=True)
        if (kind := _KINDS[info[_KIND]]) == "fixed":
            continue
        limited = info[_LOW] <= info[_HIGH] and (info[_LOW], info[_HIGH]) != (0.0, 0.0)
        yield JointFacts(
            name=info[_JOINT_NAME].decode(),
            kind=kind,
            anchor=state[4],
            axis=(_matrix(state[1]) @ info[_AXIS]).tolist() if kind in ("hinge", "slider") else
            (0.0, 0.0, 0.0),
            damping=info[_DAMPING],
            friction=info[_FRICTION],
            limits=(info[_LOW], info[_HIGH]) if limited else None,
        )  # fmt: skip


def _matrix(turn: tuple[float, ...]) -> Array:
    x, y, z, w = turn
    quaternion = np.array([w, x, y, z])
    return rotation.matrix(quaternion / np.linalg.norm(quaternion))
