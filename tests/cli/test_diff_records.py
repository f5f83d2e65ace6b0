"""Comparison of results of any command, record by record."""

from __future__ import annotations

import pytest

from tests.cli.stored import Compare, Json


def _audit() -> Json:
    cases = [
        {"start": f"trajectory {i}", "verdict": "pass", "reasons": [], "gap_m": 1e-6 * (i + 1)}
        for i in range(3)
    ]
    return {"schema": "mbds-xsim/audit/1", "scene": "3ladder", "seed": 0, "cases": cases}


def test_results_of_any_command_are_compared(compare: Compare) -> None:
    def edit(new: Json) -> None:
        new["cases"][1].update(verdict="fail", reasons=["gap: 1 mm, allowed 0.1 mm"], gap_m=1e-3)
        del new["cases"][2]

    ended, result = compare(_audit(), edit)

    (scene,) = result["scenes"]
    assert (ended.code, scene["scene"], result["verdict"]) == (1, "3ladder", "worse")
    (entry,) = scene["entries"]
    assert entry["name"] == "cases trajectory 1"
    assert entry["figures"] == [
        {"what": "gap_m", "unit": "1", "old": 2e-6, "new": 1e-3, "ratio": pytest.approx(500)}
    ]
    assert entry["reasons_new"] == ["gap: 1 mm, allowed 0.1 mm"]
    assert [one["name"] for one in scene["only_old"]] == ["cases trajectory 2"]
    assert compare(_audit(), lambda _: None)[1]["verdict"] == "same"
    exported = _audit() | {"schema": "mbds-xsim/export-model/1"}
    assert compare(exported, lambda _: None)[1]["verdict"] == "same"


def _records(command: str, place: str, *records: Json) -> Json:
    return {"schema": f"mbds-xsim/{command}/1", place: list(records)}


_ABLATED = {"effect": "joint friction", "factor": 0.0, "verdict": "needed", "change_m": 1e-3}
_ABLATED |= {"sentence": "motion changes by 1.8 × the floor"}
_REBOUND: Json = {"engine": "dart", "profile": "native", "quantity": "spin", "value": 49.7}
_REBOUND |= {"at": {"speed": 1.0}, "note": "silent at 10 rad/s: 9.8"}
_RELEASED = {"key": "0a", "release": "1.0", "case": "pair", "way": "native", "error_m": 1e-3}
_STEP = {"release": "1.0", "name": "pair", "what": "gap", "new": 1e-3, "explanation": "a"}
_NAMED: dict[str, tuple[Json, Json]] = {
    "ablate": (_records("ablate", "rows", _ABLATED), {"sentence": "9 × the floor", "change_m": 1}),
    "contact": (_records("contact", "figures", _REBOUND), {"note": "silent", "value": None}),
    "releases": (_records("releases", "rows", _RELEASED), {"key": "0b", "error_m": 1.0}),
    "releases steps": (_records("releases", "steps", _STEP), {"explanation": "", "new": 1.0}),
}


@pytest.mark.parametrize("kind", _NAMED)
def test_records_keep_their_names_where_results_change(compare: Compare, kind: str) -> None:
    result, edit = _NAMED[kind]
    place = list(result)[-1]

    _, diff = compare(result, lambda new: new[place][0].update(edit))

    (scene,) = diff["scenes"]
    (entry,) = scene["entries"]
    assert (diff["verdict"], scene["only_old"], scene["only_new"]) == ("changed", [], [])
    assert [figure["what"] for figure in entry["figures"]] == [list(edit)[-1]]


def test_records_are_told_apart_by_name_where_some_are_gone(compare: Compare) -> None:
    fast = _REBOUND | {"at": {"speed": 2.0}}
    other = _REBOUND | {"engine": "mujoco"}
    result = _records("contact", "figures", other, _REBOUND, fast)

    _, diff = compare(result, lambda new: new["figures"].pop(0))

    (scene,) = diff["scenes"]
    assert scene["entries"] == []
    assert [one["name"] for one in scene["only_old"]] == ["figures mujoco native spin speed 1.0"]


def test_a_stored_key_is_no_result(compare: Compare) -> None:
    result = _records("releases", "rows", _RELEASED)

    assert compare(result, lambda new: new["rows"][0].update(key="0b"))[1]["verdict"] == "same"


def test_flags_are_words_and_only_times_are_in_seconds(compare: Compare) -> None:
    record = {"passed": True, "closed": True, "bytes": 1000, "wall_s": 1.0}
    result = {"schema": "mbds-xsim/audit/1", "cases": [record]}

    _, diff = compare(
        result, lambda new: new["cases"][0].update(passed=False, bytes=5000, wall_s=9.0)
    )

    (entry,) = diff["scenes"][0]["entries"]
    assert entry["settings"] == [{"what": "passed", "old": True, "new": False}]
    assert entry["figures"] == []
    assert {one["what"]: one["unit"] for one in entry["timings"]} == {"bytes": "1", "wall_s": "s"}
