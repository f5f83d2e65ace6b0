"""Shared functions of model writers: names, and reports on what a format has no place for."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from itertools import combinations_with_replacement

import msgspec

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.imported import Fate, Written, gathered
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism
from mbds_xsim.scene.scene import WORLD, Scene

_SETTING = "a setting of the run, which no model has"
_START = "the model stands in the reference pose"
_NO_MODEL: dict[str, tuple[bool, str]] = {
    "forces": (True, "the format has no forces"),
    "torques": (True, "the format has no torques"),
    "noise": (True, "the format has no forces"),
    "contacts": (True, "an importing program has contact of its own"),
    "ground": (True, "an importing program has contact of its own"),
    "collisions": (True, "an importing program has contact of its own"),
    "sampling": (True, _START),
    "clock": (False, _SETTING),
    "budget": (False, _SETTING),
    "dimension": (False, _SETTING),
    "anchors": (False, "drawn only"),
    "edges": (False, "drawn only"),
}
"""Fields of a scene that no format takes: whether the motion depends on them, and the reason."""
_NO_START = dict.fromkeys(
    ("joints.start", "joints.rate", "bodies.velocity", "bodies.angular_velocity"), _START
)


def written(
    text: str, scene: Scene, lacks: Mapping[str, str], fates: Iterable[Fate] = ()
) -> Written:
    """Return a scene in another format, with what no format takes and what this one lacks."""
    return Written(text, gathered([*_no_model(scene), *_lacking(scene, lacks), *fates]))


def _no_model(scene: Scene) -> Iterator[Fate]:
    """Report what no model format takes, and particles, which become one inertia."""
    defaults = {field.name: field.default for field in msgspec.structs.fields(Scene)}
    for key, (moves, reason) in _NO_MODEL.items():
        value = getattr(scene, key)
        if value and value != defaults[key]:
            count = len(value) if isinstance(value, tuple) else 1
            yield Fate(key, (), "dropped", reason, moves, (), count)
    yield from _lacking(scene, _NO_START)
    reason = "one inertia, without the single particles"
    for body in scene.bodies:
        if body.particles:
            yield Fate("bodies", ("particles",), "kept", reason, True, (body.name,))


def _lacking(scene: Scene, lacks: Mapping[str, str]) -> Iterator[Fate]:
    """Report everything in a scene that one format has no place for.

    Args:
        scene: The scene.
        lacks: Reasons, keyed by a table of the scene (`springs`) or a property in one
            (`joints.armature`).
    """
    for key, reason in lacks.items():
        table, _, field = key.partition(".")
        for item in getattr(scene, table):
            if not field or getattr(item, field):
                yield dropped_fate(table, reason, getattr(item, "name", "") or item.joint, field)


def dropped_fate(element: str, reason: str, name: str, *properties: str) -> Fate:
    """Return the fate of something that affects the motion and is not in the model."""
    return Fate(element, tuple(filter(None, properties)), "dropped", reason, True, (name,))


Names = dict[tuple[str, str], str]
"""Names in a model, keyed by table and name in the scene."""


def unlike(
    scene: Scene, tables: Iterable[str], spelling: Callable[[str], str], reason: str
) -> tuple[Names, list[Fate]]:
    """Assign unique names, and report those that differ from the scene's.

    Args:
        scene: The scene.
        tables: Tables in which no two things may share a name.
        spelling: Returns a name as the format accepts it.
        reason: Reason to report for changed names.
    """
    names: Names = {}
    taken: set[str] = set()
    fates = []
    for table in tables:
        for item in getattr(scene, table):
            name = unique(spelling(item.name), taken)
            taken.add(name)
            names[table, item.name] = name
            if name != item.name:
                places = (f"{item.name} is {name}",)
                fates.append(Fate(table, ("name",), "approximated", reason, False, places))
    return names, fates


def unique(name: str, taken: Container[str]) -> str:
    """Return a name, followed by as many underscores as make it unique."""
    while name in taken:
        name += "_"
    return name


def name_of(mechanism: Mechanism, body: int) -> str:
    """Return the name of a body, given its index."""
    return WORLD if body == WORLD_INDEX else mechanism.scene.bodies[body].name


def tensor_words(tensor: Array) -> dict[str, str]:
    """Write the six elements of an inertia, shape (3, 3), under the names that URDF and SDF use."""
    pairs = combinations_with_replacement(enumerate("xyz"), 2)
    return {f"i{a}{b}": repr(float(tensor[j, k])) for (j, a), (k, b) in pairs}


def without_servos(scene: Scene) -> Mechanism:
    """Return the mechanism without servos, with only its joints' own springs and dampers."""
    return Mechanism.of(msgspec.structs.replace(scene, servos=()))


def first_targets(scene: Scene) -> Iterator[Fate]:
    """Report the servos whose targets change: only the first target is written."""
    for servo in scene.servos:
        if len({*servo.position}) > 1 or len({*servo.velocity}) > 1:
            reason = "the first target alone: an importing program has its own commands"
            yield Fate("servos", ("series",), "approximated", reason, True, (servo.joint,))
