"""Reader of USD Physics: composition, masses and joints as the library of OpenUSD parses them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.frame import optional
from mbds_xsim.scene.imported import Fate, Imported

from .assembling import assemble
from .fates import fates_of_stage
from .graph import Tie, tree_of
from .parts import CLOSES, FAR, Drive, Freedom, Line, Mass, Part, Parts, Solids, bounded
from .source import check_inside
from .usd_bodies import Shapes, Stage, mass_of, matrix_of, written

_UNLIMITED = 3e38  # limit of a drive; single precision has no larger number
_LARGEST_FILE = 64 * 10**6  # bytes
_GAP = 1e-5  # largest gap of a joint's frames over the extent, and of turns [rad]: single precision
_LABELS = {"limits": ("Physics…Joint", "physics:lowerLimit"), "drive": ("drive", "")}
_KINDS = {"RevoluteJoint": "hinge", "PrismaticJoint": "slider", "SphericalJoint": "ball",
          "FixedJoint": "fixed", "D6Joint": "several"}  # fmt: skip
_GRAVITY = 9.81  # [m/s²]
_NO_SCENE = (
    f"there is none: gravity is the schema's default, {_GRAVITY} m/s² down the axis of the stage"
)
_SCENES_DIFFER = "several state gravity, each another: that of the first counts"
_Sides = tuple[tuple[Array, Array], tuple[Array, Array]]


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
    fates = [*fates_of_stage(stage, limited=reading.limited, touching=ground), *reading.fates]
    fates += [
        Fate("stage", (key,), "approximated", f"it states none: {meaning}, the default", True)
        for key, meaning in (("metersPerUnit", "a unit is 1 cm"), ("upAxis", "y is up"))
        if not stage.HasAuthoredMetadata(key)
    ]
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
        check_inside(file, folder, f"refers to {str(file)!r}")
        if not file.is_file():
            raise InputError(f"refers to {file.name!r}, which is not there")
        if file.stat().st_size > _LARGEST_FILE:
            raise InputError(f"{file.name} is larger than {_LARGEST_FILE // 10**6} MB")
        layer = sdf.Layer.FindOrOpen(str(file))
        for name in filter(None, layer.GetCompositionAssetDependencies()):
            asset = Path(layer.ComputeAbsolutePath(name))
            stack.append(asset if asset.exists() else file.parent / name)


class _Reading(Stage):
    """The model of a stage."""

    def __init__(self, stage: Any) -> None:
        super().__init__(stage)
        self.fates: list[Fate] = []
        self.limited = False
        """Whether a joint has limits, which are then reported joint by joint."""
        self._drives: list[Drive] = []

    def model(self, name: str, *, ground: bool) -> Parts:
        bodies = [desc for desc in self.all("RigidBody") if desc.rigidBodyEnabled]
        moving = [desc for desc in bodies if not desc.kinematicBody]
        index = {desc.primPath: k for k, desc in enumerate(moving)}
        nodes = [self._part(desc) for desc in moving]
        places = np.array([node.position for node in nodes] or [np.zeros(3)])
        extent = float(np.linalg.norm(np.ptp(places, axis=0))) or 1.0
        joints = [(key, desc) for key in _KINDS for desc in self.all(key) if desc.jointEnabled]
        joints.sort(key=lambda joint: joint[1].excludeFromArticulation)  # loop closures last
        candidates = (self._tie(desc, key, index, extent) for key, desc in joints)
        ties = [tie for tie in candidates if tie is not None]
        parts, closings = tree_of(nodes, ties)
        kept = {freedom.name for part in parts for freedom in part.freedoms}
        self._report_closing(ties, kept)
        drives = tuple(drive for drive in self._drives if drive.joint in kept)
        part_index = {part.name: k for k, part in enumerate(parts)}
        part_of = {path: part_index[nodes[k].name] for path, k in index.items()}
        lines = tuple(self._lines(part_of))
        solids = None
        if ground:
            shapes = Shapes(self)
            solids = Solids("Collision", tuple(shapes.solids(part_of)), shapes.pair)
        return Parts(name, parts, self._gravity(), closings, (), lines, _LABELS, drives, solids)

    def _report_closing(self, ties: list[Tie], kept: set[str]) -> None:
        """Report limits and drives of joints that close loops; `kept` are freedoms of others."""
        limited = [
            (tie.name, each.name) for tie in ties for each in tie.freedoms if each.properties
        ]
        self.limited = bool(limited)
        element, attribute = _LABELS["limits"]
        for name in (name for name, freedom in limited if freedom not in kept):
            self.fates.append(Fate(element, (attribute,), "dropped", CLOSES, True, (name,)))
        for name in (drive.joint for drive in self._drives if drive.joint not in kept):
            self.fates.append(Fate("drive", (), "dropped", CLOSES, True, (name,)))

    def _gravity(self) -> Array:
        pulls = [
            written(scene.gravityMagnitude) * self.metre * (self.up @ scene.gravityDirection)
            for scene in self.all("Scene")
        ]
        if not pulls:
            self.fates.append(Fate("PhysicsScene", (), "approximated", _NO_SCENE, True))
            return np.array([0.0, 0.0, -_GRAVITY])
        if any((pull != pulls[0]).any() for pull in pulls):
            self.fates.append(Fate("PhysicsScene", (), "approximated", _SCENES_DIFFER, True))
        return np.asarray(pulls[0])

    def _part(self, desc: Any) -> Part:
        place, turn = self.frame(desc.primPath)
        if np.linalg.norm(turn.T @ turn - np.eye(3)) > _GAP or np.linalg.det(turn) < 0:
            raise InputError(
                f"the frame of {desc.primPath} is mirrored or sheared by scales, allowed are "
                "rotations and scales along its axes; scale its shapes and places instead"
            )
        local = mass_of(self, desc)
        mass = Mass(local.mass, place + turn @ local.com, turn @ local.inertia @ turn.T)
        return Part(self.name(desc.primPath), -1, place, rotation.from_matrix(turn), mass, ())

    def _side(self, body: Any, place: Any, turn: Any) -> tuple[Array, Array]:
        """Return position and axes of a joint's frame on one side, in W."""
        origin, axes = self.frame(body)  # the library has scaled the place
        return origin + axes @ np.array(place, dtype=float) * self.metre, axes @ matrix_of(turn)

    def _sides(self, desc: Any) -> _Sides:
        for target in (desc.rel0, desc.rel1):
            prim = self.stage.GetPrimAtPath(target) if not target.isEmpty else None
            if prim is not None and not (prim and prim.IsActive()):
                raise InputError(f"the joint {desc.primPath} holds {target}, which is not there")
        first = self._side(desc.body0, desc.localPose0Position, desc.localPose0Orientation)
        second = self._side(desc.body1, desc.localPose1Position, desc.localPose1Orientation)
        return first, second

    def _tie(self, desc: Any, schema: str, index: dict[Any, int], extent: float) -> Tie | None:
        (point, axes), (other, other_axes) = self._sides(desc)
        name, kind = self.name(desc.primPath), _KINDS[schema]
        ends = (index.get(desc.body0, -1), index.get(desc.body1, -1))
        if ends[0] == ends[1]:
            reason = "it joins what does not move"
            self.fates.append(Fate("Joint", (), "dropped", reason, False, (name,)))
            return None
        if kind == "several":
            return Tie(name, ends, tuple(self._freedoms(desc, name, extent)), point)
        column = "XYZ".index(desc.axis.name) if kind in ("hinge", "slider") else 0
        axis = axes[:, column]
        gap, start = other - point, 0.0
        if kind == "slider":
            start = float(gap @ axis)
            gap = gap - start * axis
        aligned = {"ball": [], "hinge": [column]}.get(kind, [0, 1, 2])  # axes of both frames
        tilt = float(np.linalg.norm((other_axes - axes)[:, aligned]))
        if kind == "hinge":
            start = _standing(_angle(axes, other_axes, column), desc.limit, desc.drive)
        _check_frames(name, gap, tilt, extent)
        freedoms = (Freedom(name, "ball", point, np.zeros(3)),) if kind == "ball" else ()
        if kind in ("hinge", "slider"):
            self._lead(desc.drive, name, kind, start)
            freedoms = (Freedom(name, kind, point, axis, self._limits(desc.limit, kind, start)),)  # type: ignore[arg-type]
        return Tie(name, ends, freedoms, point)

    def _freedoms(self, desc: Any, name: str, extent: float) -> Iterator[Freedom]:
        """Yield the freedoms that a general joint does not lock: those to slide, then to turn."""
        limits = {pair.first.name: pair.second for pair in desc.jointLimits}
        drives = {pair.first.name: pair.second for pair in desc.jointDrives}
        locked = {key for key, each in limits.items() if each.enabled and each.lower > each.upper}
        free = {
            letter: [k for k, axis in enumerate("XYZ") if letter + axis not in locked]
            for letter in ("Trans", "Rot")
        }
        limited = {key for key, limit in limits.items() if self._limits(limit, "hinge", 0.0)}
        counts = any(key.startswith("Rot") for key in limited | drives.keys())
        sides = (point, axes), (other, _) = self._sides(desc)
        starts = _starts(name, sides, free, extent, counts=counts)
        for kind, letter, anchor in (("slider", "Trans", point), ("hinge", "Rot", other)):
            for k in free[letter]:
                axis, start = "XYZ"[k], starts[letter][k]
                label = f"{name} {letter.lower()} {axis.lower()}"
                drive, limit = drives.pop(f"{letter}{axis}", None), limits.get(f"{letter}{axis}")
                if kind == "hinge":
                    start = _standing(start, limit, drive)
                if drive is not None:
                    self._lead(drive, label, kind, start)
                bounds_of = self._limits(limit, kind, start)
                yield Freedom(label, kind, anchor, axes[:, k], bounds_of)  # type: ignore[arg-type]

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
        reason, moves = "", bool(drive.stiffness or drive.damping)
        if not moves:
            reason = "it has no gain, and so exerts nothing"
        elif drive.acceleration:
            reason = "its gains are of accelerations, and those of servos are of torques and forces"
        elif drive.stiffness < 0 or drive.damping < 0:
            reason = "it has a negative gain"
        if reason:
            self.fates.append(Fate("drive", (), "dropped", reason, moves, (joint,)))
            return
        unit = math.pi / 180 if kind == "hinge" else self.metre
        force = self.kilogram * self.metre * (self.metre if kind == "hinge" else 1.0)
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
        if limit is None:
            return {}  # the library disables limits of hinges with one side; they count here
        unit = math.pi / 180 if kind == "hinge" else self.metre
        span = bounded(limit.lower * unit - start, limit.upper * unit - start)
        return {"limits": span} if span else {}

    def _lines(self, part_of: dict[Any, int]) -> Iterator[Line]:
        for desc in self.all("DistanceJoint"):
            name = self.name(desc.primPath)
            (point, _), (other, _) = self._sides(desc)
            low, high = desc.limit.lower * self.metre, desc.limit.upper * self.metre
            if not (desc.minEnabled and desc.maxEnabled and low == high):
                reason = "distances that may vary are not in the scene description"
                self.fates.append(Fate("DistanceJoint", (), "dropped", reason, True, (name,)))
                continue
            ends = part_of.get(desc.body0, -1), part_of.get(desc.body1, -1)
            apart = float(np.linalg.norm(other - point))
            length = apart if abs(apart - low) < _GAP * max(apart, low) else low
            yield Line(name, ends, (point, other), length, rigid=True)


def _angle(axes: Array, other_axes: Array, column: int) -> float:
    """Return the angle of one frame to another about an axis that they share [rad]."""
    first, second = axes[:, column - 2], other_axes[:, column - 2]
    return math.atan2(float(np.cross(first, second) @ axes[:, column]), float(first @ second))


def _standing(angle: float, limit: Any, drive: Any) -> float:
    """Return the angle of a hinge with as many whole turns as put it within its limits, or nearest.

    Half a turn may count either way: it is the one nearer to the target, or else the positive one.

    Args:
        angle: Angle up to whole turns, in [−π, π].
        limit: Limits as the library of OpenUSD parses them [degrees]; None if there are none.
        drive: The drive of the hinge; None if it has none.
    """
    low, high = (-math.inf, math.inf) if limit is None else (limit.lower, limit.upper)
    low, high = math.radians(low), math.radians(high)
    led = drive is not None and drive.enabled and drive.stiffness > 0
    target = math.radians(drive.targetPosition) if led else math.pi
    middle = target if math.pi - abs(angle) < _GAP else 0.0
    turns = (round((side - angle) / math.tau) for side in (0.0, low, high) if abs(side) < FAR)

    def unlikely(each: float) -> tuple[float, float]:
        return max(low - each, each - high, _GAP), abs(each - middle)

    return min((angle + math.tau * (n + k) for n in turns for k in (0, 1, -1)), key=unlikely)


def _starts(
    name: str, sides: _Sides, free: dict[str, list[int]], extent: float, *, counts: bool
) -> dict[str, Array]:
    """Return the coordinates of a general joint as bodies are placed, and check what it locks.

    Args:
        name: Name of the joint.
        sides: Positions and axes of its frames in W.
        free: Axes that it does not lock, keyed by "Trans" and "Rot".
        extent: Extent of the model [m].
        counts: Whether limits or drives measure rotations.
    """
    (point, axes), (other, other_axes) = sides
    slides, turns = (other - point) @ axes, np.zeros(3)
    aligned = [0, 1, 2] if counts or len(free["Rot"]) < len("XYZ") else []
    if len(free["Rot"]) == 1:
        aligned = free["Rot"]
        turns[aligned] = _angle(axes, other_axes, *aligned)
    tilt = float(np.linalg.norm((other_axes - axes)[:, aligned]))
    _check_frames(name, np.delete(slides, free["Trans"]), tilt, extent)
    return {"Trans": slides, "Rot": turns}


def _check_frames(name: str, gap: Array, tilt: float, extent: float) -> None:
    """Raise InputError if the frames of a joint differ where it locks them."""
    if (apart := np.linalg.norm(gap)) > _GAP * extent or tilt > _GAP:
        raise InputError(
            f"the frames of the joint {name!r} differ as bodies are placed: got {apart:.3g} "
            f"m between origins and {tilt:.3g} between axes, allowed is 0"
        )
