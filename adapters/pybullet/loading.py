"""Facts about a model file as PyBullet's own readers load it, with their default flags."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.imported import JointFacts, LinkFacts, ModelFacts

_KINDS = {0: "hinge", 1: "slider", 2: "ball", 3: "planar", 4: "fixed"}
_JOINT_NAME, _KIND, _DAMPING, _FRICTION, _LOW, _HIGH, _LINK_NAME, _AXIS = 1, 2, 6, 7, 8, 9, 12, 13

Ask = Callable[[str], Callable[..., Any]]
"""Bullet's functions for one connection, by their names."""


def load(path: Path, floating: bool) -> ModelFacts:
    """Read a URDF, SDF or MJCF file; see `mbds_xsim.simulate.registry`."""
    import pybullet

    from .client import Client

    with contextlib.closing(Client()) as client:
        ask = client.function
        try:
            if path.suffix.lower() == ".urdf":
                bodies: Any = [ask("loadURDF")(str(path), useFixedBase=not floating)]
            elif path.suffix.lower() == ".sdf":
                bodies = ask("loadSDF")(str(path))
            else:
                bodies = ask("loadMJCF")(str(path))
        except pybullet.error as error:
            raise InputError(str(error)) from error
        links = tuple(link for body in bodies for link in _links(ask, body))
        joints = tuple(joint for body in bodies for joint in _joints(ask, body))
        version, loops = ask("getAPIVersion")(), ask("getNumConstraints")()
    return ModelFacts(f"PyBullet (API {version})", links, joints, loops=loops)


def _links(ask: Ask, body: int) -> Iterator[LinkFacts]:
    place, turn = ask("getBasePositionAndOrientation")(body)
    base = ask("getBodyInfo")(body)[0].decode()
    yield _link(ask, body, -1, base, np.array(place), turn)
    for j in range(ask("getNumJoints")(body)):
        name = ask("getJointInfo")(body, j)[_LINK_NAME].decode()
        place, turn = ask("getLinkState")(body, j, computeForwardKinematics=True)[:2]
        yield _link(ask, body, j, name, np.array(place), turn)


def _link(
    ask: Ask, body: int, index: int, name: str, com: Array, turn: tuple[float, ...]
) -> LinkFacts:
    mass, _, moments = ask("getDynamicsInfo")(body, index)[:3]
    axes = _matrix(turn)
    return LinkFacts.of(name, mass, com, axes @ np.diag(moments) @ axes.T)


def _joints(ask: Ask, body: int) -> Iterator[JointFacts]:
    for j in range(ask("getNumJoints")(body)):
        info = ask("getJointInfo")(body, j)
        state = ask("getLinkState")(body, j, computeForwardKinematics=True)
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
