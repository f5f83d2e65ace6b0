"""MJCF and URDF, as MuJoCo's compiler resolves them.

Defaults, includes, frames, limits' units and the inertia of geometry are the compiler's to know.
What a URDF says of masses is taken as it is written, before MuJoCo refuses or mends it: links have
the inertia that is stated, none where none is, and meshes are not read.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, tostring

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.frame import optional
from mbds_xsim.scene.imported import Fate, Imported, ModelFacts

from .assembling import assemble
from .contacts import NO_SPHERES
from .drives import drives
from .facts import facts_of
from .fates import COLLISION, fates_of
from .geoms import PAIRING, Geoms
from .mending import mended_mjcf, mended_urdf, without_unknown
from .parts import Drive, Freedom, Mass, Part, Parts, Property
from .source import read_source
from .ties import Ties, named

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
"""Element and attribute of each property."""
_MECHANICAL = {
    "link", "inertial", "mass", "inertia", "origin", "joint", "parent", "child", "axis", "limit",
    "dynamics", "mimic",
}  # fmt: skip
"""Elements of a URDF that say how it moves."""
_SOLID = {"collision", "geometry", "sphere", "capsule", "cylinder", "box"}
"""Elements of a URDF that say what of it meets the ground."""
_TOUCHING = {
    "geom": [(tag, key) for tag, keys in PAIRING.items() for key in keys],
    "collision": [("collision", ""), ("collision", "name")],
}
"""What is told of shapes on the ground, by what the format calls a shape."""
_ALIASES = {
    ("joint", "limited"): "limits",
    ("joint", "springdamper"): "damping",
    ("limit", "upper"): "limits",
}


def read(path: Path, folder: Path, floating: bool, ground: bool) -> Imported:
    """Read an MJCF or URDF file; see `mbds_xsim.simulate.registry`."""
    mujoco = optional("mujoco", "reading MJCF and URDF", "mujoco")
    root = read_source(path, folder)
    if root.tag not in _LABELS:
        msg = f"its outermost element is <{root.tag}>, allowed are <mujoco> and <robot>"
        raise InputError(msg)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            stated = {}
            if root.tag == "mujoco":
                spec, model, mends = _compiled(mujoco, root, path)
            else:
                mends = [*mended_urdf(root), *(_without_meshes(root) if ground else ())]
                spec = _mechanics(mujoco, root, path, _MECHANICAL | (_SOLID if ground else set()))
                stated = _stated(spec, floating)
                model = spec.compile()
        except (ValueError, mujoco.FatalError) as error:
            raise InputError(_line(str(error))) from error
    if root.tag == "mujoco" and floating:
        msg = "--floating is for URDF; an MJCF file says itself which of its bodies are free"
        raise InputError(msg)
    shape = "" if not ground else "geom" if root.tag == "mujoco" else "collision"
    reading = Reading(mujoco, model, stated, shape)
    parts = reading.model(str(spec.modelname).strip() or path.stem, _LABELS[root.tag])
    had = {key for part in parts.parts for freedom in part.freedoms for key in freedom.properties}
    told = {label: key in had for key, label in _LABELS[root.tag].items()}
    told |= {label: key in had for label, key in _ALIASES.items()}
    told |= dict.fromkeys(_TOUCHING.get(shape, ()), True)
    fates = [*mends, *fates_of(root, told), *reading.fates()]
    kind = "MJCF" if root.tag == "mujoco" else "URDF"
    reader = f"MuJoCo {mujoco.__version__}"
    return assemble(parts, file=path.name, kind=kind, reader=reader, fates=fates)


def load(path: Path, floating: bool) -> ModelFacts:
    """Say what MuJoCo makes of a file by itself; see `mbds_xsim.simulate.registry`."""
    import mujoco

    if path.suffix.lower() not in (".xml", ".urdf"):
        msg = "MuJoCo reads MJCF and URDF alone"
        raise InputError(msg)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            spec = mujoco.MjSpec.from_file(str(path))
            spec.compiler.fusestatic = False  # names links, and moves nothing
            if floating:
                spec.worldbody.first_body().add_freejoint()
            reading = Reading(mujoco, spec.compile(), {})
        except (ValueError, mujoco.FatalError) as error:
            raise InputError(_line(str(error))) from error
    return facts_of(reading.model("", {}), f"MuJoCo {mujoco.__version__}")


def _compiled(mujoco: Any, root: Element, path: Path) -> tuple[Any, Any, list[Fate]]:
    """Give specification and model of an MJCF file, mended where the compiler refuses it."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        return spec, spec.compile(), []
    except ValueError as error:
        mends: list[Fate] = []
        more = [*mended_mjcf(root), *without_unknown(root, str(error))]
        while more:
            mends += more
            try:
                spec = mujoco.MjSpec.from_string(tostring(root, encoding="unicode"))
                spec.modelfiledir = str(path.parent)
                return spec, spec.compile(), mends
            except ValueError as again:
                more = [*without_unknown(root, str(again))]
        raise error


def _without_meshes(root: Element) -> Iterator[Fate]:
    """Take collision shapes out of a URDF that have no contact spheres, and say so."""
    for link in root.iter("link"):
        for shape in link.findall("collision"):
            if shape.find("geometry/mesh") is not None:
                link.remove(shape)
                place = f"of {link.get('name', '')}"
                yield Fate("collision", (), "dropped", f"{NO_SPHERES} mesh", True, (place,))


def _mechanics(mujoco: Any, root: Element, path: Path, tags: set[str]) -> Any:
    """Give the specification of what some elements of a URDF say."""
    for joint in root.iter("joint"):
        axis = joint.find("axis")
        normal = "1 0 0" if axis is None else axis.get("xyz", "1 0 0")
        if joint.get("type") == "planar" and [float(x) for x in normal.split()] != [0, 0, 1]:
            msg = (
                f"joint {joint.get('name')!r} is planar with the normal {normal}, which MuJoCo "
                "takes for 0 0 1; turn its origin so that the normal is that"
            )
            raise InputError(msg)
    kept = copy.deepcopy(root)
    for parent in list(kept.iter()):
        for child in [child for child in parent if child.tag not in tags]:
            parent.remove(child)
    try:
        return mujoco.MjSpec.from_string(tostring(kept, encoding="unicode"))
    except ValueError:
        mujoco.MjSpec.from_file(str(path))  # tells the line of the file itself
        raise


def _stated(spec: Any, floating: bool) -> dict[str, Any]:
    """Take the masses out of a specification, with all that cannot matter to the rest.

    Returns:
        Mass, place and turn of the axes in the link's frame, and inertia along these, by link.
    """
    spec.compiler.fusestatic = False
    stated = {}
    for body in spec.bodies[1:]:
        full = np.array(body.fullinertia)
        xx, yy, zz, xy, xz, yz = full
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if np.isnan(full[0]):
            tensor = np.diag(body.inertia)
        if body.explicitinertial:
            stated[body.name] = (body.mass, np.array(body.ipos), np.array(body.iquat), tensor)
        body.mass, body.inertia, body.ipos, body.iquat = 1.0, np.ones(3), np.zeros(3), [1, 0, 0, 0]
        body.fullinertia = [math.nan] + 5 * [0.0]
        body.explicitinertial = True
    if floating:
        for body in [body for body in spec.bodies[1:] if body.parent.name == "world"]:
            if not body.joints:
                body.add_freejoint()
    return stated


def _line(text: str) -> str:
    """Make a line of what the compiler says, and leave out what names nothing."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    kept = [line for line in lines if line not in ("Element name ''", "Element name '', id 0")]
    return "; ".join(kept).replace("XML Error: ", "").replace("Error: ", "")


class Reading:
    """A compiled model at its reference pose.

    Args:
        mujoco: The module.
        model: The compiled model.
        stated: Masses that count in place of the compiled ones, by body.
        shape: What the format calls a shape on the ground; "" where there is none.
    """

    def __init__(self, mujoco: Any, model: Any, stated: dict[str, Any], shape: str = "") -> None:
        self._mujoco, self._model, self._stated = mujoco, model, stated
        self._data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self._data)
        flags = mujoco.mjtDisableBit
        parts = ("GRAVITY", "SPRING", "DAMPER", "LIMIT", "FRICTIONLOSS", "EQUALITY", "CONTACT")
        self._off = {
            part: bool(model.opt.disableflags & getattr(flags, f"mjDSBL_{part}")) for part in parts
        }
        if model.opt.disableflags & flags.mjDSBL_CONSTRAINT:
            self._off |= dict.fromkeys(("LIMIT", "FRICTIONLOSS", "EQUALITY", "CONTACT"), True)
        contact = not self._off["CONTACT"]
        self._geoms = Geoms(model, self._data, shape, active=contact) if shape else None
        self._ties = Ties(mujoco, model, self._data, active=not self._off["EQUALITY"])
        self._drives = tuple(drives(mujoco, model))

    def model(self, name: str, labels: Mapping[str, tuple[str, str]]) -> Parts:
        """Give the parts."""
        return Parts(
            name=name,
            parts=tuple(self._parts()),
            gravity=self._gravity(),
            closings=tuple(self._ties.closings()),
            couplings=tuple(self._ties.couplings()),
            lines=tuple(self._ties.lines()),
            drives=tuple(drive for drive in self._drives if isinstance(drive, Drive)),
            solids=self._geoms.solids() if self._geoms is not None else None,
            labels=labels,
        )

    def _gravity(self) -> Array:
        return np.zeros(3) if self._off["GRAVITY"] else np.array(self._model.opt.gravity)

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
        if not self._stated and model.body_mass[k] > 0:
            mass, com, turn = model.body_mass[k], model.body_ipos[k], model.body_iquat[k]
            tensor = np.diag(model.body_inertia[k])
        elif self._stated:
            mass, com, turn, tensor = self._stated.get(
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
        found: dict[str, Property] = {
            "stiffness": 0.0 if off["SPRING"] else float(model.jnt_stiffness[j]),
            "damping": 0.0 if off["DAMPER"] else float(model.dof_damping[dof]),
            "armature": float(model.dof_armature[dof]),
            "friction": 0.0 if off["FRICTIONLOSS"] else float(model.dof_frictionloss[dof]),
        }
        if found["stiffness"] and has_axis:
            found["rest"] = float(model.qpos_spring[place] - start)
        if model.jnt_limited[j] and not off["LIMIT"]:
            low, high = model.jnt_range[j] - start
            found["limits"] = (float(low), float(high))
        return {key: value for key, value in found.items() if value}

    def fates(self) -> Iterator[Fate]:
        """Say what becomes of contact, equalities, tendons and actuators that lead no hinge."""
        model = self._model
        solid = [g for g in range(model.ngeom) if model.geom_contype[g] | model.geom_conaffinity[g]]
        if self._geoms is not None:
            yield from self._geoms.fates()
        elif (len(solid) > 1 or model.npair) and not self._off["CONTACT"]:
            names = tuple(named(self._mujoco, model, "GEOM", g) for g in solid)
            yield Fate("geom", ("contact",), "dropped", COLLISION, True, names, len(solid))
        yield from self._ties.fates()
        yield from (fate for fate in self._drives if isinstance(fate, Fate))

    def _name(self, kind: str, k: int) -> str:
        return named(self._mujoco, self._model, kind, k)
