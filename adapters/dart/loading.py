"""Facts about a model file as DART's own readers load it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.imported import JointFacts, LinkFacts, ModelFacts
from mbds_xsim.simulate.adapter import version_of

_PACKAGE = re.compile(r"package://([^/\"]+)/")
_KINDS = {
    "RevoluteJoint": "hinge",
    "PrismaticJoint": "slider",
    "BallJoint": "ball",
    "FreeJoint": "free",
    "WeldJoint": "fixed",
}


def load(path: Path, floating: bool) -> ModelFacts:
    """Read a URDF, SDF or MJCF file; see `mbds_xsim.simulate.registry`."""
    import dartpy

    utils, loops = dartpy.utils, 0
    if path.suffix.lower() == ".urdf":
        root = utils.DartLoaderRootJointType
        options = utils.DartLoaderOptions()
        options.mDefaultRootJointType = root.FLOATING if floating else root.FIXED
        loader = utils.DartLoader()
        loader.setOptions(options)
        for name in set(_PACKAGE.findall(path.read_text(errors="replace"))):
            for above in path.absolute().parents:
                if (above / name).is_dir():  # PyBullet finds it there, too
                    loader.addPackageDirectory(name, str(above / name))
                    break
        skeletons = [loader.parseSkeleton(str(path))]
    elif path.suffix.lower() == ".sdf" and "<world" not in path.read_text(errors="replace"):
        skeletons = [utils.SdfParser.readSkeleton(str(path))]
    else:
        parser = utils.SdfParser if path.suffix.lower() == ".sdf" else utils.MjcfParser
        world = parser.readWorld(str(path))
        if world is None:
            raise InputError("it gives no world")
        skeletons = [world.getSkeleton(k) for k in range(world.getNumSkeletons())]
        loops = world.getConstraintSolver().getNumConstraints()
    if not skeletons or None in skeletons:
        raise InputError("it gives no skeleton")
    for skeleton in skeletons:  # DART starts it inside the limits, even if 0 lies outside
        skeleton.setPositions(np.zeros(skeleton.getNumDofs()))
    nodes = [node for skeleton in skeletons for node in skeleton.getBodyNodes()]
    links = tuple(_link(node) for node in nodes)
    joints = tuple(joint for node in nodes for joint in _joints(node))
    mimic = dartpy.dynamics.ActuatorType.MIMIC
    couplings = sum(node.getParentJoint().getActuatorType() == mimic for node in nodes)
    return ModelFacts(f"DART {version_of('dartpy')}", links, joints, couplings, loops)


def _link(node: Any) -> LinkFacts:
    inertia = node.getInertia()
    axes = node.getTransform().rotation()
    return LinkFacts.of(
        node.getName(), inertia.getMass(), node.getCOM(), axes @ inertia.getMoment() @ axes.T
    )


def _joints(node: Any) -> Iterator[JointFacts]:
    joint = node.getParentJoint()
    kind = _KINDS.get(joint.getType(), joint.getType())
    if kind == "fixed":
        return
    place = node.getTransform().multiply(joint.getTransformFromChildBodyNode())
    axes: list[Any] = [None]
    if kind in ("hinge", "slider"):
        axes = [joint.getAxis()]
    elif kind == "UniversalJoint":  # two hinges, as the format's reader calls them
        kind, axes = "hinge", [joint.getAxis1(), joint.getAxis2()]
    for k, axis in enumerate(axes):
        limits = (joint.getPositionLowerLimit(k), joint.getPositionUpperLimit(k))
        yield JointFacts(
            name=joint.getName() if len(axes) == 1 else f"{joint.getName()} {k + 1}",
            kind=kind,
            anchor=place.translation().tolist(),
            axis=(0.0, 0.0, 0.0) if axis is None else (place.rotation() @ axis).tolist(),
            damping=joint.getDampingCoefficient(k),
            friction=joint.getCoulombFriction(k),
            stiffness=joint.getSpringStiffness(k),
            limits=limits if any(map(math.isfinite, limits)) and limits != (0.0, 0.0) else None,
            enforced=joint.areLimitsEnforced(),
        )
