"""Reader of MJCF and URDF, as MuJoCo's compiler resolves them.

The compiler resolves defaults, includes, frames, units of limits and the inertia of geometry.
Masses in a URDF are taken as written, before MuJoCo refuses or repairs them: a link has the stated
inertia, or none if none is stated, and meshes are not read.
"""

from __future__ import annotations

import contextlib
import copy
import math
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, tostring

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.frame import optional
from mbds_xsim.scene.imported import Fate, Imported, ModelFacts

from .assembling import assemble
from .contacts import NO_SPHERES
from .drives import drives, mechanics_of_drives, on_joints
from .facts import facts_of
from .fates import COLLISION, NO_FOLLOWER, fates_of
from .geoms import PAIRING, Geoms, touching
from .mending import mend_mjcf, mend_urdf, remove_unknown
from .parts import Drive, Freedom, Mass, Part, Parts, Property
from .source import read_source
from .ties import HIGHER, Ties, element_name, higher

_LABELS = {
    "mujoco": {
        "stiffness": ("joint", "stiffness"),
        "rest": ("joint", "springref"),
        "damping": ("joint", "damping"),
        "armature": ("joint", "armature"),
        "friction": ("joint", "frictionloss"),
        "limits": ("joint", "range"),
        "coupling": ("equality", "joint"),
    },
    "robot": {
        "damping": ("dynamics", "damping"),
        "friction": ("dynamics", "friction"),
        "limits": ("limit", "lower"),
        "coupling": ("mimic", "multiplier"),
    },
}
"""Element and attribute that state each property, by root element of the format."""
_MECHANICAL = {
    "link", "inertial", "mass", "inertia", "origin", "joint", "parent", "child", "axis", "limit",
    "dynamics", "mimic",
}  # fmt: skip
"""URDF elements that describe the mechanism."""
_SOLID = {"collision", "geometry", "sphere", "capsule", "cylinder", "box"}
"""URDF elements that describe collision shapes."""
_WITH_AXIS = ("revolute", "continuous", "prismatic", "planar")
"""Types of URDF joints that have an axis."""
_TOUCHING = {
    "geom": [(tag, key) for tag, keys in PAIRING.items() for key in keys],
    "collision": [("collision", ""), ("collision", "name")],
}
"""Elements and attributes reported for each shape on the ground, by the format's word for it."""
_NAMING_NOTHING = ("Element name ''", "Element name '', id 0")
"""Lines of the compiler's messages that say nothing."""
_ALIASES = {
    ("joint", "limited"): "limits",
    ("joint", "springdamper"): "damping",
    ("joint", "springyield"): "springyield",
    ("limit", "upper"): "limits",
}


def read(path: Path, folder: Path, floating: bool, ground: bool) -> Imported:
    """Read an MJCF or URDF file; see `mbds_xsim.simulate.registry`."""
    mujoco = optional("mujoco", "reading MJCF and URDF", "mujoco")
    root = read_source(path, folder)
    if root.tag not in _LABELS:
        raise InputError(f"its outermost element is <{root.tag}>, allowed are <mujoco> and <robot>")
    masses: dict[str, Any] | None = None
    limits: dict[str, tuple[float, float]] = {}
    with _refusals(mujoco):
        if root.tag == "mujoco":
            model, mends = _compile(mujoco, root, path)
        else:
            mends = [*mend_urdf(root), *(_without_meshes(root) if ground else ())]
            spec = _mechanics(mujoco, root, path, _MECHANICAL | (_SOLID if ground else set()))
            masses, limits = _replace_masses(spec, floating), _stated_limits(root)
            model = spec.compile()
    if root.tag == "mujoco" and floating:
        msg = "--floating is for URDF; an MJCF file says itself which of its bodies are free"
        raise InputError(msg)
    shape = "" if not ground else "geom" if root.tag == "mujoco" else "collision"
    reading = Reading(mujoco, model, masses, shape, limits)
    name = (root.get("model") or root.get("name") or "").strip() or path.stem
    parts = reading.model(name, _LABELS[root.tag])
    reported = {label: key in parts.stated for key, label in _LABELS[root.tag].items()}
    reported |= {label: key in parts.stated for label, key in _ALIASES.items()}
    reported |= dict.fromkeys(_TOUCHING.get(shape, ()), True)
    own = [*reading.fates(), *_lost_mimics(root, parts)]
    of_joints = [fate.properties for fate in own if fate.element == "joint"]
    reported |= {("joint", key): True for keys in of_joints for key in keys}
    fates = [*mends, *fates_of(root, reported), *own]
    kind = "MJCF" if root.tag == "mujoco" else "URDF"
    reader = f"MuJoCo {mujoco.__version__}"
    return assemble(parts, file=path.name, kind=kind, reader=reader, fates=fates)


def load(path: Path, floating: bool) -> ModelFacts:
    """Return what MuJoCo itself reads from a file; see `mbds_xsim.studies.readers`."""
    import mujoco

    if path.suffix.lower() not in (".xml", ".urdf"):
        raise InputError("MuJoCo reads MJCF and URDF alone")
    with _refusals(mujoco):
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compiler.fusestatic = False
        if floating:
            spec.worldbody.first_body().add_freejoint()
        reading = Reading(mujoco, spec.compile())
    return facts_of(reading.model("", {}), f"MuJoCo {mujoco.__version__}")


@contextlib.contextmanager
def _refusals(mujoco: Any) -> Iterator[None]:
    """Raise the compiler's errors as InputError, in one line, and ignore its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        except (ValueError, mujoco.FatalError) as error:
            lines = [line.strip() for line in str(error).splitlines() if line.strip()]
            kept = [line for line in lines if line not in _NAMING_NOTHING]
            text = "; ".join(kept).replace("XML Error: ", "").replace("Error: ", "")
            raise InputError(text) from error


def _compile(mujoco: Any, root: Element, path: Path) -> tuple[Any, list[Fate]]:
    """Return the model of an MJCF file, and the repairs made if the compiler refused it."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compiler.fusestatic = False  # keeps the links' names; the motion stays the same
        return spec.compile(), []
    except ValueError as error:
        mends: list[Fate] = []
        latest = [*mend_mjcf(root), *remove_unknown(root, str(error))]
        while latest:
            mends += latest
            try:
                spec = mujoco.MjSpec.from_string(tostring(root, encoding="unicode"))
                spec.modelfiledir = str(path.parent)
                spec.compiler.fusestatic = False
                return spec.compile(), mends
            except ValueError as again:
                latest = [*remove_unknown(root, str(again))]
        raise error


def _without_meshes(root: Element) -> Iterator[Fate]:
    """Remove a URDF's collision meshes, for which there are no contact spheres, and report them."""
    for link in root.iter("link"):
        for shape in link.findall("collision"):
            if shape.find("geometry/mesh") is not None:
                link.remove(shape)
                place = f"of {link.get('name', '')}"
                yield Fate("collision", (), "dropped", f"{NO_SPHERES} mesh", True, (place,))


def _mechanics(mujoco: Any, root: Element, path: Path, tags: set[str]) -> Any:
    """Return the spec of a URDF reduced to elements with the given tags."""
    for joint in root.findall("joint"):
        _check_axis(joint)
    reduced = copy.deepcopy(root)
    for parent in list(reduced.iter()):
        for child in [child for child in parent if child.tag not in tags]:
            parent.remove(child)
    try:
        return mujoco.MjSpec.from_string(tostring(reduced, encoding="unicode"))
    except ValueError:
        mujoco.MjSpec.from_file(str(path))  # raises with the line in the file itself
        raise


def _check_axis(joint: Element) -> None:
    """Raise InputError if a joint of a URDF has an axis that is no direction, or MuJoCo ignores."""
    kind, axis = joint.get("type", ""), joint.find("axis")
    text = "1 0 0" if axis is None else axis.get("xyz", "")
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    is_direction = all(map(math.isfinite, values)) and any(values)
    if len(values) != 3 or not (is_direction or kind not in _WITH_AXIS):
        msg = f"joint {joint.get('name')!r} has the axis {text!r}, "
        raise InputError(f"{msg}allowed are three finite numbers that are not all 0")
    if kind == "planar" and values != [0, 0, 1]:
        raise InputError(
            f"joint {joint.get('name')!r} is planar with the normal {text}, but MuJoCo "
            "assumes 0 0 1; turn its origin so that this is the normal"
        )


def _stated_limits(root: Element) -> dict[str, tuple[float, float]]:
    """Return the limits in a URDF, by joint: one of the two that is not stated is 0."""
    limits = {}
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        if limit is None or joint.get("type") not in ("revolute", "prismatic"):
            continue
        if "lower" in limit.attrib or "upper" in limit.attrib:
            low, high = (float(limit.get(key, "").strip() or "0") for key in ("lower", "upper"))
            limits[joint.get("name", "")] = (low, high)
    return limits


def _lost_mimics(root: Element, parts: Parts) -> Iterator[Fate]:
    """Report joints of a URDF that the compiler does not let follow another."""
    followers = {coupling.joint for coupling in parts.couplings}
    names = [
        each.get("name", "") for each in root.findall("joint") if each.find("mimic") is not None
    ]
    if lost := tuple(name for name in names if name not in followers):
        yield Fate("mimic", (), "dropped", NO_FOLLOWER, True, lost, len(lost))


def _replace_masses(spec: Any, floating: bool) -> dict[str, Any]:
    """Replace all masses in a spec by a unit mass and inertia; free its bases if `floating`.

    Returns:
        Stated mass, position and orientation of its axes in the link's frame, and inertia along
        these axes, keyed by link; links that state none are absent.
    """
    spec.compiler.fusestatic = False
    masses = {}
    for body in spec.bodies[1:]:
        full = np.array(body.fullinertia)
        xx, yy, zz, xy, xz, yz = full
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if np.isnan(full[0]):
            tensor = np.diag(body.inertia)
        if body.explicitinertial:
            masses[body.name] = (body.mass, np.array(body.ipos), np.array(body.iquat), tensor)
        body.mass, body.inertia, body.ipos, body.iquat = 1.0, np.ones(3), np.zeros(3), [1, 0, 0, 0]
        body.fullinertia = [math.nan] + 5 * [0.0]
        body.explicitinertial = True
    bases = [each for each in spec.bodies[1:] if each.parent.name == "world" and not each.joints]
    if floating and not bases:
        msg = "--floating frees the root link, but joints move all links on the link 'world'"
        raise InputError(f"{msg}; leave it out")
    for body in bases if floating else ():
        body.add_freejoint()
    return masses


class Reading:
    """A compiled model at its reference pose.

    Args:
        mujoco: The module.
        model: The compiled model.
        stated: Masses that replace the compiled ones, keyed by body; None if none are replaced.
        shape: The format's word for a shape; "" if there is no ground.
        limits: Limits of joints that the compiler may ignore, keyed by joint.
    """

    def __init__(
        self,
        mujoco: Any,
        model: Any,
        stated: dict[str, Any] | None = None,
        shape: str = "",
        limits: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        self._mujoco, self._model, self._stated_masses = mujoco, model, stated
        self._stated_limits = limits or {}
        self._data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self._data)
        flags = mujoco.mjtDisableBit
        names = ("GRAVITY", "SPRING", "DAMPER", "LIMIT", "FRICTIONLOSS", "EQUALITY", "CONTACT")
        self._off = {
            name: bool(model.opt.disableflags & getattr(flags, f"mjDSBL_{name}")) for name in names
        }
        if model.opt.disableflags & flags.mjDSBL_CONSTRAINT:
            self._off |= dict.fromkeys(("LIMIT", "FRICTIONLOSS", "EQUALITY", "CONTACT"), True)
        contact = not self._off["CONTACT"]
        self._geoms = Geoms(model, self._data, shape, active=contact) if shape else None
        self._ties = Ties(mujoco, model, self._data, self._off)
        self._drives = tuple(drives(mujoco, model))
        self._armature, self._damping = (
            on_joints(mujoco, model, key) for key in ("armature", "damping")
        )
        """Armature and damping that actuators add to each joint."""

    def model(self, name: str, labels: Mapping[str, tuple[str, str]]) -> Parts:
        """Return the model's parts."""
        return Parts(
            name=name,
            parts=tuple(self._parts()),
            gravity=np.zeros(3) if self._off["GRAVITY"] else np.array(self._model.opt.gravity),
            closings=tuple(self._ties.closings()),
            couplings=tuple(self._ties.couplings()),
            lines=tuple(self._ties.lines()),
            drives=tuple(drive for drive in self._drives if isinstance(drive, Drive)),
            solids=self._geoms.solids() if self._geoms is not None else None,
            labels=labels,
        )

    def _parts(self) -> Iterator[Part]:
        model, data = self._model, self._data
        for k in range(1, model.nbody):
            first = model.body_jntadr[k]
            yield Part(
                name=self._name("BODY", k),
                parent=int(model.body_parentid[k]) - 1,
                position=data.xpos[k].copy(),
                orientation=data.xquat[k].copy(),
                mass=self._mass(k),
                freedoms=tuple(self._freedom(first + j) for j in range(model.body_jntnum[k])),
                named=bool(model.body(k).name),
            )

    def _mass(self, k: int) -> Mass:
        model, data = self._model, self._data
        place, quat = data.xpos[k], data.xquat[k]
        mass, com, turn, tensor = 0.0, np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros((3, 3))
        if self._stated_masses is None and model.body_mass[k] > 0:
            mass, com, turn = model.body_mass[k], model.body_ipos[k], model.body_iquat[k]
            tensor = np.diag(model.body_inertia[k])
        elif self._stated_masses is not None:
            mass, com, turn, tensor = self._stated_masses.get(
                self._name("BODY", k), (mass, com, turn, tensor)
            )
        axes = rotation.matrix(quat) @ rotation.matrix(turn / np.linalg.norm(turn))
        return Mass(float(mass), place + rotation.rotate(quat, com), axes @ tensor @ axes.T)

    def _freedom(self, j: int) -> Freedom:
        kind = ("free", "ball", "slider", "hinge")[self._model.jnt_type[j]]
        has_axis = kind in ("slider", "hinge")
        body = self._model.jnt_bodyid[j]
        return Freedom(
            name=self._name("JOINT", j),
            kind=kind,  # type: ignore[arg-type]
            anchor=self._data.xanchor[j].copy() if kind != "free" else self._data.xpos[body].copy(),
            axis=self._data.xaxis[j].copy() if has_axis else np.zeros(3),
            properties=self._properties(j, has_axis),
            named=bool(self._model.joint(j).name),
        )

    def _properties(self, j: int, has_axis: bool) -> dict[str, Property]:
        model, off = self._model, self._off
        dof, place = model.jnt_dofadr[j], model.jnt_qposadr[j]
        start = model.qpos0[place] if has_axis else 0.0
        properties: dict[str, Property] = {
            "stiffness": 0.0 if off["SPRING"] else float(model.jnt_stiffness[j]),
            "damping": 0.0 if off["DAMPER"] else float(model.dof_damping[dof] + self._damping[j]),
            "armature": float(model.dof_armature[dof] + self._armature[j]),
            "friction": 0.0 if off["FRICTIONLOSS"] else float(model.dof_frictionloss[dof]),
        }
        if properties["stiffness"] and has_axis:
            properties["rest"] = float(model.qpos_spring[place] - start)
        if model.jnt_limited[j] and not off["LIMIT"]:
            low, high = model.jnt_range[j] - start
            properties["limits"] = (float(low), float(high))
        elif has_axis and self._name("JOINT", j) in self._stated_limits:
            properties["limits"] = self._stated_limits[self._name("JOINT", j)]
        return {key: value for key, value in properties.items() if value}

    def fates(self) -> Iterator[Fate]:
        """Report the fates of contact, equalities, tendons and actuators that are not servos."""
        model = self._model
        geoms = touching(model)
        if self._geoms is not None:
            yield from self._geoms.fates()
        elif (len(geoms) > 1 or model.npair) and not self._off["CONTACT"]:
            names = tuple(element_name(self._mujoco, model, "GEOM", g) for g in geoms)
            yield Fate("geom", ("contact",), "dropped", COLLISION, True, names, len(geoms))
        yield from self._higher()
        yield from self._ties.fates()
        yield from mechanics_of_drives(self._mujoco, model)
        yield from (fate for fate in self._drives if isinstance(fate, Fate))

    def _higher(self) -> Iterator[Fate]:
        """Report forces of joints that are not linear."""
        model = self._model
        for j in range(model.njnt):
            keys = higher(model, "jnt", j, self._off)
            keys += higher(model, "dof", int(model.jnt_dofadr[j]), self._off)
            if keys:
                yield Fate("joint", keys, "dropped", HIGHER, True, (self._name("JOINT", j),))

    def _name(self, kind: str, k: int) -> str:
        return element_name(self._mujoco, self._model, kind, k)
