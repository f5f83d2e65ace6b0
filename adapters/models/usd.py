"""Reader of USD Physics: composition, masses and joints as the library of OpenUSD parses them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mbds_xsim.base import bounds, rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.frame import optional
from mbds_xsim.scene.imported import Fate, Imported

from .assembling import assemble
from .graph import Tie, tree_of
from .parts import Drive, Freedom, Line, Mass, Part, Parts, Solids
from .usd_fates import fates_of
from .usd_masses import mass_of
from .usd_shapes import Shapes

_UNLIMITED = 3e38  # limit of a drive; single precision has no larger number
_LARGEST_FILE = 64 * 10**6  # bytes
_GAP = 1e-5  # largest gap of a joint's frames over the extent: positions are in single precision
_LABELS = {"limits": ("Physics…Joint", "physics:lowerLimit"), "drive": ("drive", "")}
_KINDS = {"RevoluteJoint": "hinge", "PrismaticJoint": "slider", "SphericalJoint": "ball",
          "FixedJoint": "fixed", "D6Joint": "several"}  # fmt: skip


def read(path: Path, folder: Path, floating: bool, ground: bool) -> Imported:
    """Read a USD file; see `mbds_xsim.simulate.registry`."""
    sdf, tf, usd = (optional(f"pxr.{name}", "reading USD", "usd") for name in ("Sdf", "Tf", "Usd"))
    if floating:
        raise InputError("--floating is for URDF; USD says itself which of its bodies are free")
    try:
        _check_layers(sdf, path, folder.resolve())
        stage = usd.Stage.Open(str(path))
        reading = _Reading(stage)
        parts = reading.model(path.stem, ground=ground)
    except tf.ErrorException as error:
        raise InputError(f"OpenUSD does not read it: {_reason(str(error))}") from error
    limited = "limits" in parts.stated
    fates = [*fates_of(stage, limited=limited, touching=ground), *reading.fates]
    version = ".".join(map(str, usd.GetVersion()))
    return assemble(parts, file=path.name, kind="USD", reader=f"OpenUSD {version}", fates=fates)


def _reason(text: str) -> str:
    """Return the last line of a library message, without the location in its source."""
    lines = [line.partition(" : ")[2] or line for line in text.splitlines()]
    return next(filter(None, (line.strip("' \t") for line in reversed(lines))), text)


def _check_layers(sdf: Any, path: Path, folder: Path) -> None:
    """Raise InputError if a file referred to is missing, too large, or outside the folder."""
    stack, visited = [path], set()
    while stack:
        file = stack.pop().resolve()
        if file in visited:
            continue
        visited.add(file)
        if not file.is_relative_to(folder):
            raise InputError(
                f"refers to {str(file)!r}, which is not in {folder}; if that is intended, "
                "give `mbds-xsim import` a --folder with all files of the model"
            )
        if not file.is_file():
            raise InputError(f"refers to {file.name!r}, which is not there")
        if file.stat().st_size > _LARGEST_FILE:
            raise InputError(f"{file.name} is larger than {_LARGEST_FILE // 10**6} MB")
        layer = sdf.Layer.FindOrOpen(str(file))
        for name in filter(None, layer.GetCompositionAssetDependencies()):
            asset = Path(layer.ComputeAbsolutePath(name))
            stack.append(asset if asset.exists() else file.parent / name)


class _Reading:
    """A stage, read in SI units with z up."""

    def __init__(self, stage: Any) -> None:
        from pxr import UsdGeom, UsdPhysics

        self._stage, self._physics = stage, UsdPhysics
        self._metre = UsdGeom.GetStageMetersPerUnit(stage)
        self._kilogram = UsdPhysics.GetStageKilogramsPerUnit(stage)
        bounds.positive("metersPerUnit", self._metre)
        bounds.positive("kilogramsPerUnit", self._kilogram)
        upright = UsdGeom.GetStageUpAxis(stage) == "Z"
        turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # y up to z up
        self._up = np.eye(3) if upright else turn
        self._places = UsdGeom.XformCache()
        self._objects = UsdPhysics.UsdPhysicsLoadStageFromPrimRange(stage, ["/"])
        self._count = Counter(prim.GetName() for prim in stage.Traverse())
        self.fates: list[Fate] = []
        self._drives: list[Drive] = []

    def model(self, name: str, *, ground: bool) -> Parts:
        bodies = [desc for desc in self._all("RigidBody") if desc.rigidBodyEnabled]
        moving = [desc for desc in bodies if not desc.kinematicBody]
        index = {desc.primPath: k for k, desc in enumerate(moving)}
        nodes = [self._part(desc) for desc in moving]
        places = np.array([node.position for node in nodes] or [np.zeros(3)])
        extent = float(np.linalg.norm(np.ptp(places, axis=0))) or 1.0
        joints = [(key, desc) for key in _KINDS for desc in self._all(key) if desc.jointEnabled]
        joints.sort(key=lambda joint: joint[1].excludeFromArticulation)  # loop closures last
        candidates = (self._tie(desc, key, index, extent) for key, desc in joints)
        ties = [tie for tie in candidates if tie is not None]
        parts, closings = tree_of(nodes, ties)
        part_index = {part.name: k for k, part in enumerate(parts)}
        lines = tuple(self._lines(index, [part_index[node.name] for node in nodes]))
        drives = tuple(self._tree_drives({f.name for part in parts for f in part.freedoms}))
        solids = None
        if ground:
            shapes = Shapes(self._stage, self._all, self._frame, self._name, self._metre)
            part = {path: part_index[nodes[k].name] for path, k in index.items()}
            solids = Solids("Collision", tuple(shapes.solids(part)), shapes.pair)
        return Parts(name, parts, self._gravity(), closings, (), lines, _LABELS, drives, solids)

    def _tree_drives(self, freedoms: set[str]) -> Iterator[Drive]:
        """Yield the drives of tree joints, and drop those of joints that close loops."""
        for drive in self._drives:
            if drive.joint in freedoms:
                yield drive
            else:
                reason = "its joint closes a loop"
                self.fates.append(Fate("drive", (), "dropped", reason, True, (drive.joint,)))

    def _all(self, schema: str) -> list[Any]:
        object_type = getattr(self._physics.ObjectType, schema)
        return list(self._objects.get(object_type, ((), ()))[1])

    def _gravity(self) -> Array:
        for scene in self._all("Scene"):
            return np.asarray(
                self._up @ np.array(scene.gravityDirection) * scene.gravityMagnitude * self._metre
            )
        return np.zeros(3)

    def _part(self, desc: Any) -> Part:
        prim = self._stage.GetPrimAtPath(desc.primPath)
        place, turn = self._frame(desc.primPath)
        local = mass_of(prim, self._all, desc, self._metre, self._kilogram)
        mass = Mass(local.mass, place + turn @ local.com, turn @ local.inertia @ turn.T)
        return Part(self._name(desc.primPath), -1, place, rotation.from_matrix(turn), mass, ())

    def _name(self, path: Any) -> str:
        """Return the last part of a path if it is unique, or else the whole path."""
        unique = self._count[path.name] == 1
        return path.name if unique else str(path).removeprefix("/").replace("/", " ")

    def _frame(self, path: Any) -> tuple[Array, Array]:
        """Return position and axes of a prim in W."""
        if path.isEmpty or str(path) == "/":
            return np.zeros(3), self._up
        matrix = np.array(self._places.GetLocalToWorldTransform(self._stage.GetPrimAtPath(path)))
        axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=1, keepdims=True)
        return self._up @ matrix[3, :3] * self._metre, self._up @ axes.T

    def _side(self, body: Any, place: Any, turn: Any) -> tuple[Array, Array]:
        """Return position and axes of a joint's frame on one side, in W."""
        if body.isEmpty:
            point = np.array(place, dtype=float)
        else:
            prim = self._stage.GetPrimAtPath(body)
            point = np.array(self._places.GetLocalToWorldTransform(prim).Transform(place))
        quaternion = np.array([turn.GetReal(), *turn.GetImaginary()], dtype=float)
        quaternion /= np.linalg.norm(quaternion)
        return self._up @ point * self._metre, self._frame(body)[1] @ rotation.matrix(quaternion)

    def _sides(self, desc: Any) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        first = self._side(desc.body0, desc.localPose0Position, desc.localPose0Orientation)
        second = self._side(desc.body1, desc.localPose1Position, desc.localPose1Orientation)
        return first, second

    def _tie(self, desc: Any, schema: str, index: dict[Any, int], extent: float) -> Tie | None:
        (point, axes), (other, other_axes) = self._sides(desc)
        name, kind = self._name(desc.primPath), _KINDS[schema]
        ends = (index.get(desc.body0, -1), index.get(desc.body1, -1))
        if ends[0] == ends[1]:
            reason = "it joins what does not move"
            self.fates.append(Fate("Joint", (), "dropped", reason, False, (name,)))
            return None
        if kind == "several":
            return Tie(name, ends, tuple(self._freedoms(desc, name, point, axes)), point)
        column = "XYZ".index(desc.axis.name) if kind in ("hinge", "slider") else 0
        axis = axes[:, column]
        gap, start = other - point, 0.0
        if kind == "slider":
            start = float(gap @ axis)
            gap = gap - start * axis
        aligned = {"ball": [], "hinge": [column]}.get(kind, [0, 1, 2])  # axes of both frames
        tilt = float(np.linalg.norm((other_axes - axes)[:, aligned]))
        if kind == "hinge":
            first, second = axes[:, column - 2], other_axes[:, column - 2]
            start = math.atan2(float(np.cross(first, second) @ axis), float(first @ second))
        if (apart := np.linalg.norm(gap)) > _GAP * extent or tilt > _GAP:
            raise InputError(
                f"the frames of the joint {name!r} differ as bodies are placed: got {apart:.3g} "
                f"m between origins and {tilt:.3g} between axes, allowed is 0"
            )
        if kind == "fixed":
            return Tie(name, ends, (), point)
        limits = self._limits(getattr(desc, "limit", None), kind, start)
        if kind != "ball":
            self._lead(desc.drive, name, kind, start)
        freedom = Freedom(name, kind, point, axis if kind != "ball" else np.zeros(3), limits)  # type: ignore[arg-type]
        return Tie(name, ends, (freedom,), point)

    def _freedoms(self, desc: Any, name: str, point: Array, axes: Array) -> Iterator[Freedom]:
        """Yield the degrees of freedom that a general joint does not lock."""
        limits = {pair.first.name: pair.second for pair in desc.jointLimits}
        drives = {pair.first.name: pair.second for pair in desc.jointDrives}
        for kind, letter in (("slider", "Trans"), ("hinge", "Rot")):
            for k, axis in enumerate("XYZ"):
                limit = limits.get(f"{letter}{axis}")
                if limit is not None and limit.enabled and limit.lower > limit.upper:
                    continue
                label = f"{name} {letter.lower()} {axis.lower()}"
                if (drive := drives.pop(f"{letter}{axis}", None)) is not None:
                    self._lead(drive, label, kind, 0.0)
                yield Freedom(label, kind, point, axes[:, k], self._limits(limit, kind, 0.0))  # type: ignore[arg-type]

        for freedom in drives:
            reason = "what it drives is locked, or is not an axis"
            self.fates.append(Fate("drive", (freedom,), "dropped", reason, False, (name,)))

    def _lead(self, drive: Any, joint: str, kind: str, start: float) -> None:
        """Make a servo of an enabled drive, or report why it cannot be one.

        Args:
            drive: Drive as the library of OpenUSD parses it.
            joint: Name of the freedom that it drives.
            kind: Kind of the freedom, hinge or slider.
            start: Coordinate in the file at the reference pose [rad or m].
        """
        if not drive.enabled:
            return
        reason = ""
        if drive.acceleration:
            reason = "its gains are of accelerations, and those of servos are of torques and forces"
        elif drive.stiffness < 0 or drive.damping < 0 or not (drive.stiffness or drive.damping):
            reason = "it has a negative gain, or none"
        if reason:
            self.fates.append(Fate("drive", (), "dropped", reason, True, (joint,)))
            return
        turns = kind == "hinge"
        unit = math.pi / 180 if turns else self._metre
        force = self._kilogram * self._metre * (self._metre if turns else 1.0)
        limit = force * drive.forceLimit if drive.forceLimit < _UNLIMITED else None
        self._drives.append(
            Drive(
                name=joint,
                joint=joint,
                stiffness=drive.stiffness * force / unit,
                damping=drive.damping * force / unit,
                position=drive.targetPosition * unit - start if drive.stiffness else 0.0,
                velocity=drive.targetVelocity * unit,
                limit=limit or None,
                limit_loss="" if limit != 0.0 else "it is 0",
                target="to the target of the file",
            )
        )

    def _limits(self, limit: Any, kind: str, start: float) -> dict[str, tuple[float, float]]:
        if limit is None or not limit.enabled or kind == "ball":
            return {}
        unit = math.pi / 180 if kind == "hinge" else self._metre
        low, high = limit.lower * unit - start, limit.upper * unit - start
        return {"limits": (low, high)} if math.isfinite(low) and math.isfinite(high) else {}

    def _lines(self, index: dict[Any, int], order: list[int]) -> Iterator[Line]:
        for desc in self._all("DistanceJoint"):
            name = self._name(desc.primPath)
            (point, _), (other, _) = self._sides(desc)
            low, high = desc.limit.lower * self._metre, desc.limit.upper * self._metre
            if not (desc.minEnabled and desc.maxEnabled and low == high):
                reason = "distances that may vary are not in the scene description"
                self.fates.append(Fate("DistanceJoint", (), "dropped", reason, True, (name,)))
                continue
            ends = [index.get(body, -1) for body in (desc.body0, desc.body1)]
            first, second = (order[k] if k >= 0 else -1 for k in ends)
            yield Line(name, (first, second), (point, other), low, rigid=True)
