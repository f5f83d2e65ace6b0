"""Scenes as USD Physics: prims are at centres of mass and parallel to W; only axes are rotated.

The schema has masses, joint frames and limits in single precision, and positions of bodies in
double. Schema: https://openusd.org/release/api/usd_physics_page_front.html
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.frame import optional
from mbds_xsim.scene.imported import Fate, Written
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint, PointPair
from mbds_xsim.scene.scene import Joint, Scene
from mbds_xsim.scene.servo import Servo, by_joint

from .writing import dropped_fate, first_targets, unique, unlike, without_servos, written

_KINDS = {"hinge": "RevoluteJoint", "slider": "PrismaticJoint", "ball": "SphericalJoint",
          "fixed": "FixedJoint"}  # fmt: skip
_TABLES = ("bodies", "joints", "distance_links")
_LACKS = {
    "springs": "USD Physics has no springs between points",
    "couplings": "USD Physics has no joints that follow others",
    "joints.armature": "USD Physics has no rotors",
    "joints.friction": "USD Physics has no dry friction of joints",
    "joints.restitution": "USD Physics has no rebound from limits",
}
_GAINS = ("stiffness", "damping")
_LEAST = float(np.finfo(np.float32).tiny)
_SINGLE = "numbers of masses, joints and gravity are of single precision in the schema"
_NAMING = "USD names consist of letters, digits and _, and are unique"
_AS_SERVO = "a drive to its rest: a servo that exerts the same"
_ONE = "a joint has one drive, which is that of a servo with a limit"


def write(scene: Scene) -> Written:
    """Write USD Physics as text; see `mbds_xsim.simulate.registry`.

    Raises:
        InputError: A body is too light for single precision, or OpenUSD is not installed.
    """
    optional("pxr.UsdPhysics", "writing USD", "usd")
    stage = _Stage(scene)
    return written(stage.text(), scene, _LACKS, [*first_targets(scene), *stage.fates])


class _Stage:
    """A stage that holds the scene, with the fates of its names, springs and servos."""

    def __init__(self, scene: Scene) -> None:
        from pxr import Gf, Tf, Usd, UsdGeom, UsdPhysics

        self._schema, self._gf, self._scene = UsdPhysics, Gf, scene
        self._servos = by_joint(scene.servos)
        self._stage = Usd.Stage.CreateInMemory()
        UsdGeom.SetStageUpAxis(self._stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(self._stage, 1.0)
        UsdPhysics.SetStageKilogramsPerUnit(self._stage, 1.0)
        names, self.fates = unlike(scene, _TABLES, Tf.MakeValidIdentifier, _NAMING)
        # Readers call a body by its name alone if no other prim has it.
        self._root = f"/{unique(Tf.MakeValidIdentifier(scene.name), names.values())}"
        self._stage.SetDefaultPrim(UsdGeom.Xform.Define(self._stage, self._root).GetPrim())
        self.fates.append(Fate("numbers", (), "approximated", _SINGLE, True))
        self._paths = {key: f"{self._root}/{name}" for key, name in names.items()}
        self._gravity(np.array(scene.gravity))
        mechanism = without_servos(scene)
        for body in range(mechanism.body_count):
            self._body(mechanism, body)
        loops = {joint.name for joint in mechanism.loops}
        for joint in mechanism.joints:
            self._joint(joint, closes=joint.name in loops)
        for pair in mechanism.distances:
            self._distance(pair)

    def text(self) -> str:
        """Return the stage as text."""
        return str(self._stage.GetRootLayer().ExportToString())

    def _gravity(self, gravity: Array) -> None:
        world = self._schema.Scene.Define(self._stage, f"{self._root}_world")
        size = float(np.linalg.norm(gravity))
        down = gravity / size if size else np.array([0.0, 0.0, -1.0])
        world.CreateGravityDirectionAttr(self._gf.Vec3f(*down.tolist()))
        world.CreateGravityMagnitudeAttr(size)

    def _body(self, mechanism: Mechanism, body: int) -> None:
        from pxr import UsdGeom

        path = self._paths["bodies", mechanism.scene.bodies[body].name]
        prim = UsdGeom.Xform.Define(self._stage, path)
        prim.AddTranslateOp().Set(self._gf.Vec3d(*mechanism.com[body].tolist()))
        self._schema.RigidBodyAPI.Apply(prim.GetPrim())
        mass = self._schema.MassAPI.Apply(prim.GetPrim())
        moments, axes = _principal(mechanism.inertia[body])
        if moments[0] < _LEAST:
            msg = f"the body {path.rpartition('/')[2]!r} has a moment of inertia of {moments[0]:g} "
            raise InputError(f"{msg}kg·m²; USD, of single precision, takes {_LEAST:.2g} or more")
        mass.CreateMassAttr(float(mechanism.mass[body]))
        mass.CreateCenterOfMassAttr(self._gf.Vec3f(0.0))
        mass.CreateDiagonalInertiaAttr(self._gf.Vec3f(*moments))
        mass.CreatePrincipalAxesAttr(self._gf.Quatf(*rotation.from_matrix(axes).tolist()))

    def _joint(self, joint: PlacedJoint, *, closes: bool) -> None:
        schema = getattr(self._schema, _KINDS[joint.kind])
        prim = schema.Define(self._stage, self._paths["joints", joint.name])
        self._hold(prim, (joint.parent, joint.child), (joint.in_parent, joint.in_child))
        if closes:
            prim.CreateExcludeFromArticulationAttr(True)
        if not joint.axis.any():
            return
        turn = np.column_stack([*rotation.normal_to(joint.axis), joint.axis])
        frame = self._gf.Quatf(*rotation.from_matrix(turn).tolist())
        prim.CreateAxisAttr("Z")
        prim.CreateLocalRot0Attr(frame)
        prim.CreateLocalRot1Attr(frame)
        unit = _unit(joint.kind)
        if joint.limits:
            prim.CreateLowerLimitAttr(joint.limits[0] / unit)
            prim.CreateUpperLimitAttr(joint.limits[1] / unit)
        servo = self._servo(self._scene.joints[joint.index])
        if servo is not None:
            self._drive(prim.GetPrim(), servo, joint.kind)

    def _servo(self, joint: Joint) -> Servo | None:
        """Return servos, spring and damper of a joint as one servo; one with a limit is alone."""
        laws = [*self._servos[joint.name]]
        springs = joint.stiffness or joint.damping
        if springs:
            laws.append(Servo(joint.name, (joint.rest,), (0.0,), joint.stiffness, joint.damping))
        limited = next((servo for servo in laws if servo.limit is not None), None)
        if limited is None and springs:
            law = ("stiffness", "damping", "rest")
            self.fates.append(Fate("joints", law, "kept", _AS_SERVO, True, (joint.name,)))
        elif limited is not None and len(laws) > 1:
            self.fates.append(dropped_fate("joints", _ONE, joint.name, "drives"))
        return limited or _sum(laws)

    def _drive(self, prim: Any, servo: Servo, kind: str) -> None:
        unit = _unit(kind)
        drive = self._schema.DriveAPI.Apply(prim, "angular" if kind == "hinge" else "linear")
        drive.CreateTypeAttr("force")
        drive.CreateStiffnessAttr(servo.stiffness * unit)
        drive.CreateDampingAttr(servo.damping * unit)
        drive.CreateTargetPositionAttr(servo.position[0] / unit)
        drive.CreateTargetVelocityAttr(servo.velocity[0] / unit)
        if servo.limit is not None:
            drive.CreateMaxForceAttr(servo.limit)

    def _distance(self, pair: PointPair) -> None:
        path = self._paths["distance_links", pair.name]
        prim = self._schema.DistanceJoint.Define(self._stage, path)
        self._hold(prim, pair.bodies, pair.in_body)
        prim.CreateExcludeFromArticulationAttr(True)
        prim.CreateMinDistanceAttr(pair.length)
        prim.CreateMaxDistanceAttr(pair.length)

    def _hold(self, prim: Any, bodies: tuple[int, int], places: tuple[Array, Array]) -> None:
        bodies_of = (prim.CreateBody0Rel, prim.CreateBody1Rel)
        places_of = (prim.CreateLocalPos0Attr, prim.CreateLocalPos1Attr)
        for body, place, relate, put in zip(bodies, places, bodies_of, places_of, strict=True):
            if body != WORLD_INDEX:
                relate().SetTargets([self._paths["bodies", self._scene.bodies[body].name]])
            put(self._gf.Vec3f(*place.tolist()))


def _unit(kind: str) -> float:
    """Return the unit of a coordinate in USD: a degree [rad] or a metre [m]."""
    return math.pi / 180 if kind == "hinge" else 1.0


def _principal(inertia: Array) -> tuple[list[float], Array]:
    """Return moments in single precision that a body can have, and their axes in columns."""
    values, axes = np.linalg.eigh(inertia)
    low, mid, high = values.astype(np.float32)
    if float(low) + float(mid) < float(high):  # possible for flat bodies after rounding
        high = np.nextafter(low + mid, np.float32(0.0))
    return [float(low), float(mid), float(high)], axes * np.linalg.det(axes)


def _sum(laws: list[Servo]) -> Servo | None:
    """Return one servo for several without limits, at their first targets."""
    if not laws:
        return None
    stiffness, damping = (sum(getattr(each, key) for each in laws) for key in _GAINS)
    pull = sum(each.stiffness * each.position[0] for each in laws)
    drag = sum(each.damping * each.velocity[0] for each in laws)
    place, rate = pull / (stiffness or 1.0), drag / (damping or 1.0)
    return Servo(laws[0].joint, (place,), (rate,), stiffness, damping)
