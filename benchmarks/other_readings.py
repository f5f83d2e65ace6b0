"""Deviation of an import from two other readings of its file: MuJoCo's compiler and Pinocchio.

Bodies are matched by the joint that holds them. Compared are mass, centre of mass, inertia, and the
joint's place and axis. The deviation is the largest of these differences, in relative terms.
"""

from __future__ import annotations

import site
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.imported import Imported
from mbds_xsim.scene.mechanism import Mechanism

Reading = dict[str, tuple[float, Array, Array, Array, Array]]
"""By joint: mass, centre of mass and inertia of what it holds, its place and its axis."""


def from_compiled(path: Path, imported: Imported) -> float:
    """Return the deviation from MuJoCo's compiled model, with bodies fixed together merged."""
    import mujoco

    spec = mujoco.MjSpec.from_file(str(path))
    if path.suffix == ".urdf":
        spec.compiler.inertiafromgeom = 0
        spec.compiler.fusestatic = False  # fusing would drop the inertia of bodies without mass
        for item in [*spec.geoms, *spec.meshes]:
            spec.delete(item)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    reading = {}
    for j in range(model.njnt):
        body = model.jnt_bodyid[j]
        last = model.body_jntadr[body] + model.body_jntnum[body] - 1 == j
        own = np.flatnonzero(model.body_weldid == body) if last else np.array([], dtype=int)
        pose = data.xanchor[j].copy(), data.xaxis[j].copy()
        reading[model.joint(j).name] = (*_together(model, data, own), *pose)
    return max([0.0, *_deviations(imported, reading)])


def from_pinocchio(path: Path, imported: Imported, packages: Path) -> float:
    """Return the deviation from Pinocchio's reading of a URDF, which merges such bodies too."""
    site.addsitedir(str(packages))
    import pinocchio

    model = pinocchio.buildModelFromUrdf(str(path))
    data = model.createData()
    pose = pinocchio.neutral(model)
    pinocchio.computeJointJacobians(model, data, pose)
    reading = {}
    for j in range(1, model.njoints):
        place, body = data.oMi[j], model.inertias[j]
        jacobian = pinocchio.getJointJacobian(model, data, j, pinocchio.LOCAL_WORLD_ALIGNED)
        column = np.reshape(jacobian, (6, -1))[:, model.joints[j].idx_v]
        axis = column[3:] if np.linalg.norm(column[3:]) > 0 else column[:3]
        com = place.act(body.lever)
        inertia = place.rotation @ body.inertia @ place.rotation.T
        reading[model.names[j]] = (body.mass, com, inertia, place.translation.copy(), axis)
    return max([0.0, *_deviations(imported, reading)])


def _together(model: Any, data: Any, bodies: Any) -> tuple[float, Array, Array]:
    mass = model.body_mass[bodies]
    if not mass.sum() > 0:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    turns = [data.xmat[body].reshape(3, 3) for body in bodies]
    # `data.xipos` would round a centre of mass near the frame's origin to the origin.
    arms = [turn @ model.body_ipos[body] for turn, body in zip(turns, bodies, strict=True)]
    places = data.xpos[bodies] + np.array(arms)
    com, inertia = mass @ places / mass.sum(), np.zeros((3, 3))
    for own, body, turn, arm in zip(mass, bodies, turns, places - com, strict=True):
        axes = turn @ rotation.matrix(model.body_iquat[body])
        inertia += axes @ np.diag(model.body_inertia[body]) @ axes.T
        inertia += own * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return float(mass.sum()), com, inertia


def _deviations(imported: Imported, reading: Reading) -> Iterator[float]:
    """Yield all deviations, with bodies matched by the joint that holds them."""
    scene, mechanism = imported.scene, Mechanism.of(imported.scene)
    mended = {  # bodies whose mass is not as stated in the file
        place.split(":")[0]
        for fate in imported.fates
        if fate.outcome == "approximated" and fate.element == "inertial"
        for place in fate.places
    }
    index = {body.name: k for k, body in enumerate(scene.bodies) if body.name not in mended}
    for joint in (joint for joint in scene.joints if joint.name in reading):
        mass, com, inertia, anchor, axis = reading[joint.name]
        yield float(np.linalg.norm(np.array(joint.anchor) - anchor)) / scene.length
        if joint.axis is not None:
            yield float(np.linalg.norm(np.array(joint.axis) - axis))
        if joint.child in index and mass > 0:
            k, scale = index[joint.child], float(np.linalg.norm(inertia))
            yield abs(float(mechanism.mass[k]) / mass - 1)
            yield float(np.linalg.norm(mechanism.com[k] - com)) / scene.length
            yield float(np.linalg.norm(mechanism.inertia[k] - inertia)) / scale
