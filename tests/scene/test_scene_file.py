"""Scene files: nothing is lost on the way."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mbds_xsim.scene.file import read_scene, save_scene, write_scene
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.registry import load_scene, scene_names

Table = dict[str, Any]

_FINITE = st.floats(-1e6, 1e6)
_POSITIVE = st.floats(1e-6, 1e6)
_VECTOR = st.tuples(_FINITE, _FINITE, _FINITE)
_LETTERS = st.characters(
    exclude_categories=("Cc", "Cs", "Zl", "Zp"), exclude_characters="\ufffe\uffff"
)
_NAME = st.text(_LETTERS, min_size=1, max_size=8).filter(lambda name: name != "world")


def _range(values: tuple[float, float]) -> list[float]:
    return sorted(values)


_RANGE = st.tuples(_FINITE, _FINITE).map(_range)
_SPAN = st.one_of(_RANGE, st.fixed_dictionaries(dict.fromkeys(("low", "medium", "high"), _RANGE)))
_SPANS = st.tuples(_SPAN, _SPAN, _SPAN)
_AXIS = _VECTOR.filter(lambda axis: math.hypot(*axis) > 0)
_TWO_POINTS = st.tuples(_VECTOR, _VECTOR).filter(lambda ends: math.dist(*ends) > 0)


def _optional(required: Table, **optional: st.SearchStrategy[Any]) -> st.SearchStrategy[Table]:
    return st.fixed_dictionaries(required, optional=optional)


def _quaternion(v: tuple[float, ...]) -> list[float]:
    return [component / math.hypot(*v) for component in v]


_QUATERNION = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda v: math.hypot(*v) > 0.1)
_PARTICLE = _optional({"position": _VECTOR}, mass=_POSITIVE, inertia=st.floats(0, 1e6))
_INERTIA = _optional(
    {"mass": _POSITIVE, "moments": st.tuples(*[st.floats(1.0, 1.5)] * 3)},
    products=st.tuples(*[st.floats(-0.1, 0.1)] * 3),
    com=_VECTOR,
)
_PLACE = {
    "position": _VECTOR,
    "orientation": _QUATERNION.map(_quaternion),
    "velocity": _VECTOR,
    "angular_velocity": _VECTOR,
}


def _body(name: str) -> st.SearchStrategy[Table]:
    clusters = st.lists(_PARTICLE, min_size=1, max_size=3)
    return st.one_of(
        _optional({"name": st.just(name), "particles": clusters}, **_PLACE),
        _optional({"name": st.just(name), "inertia": _INERTIA}, **_PLACE),
    )


def _joint(name: str, kind: str) -> st.SearchStrategy[Table]:
    required = {"name": st.just(name), "kind": st.just(kind), "anchor": _VECTOR}
    if kind in ("ball", "fixed"):
        return _optional(required)
    start = st.floats(-6, 6)
    return _optional(required | {"axis": _AXIS}, start=start, rate=_FINITE)


def _draws(names: list[str], hinges: list[str]) -> st.SearchStrategy[Table]:
    some_hinges = st.lists(st.sampled_from(hinges), min_size=1, unique=True)
    return st.one_of(
        _optional(
            {"kind": st.just("swing"), "bodies": st.just(names), "polar": _SPAN, "speed": _SPAN}
        ),
        _optional(
            {"kind": st.just("turn"), "point": _VECTOR, "axis": _AXIS, "angle": _SPAN}
            | {"rate": _SPAN}
        ),
        _optional(
            {"kind": st.just("throw"), "body": st.sampled_from(names)},
            displacement=_SPANS,
            orientation=st.sampled_from(["reference", "about_y", "uniform"]),
            velocity=_SPANS,
            angular_velocity=_SPANS,
        ),
        _optional(
            {"kind": st.just("roll"), "body": st.sampled_from(names), "share": _SPAN},
        ),
        _optional({"kind": st.just("pose"), "joints": some_hinges, "coordinate": _SPAN}),
        _optional(
            {"kind": st.just("hinge_rate"), "joints": some_hinges, "rate": _SPAN},
            travel=_VECTOR,
        ),
        _optional(
            {"kind": st.just("hinge_torque"), "joints": some_hinges, "torque": _SPAN},
            hold=st.integers(1, 50),
            random_sign=st.booleans(),
        ),
        _optional(
            {"kind": st.just("wind"), "mean": _SPAN},
            deviation=st.floats(0, 9),
            correlation_time=_POSITIVE,
        ),
    )


def _table(
    names: list[str], hinges: list[str], pair: st.SearchStrategy[Any], grounded: bool
) -> st.SearchStrategy[Table]:
    """Draw all of a scene except bodies and joints."""
    ends = {"bodies": pair, "points": _TWO_POINTS}
    sphere = _optional({"body": st.sampled_from(names), "center": _VECTOR, "radius": _POSITIVE})
    contact = {
        "contacts": st.lists(sphere, min_size=1, max_size=2),
        "ground": _optional({"friction": _POSITIVE, "restitution": st.floats(0, 1)}),
    }
    vectors = st.lists(_VECTOR, min_size=1, max_size=3)
    return _optional(
        {"name": _NAME, "length": _POSITIVE} | (contact if grounded else {}),
        description=st.text(),
        source=st.text(),
        dimension=st.sampled_from([1, 2, 3]),
        gravity=_VECTOR,
        distance_links=st.lists(_optional({"name": _NAME, **ends}, length=_POSITIVE), max_size=1),
        springs=st.lists(
            _optional(
                {"name": _NAME, **ends},
                stiffness=_POSITIVE,
                damping=_POSITIVE,
                rest_length=_POSITIVE,
            ),
            max_size=1,
        ),
        forces=st.lists(
            _optional({"body": st.sampled_from(names), "series": vectors}, hold=st.integers(1, 9)),
            max_size=2,
        ),
        torques=st.lists(
            _optional(
                {
                    "joint": st.sampled_from(hinges),
                    "series": st.lists(_FINITE, min_size=1, max_size=3),
                },
                hold=st.integers(1, 9),
            ),
            max_size=2,
        ),
        clock=_optional({}, frame=_POSITIVE, steps=st.integers(1, 1000)),
        sampling=st.lists(_draws(names, hinges), max_size=3),
        noise=st.floats(0, 10),
        anchors=vectors,
        budget=_optional({}, error=_POSITIVE, gap=_POSITIVE, planarity=_POSITIVE),
    )


@st.composite
def _scenes(draw: st.DrawFn) -> Table:
    """Draw any scene that the structs accept, as the tables of a file."""
    names = draw(st.lists(_NAME, min_size=2, max_size=4, unique=True))
    pair = st.lists(st.sampled_from([*names, "world"]), min_size=2, max_size=2, unique=True)
    hinges = draw(st.lists(_NAME, min_size=1, max_size=3, unique=True))

    def joined(table: Table) -> Table:
        table["parent"], table["child"] = draw(pair)
        return table

    others = draw(st.lists(_NAME.filter(lambda n: n not in hinges), max_size=3, unique=True))
    joints = [draw(_joint(name, "hinge")) for name in hinges]
    joints += [
        draw(_joint(name, draw(st.sampled_from(["fixed", "ball", "slider"])))) for name in others
    ]
    bodies = [draw(_body(name)) for name in names]
    table = _table(names, hinges, pair, draw(st.booleans()))
    return draw(table) | {"bodies": bodies, "joints": [joined(table) for table in joints]}


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(_scenes())
def test_any_scene_survives_the_file(tables: Table) -> None:
    import tomllib

    scene = msgspec.convert(tables, Scene)

    text = write_scene(scene)
    again = msgspec.convert(tomllib.loads(text), Scene)

    assert again == scene
    assert all(line == line.rstrip() for line in text.splitlines() if '"' not in line)


@pytest.mark.parametrize("name", [*scene_names(), "1pendulum", "9pendulum", "1ladder"])
def test_every_built_in_scene_survives_the_file(name: str, tmp_path: Path) -> None:
    scene = load_scene(name)

    save_scene(scene, tmp_path / "scene.toml")

    assert read_scene(tmp_path / "scene.toml") == scene


def test_short_arrays_take_one_line() -> None:
    lines = write_scene(load_scene("2ladder")).splitlines()

    assert "anchors = [[0.0, -0.3, 0.0], [0.0, 0.3, 0.0]]" in lines
    assert max(map(len, lines)) <= 100
