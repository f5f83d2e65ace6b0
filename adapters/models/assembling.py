"""Assembly of parts into a scene: fixed parts merge, several joints make a chain of bodies."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import msgspec
import numpy as np

from mbds_xsim.base import bounds, rotation
from mbds_xsim.base.errors import InputError, SceneError, located
from mbds_xsim.scene.coupling import Coupling, check_couplings
from mbds_xsim.scene.imported import FIXED, Fate, Imported, Outcome, gathered
from mbds_xsim.scene.scene import WORLD, Body, DistanceLink, Inertia, Joint, Scene, SpringDamper
from mbds_xsim.scene.servo import Servo

from .contacts import contacts_of, floor_of, on_the_floor
from .masses import SHARE, physical, small
from .parts import FAR, Closing, Drive, Freedom, Line, Mass, ModelCoupling, Part, Parts, Property
from .starts import check_above_ground, drop_limits, starts

_AS_IS = "on the joint, as it is"
_NOTES = {"limits": "stops of the joint, which give nothing of a speed back"}
_SCALAR = "the scene description has it for hinges and sliders alone"
_NOTHING = Mass(0.0, np.zeros(3), np.zeros((3, 3)))
_CLOSINGS: dict[str, tuple[Outcome, str]] = {
    "joint": ("kept", "a joint that closes a loop"),
    "equality": ("approximated", "a rigid joint that closes a loop; the engine's own is soft"),
}
_TIES_NOTHING = "it holds what does not move, or is not there"
_NO_LINE = "its ends are at one point at the reference pose, or its force law is negative"
_ROUNDING = 1e-24  # inertia that rounding of centres of mass leaves, over mass times the reach²
_TOGETHER = 1e-9  # [m]: anchors this close count as one point
_INDEPENDENT = 1e-3  # least volume spanned by three independent unit axes


def assemble(model: Parts, *, file: str, kind: str, reader: str, fates: Iterable[Fate]) -> Imported:
    """Assemble the scene, with the report on everything in the file.

    Args:
        model: The model that a reader has made of the file.
        file: Name of the file.
        kind: Name of the format.
        reader: Name and version of the reader.
        fates: Fates of what the reader has handled itself.
    """
    floor = floor_of(model)
    _check_finite(model)
    model = on_the_floor(model, floor)
    builder = _Builder(model)
    if not builder.tables["bodies"]:
        raise InputError(
            "nothing in it moves: all is fixed in the world or has no mass; "
            "--floating frees a URDF's root link"
        )
    scene = Scene(
        name=model.name,
        description=f"imported from {file}",
        source=f"{file} ({kind}), read by {reader}",
        length=builder.length,
        gravity=model.gravity.tolist(),
        **builder.tables,
    )
    contact_fates: list[Fate] = []
    if model.solids is not None:
        contacts, ground, contact_fates = contacts_of(model.solids, floor, builder.body_of)
        scene = msgspec.structs.replace(scene, contacts=contacts, ground=ground)
    scene = msgspec.structs.replace(scene, sampling=starts(scene, builder.limits))
    scene, limit_fates = drop_limits(scene, model.labels["limits"])
    check_above_ground(scene)
    report = gathered([*fates, *builder.fates, *contact_fates, *limit_fates])
    return Imported(scene, file, kind, reader, report, model.facts(reader))


def _check_finite(model: Parts) -> None:
    """Raise SceneError if a mass or position is not finite, or too large to compute with."""
    for part in model.parts:
        values: dict[str, Any] = {"position": part.position, "orientation": part.orientation}
        values |= {"mass": part.mass.mass, "centre of mass": part.mass.com}
        values |= {"inertia": part.mass.inertia}
        values |= {f"joint {each.name!r}": (each.anchor, each.axis) for each in part.freedoms}
        for key, value in values.items():
            bounds.finite(f"{key} of {part.name!r}", tuple(np.ravel(value).tolist()))


class _Builder:
    """Tables of the scene, with the fates of the parts."""

    def __init__(self, model: Parts) -> None:
        self._model, self._parts = model, model.parts
        self.tables: dict[str, Any] = defaultdict(list)
        """Bodies, joints and elements, keyed by the scene's name for each kind."""
        self.fates: list[Fate] = []
        self.limits: dict[str, tuple[float, float]] = {}
        """Limits of hinges and sliders, keyed by joint name."""
        self._names: set[str] = {WORLD}
        self._taken: set[str] = set()
        """Names of joints."""
        self._joint_names: dict[str, str] = {}
        """Joint names in the scene, keyed by those in the model."""
        self._owner = model.owners
        self._report_fixed()
        self._own = [_NOTHING] * len(self._parts)
        for part, owner in zip(self._parts, self._owner, strict=False):
            if owner >= 0:
                bounds.at_least_zero(f"mass of {part.name!r}", part.mass.mass)
                self._own[owner] += part.mass
        self._carried = list(self._own)
        movers = [k for k in range(len(self._parts)) if self._owner[k] == k]
        for k in reversed(movers):
            if (above := self._owner[self._parts[k].parent]) >= 0:
                self._carried[above] += self._carried[k]
        self.length = _reach(self._parts, self._own)
        self._body_names = {-1: WORLD}
        for k in movers:
            self._add(k)
        for closing in model.closings:
            self._close(closing)
        for line in model.lines:
            self._draw(line)
        for drive in model.drives:
            self._drive(drive)
        for coupling in model.couplings:
            self._couple(coupling)

    def body_of(self, part: int) -> str | None:
        """Return the name of the body that a part belongs to; None if that body was dropped."""
        return self._body_names.get(self._owner[part])

    def _report_fixed(self) -> None:
        for part, owner in zip(self._parts, self._owner, strict=False):
            if part.freedoms:
                continue
            if owner >= 0:
                reason = "one with the body that it is fixed to: masses and inertias are added"
                place = f"{part.name} in {self._parts[owner].name}"
                self._report("kept", "body", reason, place)
            else:
                reason = FIXED if part.mass.mass else "fixed in the world"
                self._report("kept", "body", reason, part.name, moves=False)

    def _report(
        self, outcome: Outcome, element: str, reason: str, place: str, *, moves: bool = True
    ) -> None:
        self.fates.append(Fate(element, (), outcome, reason, moves, (place,)))

    def _report_label(self, key: str, reason: str, note: str, place: str) -> None:
        """Report a property as kept, with a note, unless there is a reason not to."""
        element, attribute = self._model.labels[key]
        outcome: Outcome = "dropped" if reason else "kept"
        self.fates.append(Fate(element, (attribute,), outcome, reason or note, True, (place,)))

    def _add(self, k: int) -> None:
        part = self._parts[k]
        carried = self._carried[k]
        above = self.body_of(part.parent)
        if not (carried.mass > 0 or np.trace(carried.inertia) > 0) or above is None:
            joints = [f"joint {freedom.name!r}" for freedom in part.freedoms]
            reason = "it has no mass (in URDF: no <inertial>) and carries none: left out"
            place = part.name + (f", with its {' and '.join(joints)}" if joints else "")
            self._report("dropped", "body", reason, place)
            return
        mass = self._sound(part, self._own[k], carried)
        *between, last = self._merge_joints(part)
        name = _unique(part.name, self._names)
        for freedom in between:
            middle = _unique(f"{part.name} after {freedom.name}", self._names)
            link = _body(middle, part, small(carried, freedom.anchor, self.length))
            self.tables["bodies"].append(link)
            self._join(freedom, above, middle)
            above = middle
        if between:
            reason = (
                "several joints of one body: between two of them stands a body of "
                f"{SHARE:g} of the mass and inertia that they carry"
            )
            self._report("approximated", "joint", reason, part.name)
        self.tables["bodies"].append(_body(name, part, mass))
        self._join(last, above, name)
        self._body_names[k] = name

    def _sound(self, part: Part, own: Mass, carried: Mass) -> Mass:
        """Return a physically possible mass and inertia, and report every change."""
        if own.mass <= 0 and np.trace(own.inertia) <= 0:
            reason = f"no mass: it gets {SHARE:g} of the mass and inertia that it carries"
            self._report("approximated", "inertial", reason, part.name)
            return small(carried, part.position, self.length)
        if own.mass <= 0:
            reason = f"inertia without mass: it gets {SHARE:g} of the mass that it carries"
            self._report("approximated", "inertial", reason, part.name)
            own = dataclasses.replace(own, mass=SHARE * (carried.mass or 1.0))
        rounding = _ROUNDING * own.mass * self.length**2
        if np.trace(own.inertia) <= rounding:
            lack = "without" if np.trace(own.inertia) >= -rounding else "with negative"
            reason = f"mass {lack} inertia: it gets {SHARE:g} of its mass times the model's reach²"
            self._report("approximated", "inertial", reason, part.name)
            moment = SHARE * own.mass * self.length**2
            own = dataclasses.replace(own, inertia=moment * np.eye(3))
        nearest = physical(own.inertia)
        if nearest is None:
            return own
        change = np.linalg.norm(nearest - own.inertia) / np.linalg.norm(own.inertia)
        reason = "no body has such moments (A + B < C): the nearest that one can have"
        self._report("approximated", "inertial", reason, f"{part.name}: by {change:.2g} of it")
        return dataclasses.replace(own, inertia=nearest)

    def _merge_joints(self, part: Part) -> tuple[Freedom, ...]:
        """Merge three hinges at a point into a ball, three sliders and a ball into a free body."""
        freedoms = part.freedoms
        model = self._model
        driven = {drive.joint for drive in model.drives}
        driven |= {name for tie in model.couplings for name in (tie.joint, tie.follows)}
        if any(freedom.properties or freedom.name in driven for freedom in freedoms):
            return freedoms
        kinds = [freedom.kind for freedom in freedoms]
        last = freedoms[-3:]
        if kinds[-3:] == ["hinge"] * 3 and _span(last) and _in_a_point(last):
            ball = Freedom(last[-1].name, "ball", last[-1].anchor, np.zeros(3))
            freedoms, kinds = (*freedoms[:-3], ball), [*kinds[:-3], "ball"]
            self._report("kept", "joint", "three hinges in a point are a ball joint", part.name)
        if kinds == ["slider"] * 3 + ["ball"] and _span(freedoms[:3]):
            self._report(
                "kept", "joint", "three sliders and a ball joint are a free body", part.name
            )
            return (Freedom(freedoms[-1].name, "free", freedoms[-1].anchor, np.zeros(3)),)
        return freedoms

    def _join(self, freedom: Freedom, parent: str, child: str) -> None:
        properties: dict[str, Any] = {}
        for key, value in freedom.properties.items():
            reason = _wrong(key, value, freedom)
            if not reason:
                properties[key] = value
            place = f"{freedom.name}: {_format(value)}"
            self._report_label(key, reason, _NOTES.get(key, _AS_IS), place)
        if freedom.kind == "free":
            return
        name = self._joint_names[freedom.name] = _unique(freedom.name, self._taken)
        axis = freedom.axis.tolist() if freedom.kind in ("hinge", "slider") else None
        if "limits" in properties:
            self.limits[name] = properties["limits"]
        with located(f"joint {name!r}"):
            anchor = freedom.anchor.tolist()
            joint = Joint(name, freedom.kind, parent, child, anchor, axis, **properties)
        self.tables["joints"].append(joint)

    def _close(self, closing: Closing) -> None:
        ends = self._ends(closing.parts)
        if ends is None:
            self._report("dropped", closing.element, _TIES_NOTHING, closing.name, moves=False)
            return
        name = _unique(closing.name, self._taken)
        axis = None if closing.axis is None else closing.axis.tolist()
        with located(f"joint {name!r}"):
            joint = Joint(name, closing.kind, *ends, anchor=closing.anchor.tolist(), axis=axis)
        self.tables["joints"].append(joint)
        outcome, reason = _CLOSINGS[closing.element]
        self._report(outcome, closing.element, reason, closing.name)

    def _draw(self, line: Line) -> None:
        ends = self._ends(line.parts)
        if ends is None:
            self._report("dropped", "tendon", _TIES_NOTHING, line.name, moves=False)
            return
        points = (line.points[0].tolist(), line.points[1].tolist())
        if math.dist(*points) < _TOGETHER or min(line.stiffness, line.damping) < 0:
            self._report("dropped", "tendon", _NO_LINE, line.name)
            return
        name, k, c, length = line.name, line.stiffness, line.damping, line.length
        with located(f"tendon {name!r}"):
            if line.rigid:
                self.tables["distance_links"].append(DistanceLink(name, ends, points, length))
                reason = "a rigid distance link, where the engine's own is soft"
                self._report("approximated", "tendon", reason, name)
            else:
                self.tables["springs"].append(SpringDamper(name, ends, points, k, c, length))
                self._report("kept", "tendon", "a spring and damper between two points", name)

    def _drive(self, drive: Drive) -> None:
        joint = self._joint_names.get(drive.joint)
        element, _ = self._model.labels.get("drive", ("actuator", ""))
        if joint is None:
            self._report("dropped", element, _TIES_NOTHING, drive.name, moves=False)
            return
        k, c, place, speed = drive.stiffness, drive.damping, (drive.position,), (drive.velocity,)
        with located(f"{element} {drive.name!r}"):
            self.tables["servos"].append(Servo(joint, place, speed, k, c, limit=drive.limit))
        loss = f", without the limit of its torque: {drive.limit_loss}" if drive.limit_loss else ""
        outcome: Outcome = "approximated" if loss else "kept"
        self._report(outcome, element, f"a servo {drive.target}{loss}", drive.name)

    def _couple(self, coupling: ModelCoupling) -> None:
        place = f"{coupling.joint} follows {coupling.follows}"
        follower, leader = map(self._joint_names.get, (coupling.joint, coupling.follows))
        offset, ratio, *higher = coupling.polynomial
        reason = ""
        if follower is None or leader is None:
            reason = _TIES_NOTHING
        elif any(higher) or not ratio:
            reason = "not in proportion to the other's coordinate"
        else:
            with located(f"{self._model.labels['coupling'][0]} of {place!r}"):
                couplings = [*self.tables["couplings"], Coupling(follower, leader, ratio, offset)]
            try:
                check_couplings(tuple(couplings))
                self.tables["couplings"] = couplings
            except SceneError:
                reason = "it follows another joint, or itself, by others that are kept"
        self._report_label("coupling", reason, "a rigid coupling", place)

    def _ends(self, parts: tuple[int, int]) -> tuple[str, str] | None:
        """Return the names of two parts' bodies; None if they are the same or one was dropped."""
        first, second = map(self.body_of, parts)
        return None if first is None or second is None or first == second else (first, second)


def _body(name: str, part: Part, mass: Mass) -> Body:
    turn = part.orientation / np.linalg.norm(part.orientation)
    to_body = rotation.matrix(turn).T
    tensor = to_body @ mass.inertia @ to_body.T
    products = (tensor[0, 1], tensor[0, 2], tensor[1, 2])
    com = (to_body @ (mass.com - part.position)).tolist()
    with located(f"body {name!r}"):
        inertia = Inertia(mass.mass, np.diag(tensor).tolist(), products, com)
        place = part.position.tolist()
        return Body(name, inertia=inertia, position=place, orientation=turn.tolist())


def _reach(parts: tuple[Part, ...], masses: list[Mass]) -> float:
    """Return the extent of all centres of mass and joints, or of the largest body if larger [m]."""
    points = [mass.com for mass in masses if mass.mass > 0]
    points += [freedom.anchor for part in parts for freedom in part.freedoms]
    sizes = [math.sqrt(max(np.trace(m.inertia), 0.0) / m.mass) for m in masses if m.mass > 0]
    extent = float(np.linalg.norm(np.ptp(points, axis=0))) if points else 0.0
    return max([extent, *sizes]) or 1.0


def _span(freedoms: tuple[Freedom, ...]) -> bool:
    return bool(abs(np.linalg.det([freedom.axis for freedom in freedoms])) > _INDEPENDENT)


def _in_a_point(freedoms: tuple[Freedom, ...]) -> bool:
    return bool(np.ptp([freedom.anchor for freedom in freedoms], axis=0).max() < _TOGETHER)


def _unique(wanted: str, taken: set[str]) -> str:
    """Return a name that is not taken, and take it."""
    name, numbered = wanted, (f"{wanted} {k}" for k in itertools.count(2))
    while not name or name in taken:
        name = next(numbered)
    taken.add(name)
    return name


def _wrong(key: str, value: Property, freedom: Freedom) -> str:
    """Return why a property's value cannot be kept, or "" if it can."""
    if freedom.kind not in ("hinge", "slider"):
        return _SCALAR
    if isinstance(value, float):
        return "it is negative" if key in ("stiffness", "damping") and value < 0 else ""
    if not value[0] < value[1]:
        return "the lower one is not below the upper one"
    if max(map(abs, value)) > FAR:
        return "no joint gets so far"
    far = freedom.kind == "hinge" and (value[1] <= -math.pi or value[0] >= math.pi)
    return "they are all more than half a turn from the reference pose" if far else ""


def _format(value: float | tuple[float, float]) -> str:
    return f"{value:g}" if isinstance(value, float) else f"{value[0]:g} to {value[1]:g}"
