"""Views of results without a reader of their own: every number is a figure, named by its place."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from mbds_xsim.studies.diff import FAILING, Entry, PhysicalFigure, Value, View

_ABOUT = ("scene", "scenes", "study")
_SAMPLE = ("seed", "trajectories", "index", "budget", "limit_s", "duration_s", "length_m")
_CIRCUMSTANCES = ("versions", "machine", "workers")
_TIMINGS = re.compile(r"wall|cpu|core|setup|elapsed|rate|seconds|bytes|_mb\b|_per_s\b|^cost_s\b")
"""Pattern of the names of figures that the machine decides."""
_DECIMAL = re.compile(r"-?\d{1,15}(\.\d{1,20})?(e[+-]\d{1,3})?")
_REASONS = ("reasons", "reason", "failures", "left_out")
_NO_LABEL = (*_REASONS, "verdict", "note", "content")
"""Texts that are results, or made of results, so that they do not tell which record it is."""


def plain_view(parts: list[Any]) -> View:
    """Make a view of any command's result, with an entry for each record, named by its texts."""
    part = parts[0] if len(parts) == 1 else {"result": parts}
    scene = next((str(part[key]) for key in _ABOUT if part.get(key)), "all")
    rest = {key: part[key] for key in part if key not in (*_ABOUT, "schema", "command", "note")}
    return View(
        scene=scene,
        command=str(part.get("command", "")),
        sample=dict(_leaves({key: rest.pop(key) for key in _SAMPLE if key in rest})),
        circumstances=dict(_leaves({key: rest.pop(key) for key in _CIRCUMSTANCES if key in rest})),
        entries=dict(_entries("", rest)),
    )


def _entries(name: str, record: Mapping[str, Any]) -> Iterator[tuple[str, Entry]]:
    """Make an entry of a record's own leaves, then of the records in it."""
    inner = {key: value for key, value in record.items() if _holds_records(value)}
    own = {key: value for key, value in record.items() if key not in inner}
    if own:
        yield name or "result", _entry(own)
    for key, value in inner.items():
        records = value.items() if isinstance(value, dict) else _label_records(value)
        for label, one in records:
            yield from _entries(" ".join(filter(None, (name, key, str(label)))), one)


def _holds_records(value: Any) -> bool:
    if not isinstance(value, dict | list) or not value:
        return False
    return all(isinstance(v, dict) for v in (value.values() if isinstance(value, dict) else value))


def _label_records(records: list[dict[str, Any]]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Label records by their texts if these are unique, or else by their position."""
    labels = [
        " ".join(v for k, v in record.items() if isinstance(v, str) and k not in _NO_LABEL)
        for record in records
    ]
    unique = len(set(labels)) == len(labels)
    for place, (label, one) in enumerate(zip(labels, records, strict=True)):
        yield label if unique and label else str(place), one


def _entry(own: Mapping[str, Any]) -> Entry:
    leaves = dict(_leaves({key: own[key] for key in own if key not in _REASONS}))
    passed = own.get("passed", own.get("ok"))
    failed = passed is False or own.get("verdict") == "fail"
    numbers = {k: float(v) for k, v in leaves.items() if v is not None and _is_number(v)}
    return Entry(
        verdict=str(own.get("verdict", "" if passed is None else "pass" if passed else "fail")),
        rank=FAILING * failed if passed is not None or "verdict" in own else None,
        settings={k: v for k, v in leaves.items() if k not in numbers and k != "verdict"},
        reasons=tuple(str(v) for k, v in _leaves({k: own[k] for k in own if k in _REASONS}) if v),
        figures={k: PhysicalFigure(v) for k, v in numbers.items() if not _TIMINGS.search(k)},
        timings={k: v for k, v in numbers.items() if _TIMINGS.search(k)},
    )


def _is_number(value: Value) -> bool:
    """Return whether a value is a number, or text of one: facts of models are texts."""
    if isinstance(value, str):
        return _DECIMAL.fullmatch(value) is not None
    return isinstance(value, int | float) and not isinstance(value, bool)


def _leaves(tree: object, name: str = "") -> Iterator[tuple[str, Value]]:
    if isinstance(tree, dict | list):
        pairs = tree.items() if isinstance(tree, dict) else enumerate(tree)
        for key, value in pairs:
            yield from _leaves(value, f"{name} {key}".lstrip())
    elif isinstance(tree, str | int | float | bool | None):
        yield name, tree
