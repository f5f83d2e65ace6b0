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
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, tostring

import numpy as np

from mbds_xsim.base.errors import InputError, check_name
from mbds_xsim.base.frame import optional
from mbds_xsim.scene.imported import Fate, Imported, ModelFacts

from .assembling import assemble
from .contacts import NO_SPHERES
from .fates import LABELS, PAIRING, fates_of, labelled, lost_mimic
from .graph import check_circles, check_unique
from .mending import in_lines, mend_mjcf, mend_urdf, remove_unknown
from .parts import Parts
from .source import read_source

_MECHANICAL = {"link", "inertial", "mass", "inertia", "origin", "joint", "parent", "child", "axis",
               "limit", "dynamics", "mimic"}  # fmt: skip
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


def read(path: Path, folder: Path, floating: bool, ground: bool) -> Imported:
    """Read an MJCF or URDF file; see `mbds_xsim.simulate.registry`."""
    mujoco = optional("mujoco", "reading MJCF and URDF", "mujoco")
    from .reading import Reading

    root = read_source(path, folder)
    if root.tag not in ("mujoco", "robot"):
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
    reading = Reading(model, masses, shape, limits)
    name = (root.get("model") or root.get("name") or "").strip() or path.stem
    parts = reading.parts(name, LABELS[root.tag])
    reported = labelled(root.tag, parts.stated) | dict.fromkeys(_TOUCHING.get(shape, ()), True)
    own = [*reading.fates(), *_lost_mimics(root, parts)]
    of_joints = (fate for fate in own if fate.element == "joint")
    reported |= {("joint", key): True for fate in of_joints for key in fate.properties}
    fates = [*mends, *fates_of(root, reported), *own]
    kind = "MJCF" if root.tag == "mujoco" else "URDF"
    reader = f"MuJoCo {mujoco.__version__}"
    return assemble(parts, file=path.name, kind=kind, reader=reader, fates=fates)


def load(path: Path, floating: bool) -> ModelFacts:
    """Return what MuJoCo itself reads from a file; see `mbds_xsim.studies.readers`."""
    import mujoco

    from .reading import Reading

    if path.suffix.lower() not in (".xml", ".urdf"):
        raise InputError("MuJoCo reads MJCF and URDF alone")
    with _refusals(mujoco):
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compiler.fusestatic = False
        if floating:
            spec.worldbody.first_body().add_freejoint()
        reading = Reading(spec.compile())
    return reading.parts("", {}).facts(f"MuJoCo {mujoco.__version__}")


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
        mends = [*mend_mjcf(root)]
        latest: object = mends or "unrecognized attribute" in str(error)
        while latest:
            try:
                spec = mujoco.MjSpec.from_string(in_lines(root))
                spec.modelfiledir = str(path.parent)
                spec.compiler.fusestatic = False
                return spec.compile(), mends
            except ValueError as again:
                latest = [*remove_unknown(root, str(again))]
                mends += latest
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
    check_unique(root, "link")
    above = defaultdict[str, list[str]](list)
    links = [link.get("name", "") for link in root.findall("link")]
    for joint in root.findall("joint"):
        _check_axis(joint)
        name = joint.get("name", "")
        for end in (*joint.findall("parent"), *joint.findall("child")):
            check_name(f"link of the joint {name!r}", end.get("link", ""), [*links, "world"])
        if any(mimic.get("joint") == name for mimic in joint.findall("mimic")):
            raise InputError(f"joint {name!r} follows itself, allowed is another")
        for child in joint.findall("child"):
            above[child.get("link", "")] += (p.get("link", "") for p in joint.findall("parent"))
    check_circles(root, above)
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
    is_direction = 0.0 < sum(value * value for value in values) < math.inf
    if len(values) != 3 or (kind in _WITH_AXIS and not is_direction):
        msg = f"joint {joint.get('name')!r} has the axis {text!r}, "
        raise InputError(f"{msg}allowed are three numbers, not all 0, with a finite sum of squares")
    if kind == "planar" and values != [0, 0, 1]:
        raise InputError(
            f"joint {joint.get('name')!r} is planar with the normal {text}, but MuJoCo "
            "assumes 0 0 1; turn its origin so that this is the normal"
        )


def _stated_limits(root: Element) -> dict[str, tuple[float, float]]:
    """Return the limits in a URDF, by joint: one of the two that is not stated is 0."""
    limits = {}
    for joint in root.findall("joint"):
        limit, limited = joint.find("limit"), joint.get("type") in ("revolute", "prismatic")
        if limited and limit is not None and {"lower", "upper"} & limit.attrib.keys():
            low, high = (float(limit.get(key, "").strip() or "0") for key in ("lower", "upper"))
            limits[joint.get("name", "")] = (low, high)
    return limits


def _lost_mimics(root: Element, parts: Parts) -> Iterator[Fate]:
    """Report joints of a URDF that the compiler does not let follow another."""
    followers = {coupling.joint for coupling in parts.couplings}
    known = {joint.get("name", "") for joint in root.findall("joint")}
    for joint in root.findall("joint[mimic]"):
        if (name := joint.get("name", "")) not in followers:
            follows = next(joint.iter("mimic")).get("joint", "")
            yield lost_mimic(name, follows, known)


def _replace_masses(spec: Any, floating: bool) -> dict[str, Any]:
    """Replace all masses in a spec by a unit mass and inertia; free its bases if `floating`.

    Returns:
        Stated mass, position and orientation of its axes in the link's frame, and inertia along
        these axes, keyed by link; links that state none are absent.
    """
    spec.compiler.fusestatic = False
    masses = {}
    for body in spec.bodies[1:]:
        if body.explicitinertial:
            xx, yy, zz, xy, xz, yz = body.fullinertia
            full = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            unset = np.isnan(xx) and not full.any(where=~np.isnan(full))
            tensor = np.diag(body.inertia) if unset else full
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
