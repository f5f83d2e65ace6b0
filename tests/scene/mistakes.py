"""Mistakes in scene files, each made in a sound scene, and what is said of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from tests.tables import at

__all__ = ["MISTAKES", "Edit", "swinging_door"]

Table = dict[str, Any]
Edit = Callable[[Table], object]


def swinging_door() -> Table:
    """Make a valid scene with something of most kinds, to be spoilt."""
    return {
        "name": "door",
        "length": 1.0,
        "bodies": [
            {"name": "leaf", "inertia": {"mass": 2.0, "moments": [0.3, 0.2, 0.4]}},
            {"name": "knob", "particles": [{"position": [0.5, 0.0, 0.0]}]},
        ],
        "joints": [
            {
                "name": "frame",
                "kind": "hinge",
                "parent": "world",
                "child": "leaf",
                "anchor": [-0.5, 0.0, 0.0],
                "axis": [0.0, 0.0, 1.0],
                "rate": 1.0,
            },
            {
                "name": "spindle",
                "kind": "hinge",
                "parent": "leaf",
                "child": "knob",
                "anchor": [0.5, 0.0, 0.0],
                "axis": [0.0, 1.0, 0.0],
            },
        ],
        "sampling": [{"kind": "hinge_rate", "joints": ["spindle"], "rate": [-1.0, 1.0]}],
    }


def _set(*path: str | int, to: object) -> Edit:
    def edit(table: Table) -> None:
        at(table, path[:-1])[path[-1]] = to

    return edit


_TIP = {"body": "knob", "center": [0.5, 0.0, 0.0], "radius": 0.1}


def _collisions(*pairs: list[str]) -> Table:
    return {"pairs": list(pairs), "friction": 0.1, "restitution": 0.5}


def _both(*edits: Edit) -> Edit:
    def edit(table: Table) -> None:
        for one in edits:
            one(table)

    return edit


def _drop(*path: str | int) -> Edit:
    return lambda table: at(table, path[:-1]).pop(path[-1])


MISTAKES: dict[str, tuple[Edit, str]] = {
    "unknown key": (
        _set("bodies", 1, "particles", 0, "masss", to=1.0),
        "bodies[1].particles[0] (in 'knob'): unknown key 'masss'; did you mean 'mass'? "
        "Allowed are position, mass, inertia",
    ),
    "unknown key of two lines": (
        _set("wa\nlls", to=[]),
        "unknown key 'wa\\nlls'; allowed are name, bodies, ",
    ),
    "unknown table": (_set("walls", to=[]), "unknown key 'walls'; allowed are name, bodies, "),
    "wrong type": (
        _set("bodies", 1, "particles", 0, "mass", to="1 kg"),
        "bodies[1].particles[0].mass (in 'knob'): got '1 kg', allowed is a number",
    ),
    "wrong length": (
        _set("joints", 0, "anchor", to=[0, 1]),
        "joints[0].anchor (in 'frame'): got [0, 1], allowed is an array of 3 numbers",
    ),
    "wrong choice": (
        _set("joints", 1, "kind", to="revolute"),
        "joints[1].kind (in 'spindle'): got 'revolute', "
        "allowed is 'ball' or 'fixed' or 'hinge' or 'slider'",
    ),
    "missing key": (
        _drop("joints", 1, "anchor"),
        "joints[1] (in 'spindle'): the key 'anchor' is missing, it is an array of 3 numbers; "
        "got name, kind, parent, child, axis",
    ),
    "missing name": (_drop("bodies", 1, "name"), "bodies[1]: the key 'name' is missing"),
    "missing length": (_drop("length"), "the key 'length' is missing, it is a number; got name"),
    "missing kind of draw": (
        _drop("sampling", 0, "kind"),
        "sampling[0]: the key 'kind' is missing; allowed is a table with kind = 'swing' or ",
    ),
    "wrong kind of draw": (
        _set("sampling", 0, "kind", to="hinge"),
        "sampling[0].kind: got 'hinge', allowed is 'swing' or 'turn' or 'throw' or 'roll' or 'l",
    ),
    "neither range nor levels": (
        _set("sampling", 0, "rate", to=3.0),
        "sampling[0].rate: got 3.0, allowed is an array of 2 numbers or a table of low, medium, ",
    ),
    "range upside down": (
        _set("sampling", 0, "rate", to=[1.0, -1.0]),
        "sampling[0].rate: got [1.0, -1.0], allowed is [low, high]",
    ),
    "not a table": (
        _set("bodies", to=3),
        "bodies: got 3, allowed is an array, each item a table of name, particles, ",
    ),
    "NaN": (
        _set("joints", 0, "anchor", to=[0.0, math.nan, 0.0]),
        "joints[0].anchor (in 'frame'): got [0.0, nan, 0.0], allowed are finite numbers",
    ),
    "infinite": (_set("length", to=math.inf), "length: got inf, allowed is a finite number above"),
    "negative mass": (
        _set("bodies", 0, "inertia", "mass", to=-2.0),
        "bodies[0].inertia.mass (in 'leaf'): got -2.0, allowed is a finite number above 0",
    ),
    "non-physical inertia": (
        _set("bodies", 0, "inertia", "moments", to=[1.0, 1.0, 3.0]),
        "bodies[0].inertia (in 'leaf'): moments, products: got principal moments 1, 1, 3; "
        "allowed is each above 0 and at most the sum of the other two",
    ),
    "particles without inertia on a line": (
        _set("bodies", 1, "particles", 0, "inertia", to=0.0),
        "bodies['knob'].particles: got smallest principal inertia 0 kg·m², allowed is above 0",
    ),
    "both kinds of mass": (
        _set("bodies", 0, "particles", to=[{"position": [0.0, 0.0, 0.0]}]),
        "body 'leaf' needs either particles or inertia, got both",
    ),
    "orientation not unit": (
        _set("bodies", 0, "orientation", to=[1.0, 1.0, 0.0, 0.0]),
        "bodies[0].orientation (in 'leaf'): got [1.0, 1.0, 0.0, 0.0] of norm 1.41421356",
    ),
    "two bodies of one name": (
        _set("bodies", 1, "name", to="leaf"),
        "bodies: got 'leaf' twice, each name is allowed once",
    ),
    "unknown body": (
        _set("joints", 1, "child", to="handle"),
        "joints[1].child: no body is called 'handle'; there are: knob, leaf, world",
    ),
    "unknown hinge": (
        _set("sampling", 0, "joints", to=["hinge"]),
        "sampling[0].joints: no hinge is called 'hinge'; there are: frame, spindle",
    ),
    "unknown thrown body": (
        _set("sampling", 0, to={"kind": "throw", "body": "key"}),
        "sampling[0].body: no body is called 'key'; there are: knob, leaf",
    ),
    "degrees for radians": (
        _set("joints", 0, "start", to=90.0),
        "joints[0].start (in 'frame'): got 90.0, allowed is −2π to 2π; hinge angles are in rad",
    ),
    "hinge without axis": (
        _drop("joints", 0, "axis"),
        "joints[0] (in 'frame'): a hinge joint needs an axis, got none",
    ),
    "no steps": (_set("clock", to={"steps": 0}), "clock.steps: got 0, allowed is a whole number"),
    "place too far": (
        _set("joints", 1, "anchor", to=[0.0, -1.1e7, 0.0]),
        "joints[1].anchor (in 'spindle'): got -11000000.0, allowed is 1e+07 at most: farther out, "
        "double precision rounds by more than 1e-9 m",
    ),
    "length too long": (_set("length", to=1e8), "length: got 100000000.0, allowed is 1e+07 at mo"),
    "length too short": (
        _set("length", to=1e-10),
        "length: got 1e-10, allowed is 1e-09 or more: places are resolved to 1e-9 m",
    ),
    "spring too long": (
        _set(
            "springs",
            to=[
                {"name": "s", "bodies": ["world", "leaf"], "rest_length": 1e300}
                | {"points": [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]}
            ],
        ),
        "springs[0].rest_length (in 's'): got 1e+300, allowed is 1e+15 at most",
    ),
    "number too large": (
        _set("gravity", to=[0.0, 0.0, 1e16]),
        "gravity: got 1e+16, allowed is 1e+15 at most: products of larger numbers overflow",
    ),
    "mass too small": (
        _set("bodies", 0, "inertia", "mass", to=1e-31),
        "bodies[0].inertia.mass (in 'leaf'): got 1e-31, allowed is 1e-30 or more: products of sm",
    ),
    "moments too small": (
        _set("bodies", 0, "inertia", "moments", to=[1e-61, 1e-61, 1e-61]),
        "bodies[0].inertia.moments (in 'leaf'): got [1e-61, 1e-61, 1e-61], allowed is 1e-60 or mo",
    ),
    "frame too short": (
        _set("clock", to={"frame": 5e-324}),
        "clock.frame: got 5e-324, allowed is 1e-09 or more: in less, 1 m/s moves a body by less",
    ),
    "too many states": (
        _set("clock", to={"steps": 6_000_000}),
        "clock.steps · bodies: got 12000000, allowed are 10000000 at most: a trajectory of more ta",
    ),
    "range too wide": (
        _set("sampling", 0, "rate", to=[0.0, 1e300]),
        "sampling[0].rate: got 1e+300, allowed is 1e+15 at most",
    ),
    "NUL in a name": (
        _set("bodies", 1, "name", to="kn\0b"),
        "bodies[1].name: got 'kn\\x00b', allowed is a line of text without control characters",
    ),
    "bell in a name": (
        _set("joints", 0, "name", to="fra\ame"),
        "joints[0].name: got 'fra\\x07me', allowed is a line of text without control characters",
    ),
    "no character in a name": (
        _set("name", to="do\uffffor"),
        "name: got 'do\\uffffor', allowed is a line of text without control characters",
    ),
    "name too long": (
        _set("joints", 0, "name", to="é" * 101),
        "joints[0].name: got 202 bytes of UTF-8, allowed are 200 at most: files are named after it",
    ),
    "restless hold": (
        _set(
            "sampling",
            0,
            to={"kind": "hinge_torque", "joints": ["frame"], "torque": [0, 1], "hold": 0},
        ),
        "sampling[0].hold: got 0, allowed is a whole number, 1 or more",
    ),
    "edge to nowhere": (
        _set("edges", to=[[0, 1]]),
        "edges[0]: got [0, 1], allowed are two different numbers from 0 to 0 (1 particles, 0",
    ),
    "velocities that break a joint": (
        _set("bodies", 0, "velocity", to=[1.0, 1.0, 0.0]),
        "the initial velocities contradict each other at ",
    ),
    "loop that cannot be closed": (
        _set(
            "distance_links",
            to=[
                {
                    "name": "stay",
                    "bodies": ["world", "leaf"],
                    "points": [[-0.5, 0.0, 1.0], [0.5, 0.0, 0.0]],
                    "length": 9.0,
                }
            ],
        ),
        "distance_links['stay'] cannot be closed: the start leaves it off by ",
    ),
    "draw against a joint": (
        _set(
            "sampling",
            0,
            to={
                "kind": "turn",
                "point": [0.0, 0.0, 0.0],
                "axis": [1.0, 0.0, 0.0],
                "angle": [0.1, 0.2],
                "rate": [0.0, 0.0],
            },
        ),
        "sampling: the drawn start leaves joints['frame'] off by ",
    ),
    "draw that swings a hinged body": (
        _set(
            "sampling",
            0,
            to={"kind": "swing", "bodies": ["leaf"], "polar": [0, 1], "speed": [0, 1]},
        ),
        "sampling: 'leaf' hangs on no ball joint and cannot swing",
    ),
    "draw of nothing": (
        _set("sampling", 0, to={"kind": "swing", "bodies": [], "polar": [0, 1], "speed": [0, 1]}),
        "sampling[0].bodies: got [], allowed is one name or more, each once",
    ),
    "gear of no ratio": (
        _set("couplings", to=[{"joint": "spindle", "follows": "frame", "ratio": 0.0}]),
        "coupling of 'spindle': got the ratio 0, allowed is any other number",
    ),
    "gear of a joint on itself": (
        _set("couplings", to=[{"joint": "spindle", "follows": "spindle"}]),
        "couplings[0].follows: got 'spindle', so 'spindle' would follow itself",
    ),
    "gears in a ring": (
        _set(
            "couplings",
            to=[{"joint": "spindle", "follows": "frame"}, {"joint": "frame", "follows": "spindle"}],
        ),
        "couplings[1].follows: got 'spindle', so 'frame' would follow itself",
    ),
    "two gears of a joint": (
        _set("couplings", to=[{"joint": "spindle", "follows": "frame"}] * 2),
        "couplings[1].joint: got 'spindle' again, allowed is one coupling for each joint",
    ),
    "gear that a draw breaks": (
        _set("couplings", to=[{"joint": "spindle", "follows": "frame"}]),
        "sampling: the joint 'spindle' follows 'frame'; draw that one alone",
    ),
    "collisions without spheres": (
        _set("collisions", to=_collisions(["leaf", "knob"])),
        "ground: got None, with 0 contact spheres; a ground, or collisions, need contact spheres",
    ),
    "collision with a body without spheres": (
        _both(_set("contacts", to=[_TIP]), _set("collisions", to=_collisions(["leaf", "knob"]))),
        "collisions.pairs[0][0]: no body with contact spheres is called 'leaf'",
    ),
    "too many collisions": (
        _both(
            _set("contacts", to=[_TIP] * 400 + [_TIP | {"body": "leaf"}] * 251),
            _set("collisions", to=_collisions(["leaf", "knob"])),
        ),
        "collisions.pairs · spheres: got 100400, allowed are 100000 at most: 200 frames of so many",
    ),
    "collision of a body with itself": (
        _both(_set("contacts", to=[_TIP]), _set("collisions", to=_collisions(["knob", "knob"]))),
        "collisions.pairs[0]: got ['knob', 'knob'], allowed are two different bodies, each pair",
    ),
    "collisions of none": (
        _both(_set("contacts", to=[_TIP]), _set("collisions", to=_collisions())),
        "collisions.pairs: got none, allowed are one or more",
    ),
    "spheres that touch nothing": (
        _set("contacts", to=[_TIP]),
        "with 1 contact spheres; they need a [ground] or [collisions]",
    ),
    "friction below nothing": (
        _set("joints", 0, "friction", to=-1.0),
        "joints[0].friction (in 'frame'): got -1.0",
    ),
    "draw of one thing twice": (
        _set("sampling", 0, to={"kind": "hinge_rate", "joints": ["frame"] * 2, "rate": [0, 1]}),
        "sampling[0].joints: got ['frame', 'frame'], allowed is one name or more, each once",
    ),
}
