"""Comparison of results of any command, record by record, and of what studies judge."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.cli import stored
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


_STEP: Json = {
    "release": "1.0",
    "before": "0.9",
    "name": "pair, native",
    "what": "gap",
    "unit": "m",
}
_STEP |= {"old": 1e-6, "new": 1e-3, "factor": 1e3, "course": "worse"}
_MISSING = {"engine": "dart", "profile": "native", "part": "cost", "reason": "crashed"}
_WORSE: dict[str, tuple[Json, Callable[[Json], Any], list[str]]] = {
    "engine fails": (
        stored.ablation(),
        lambda new: new["failed"].update(dart="gap: 1 mm"),
        ["dart: pass → fail"],
    ),
    "engine is left out": (
        stored.ablation(),
        lambda new: new.update(floor_engines=["mujoco"], left_out={"dart": "no"}),
        ["dart: was pass, is left out now: no"],
    ),
    "rebound": (
        stored.contact(),
        lambda new: new["figures"][1].update(value=0.48),
        ["dart native restitution, restitution 0.5, speed 2: as asked → not as asked"],
    ),
    "silence": (
        stored.contact(),
        lambda new: new["figures"][2].update(note="silent at 10 rad/s: 9"),
        ["dart native free spin: as asked → not as asked"],
    ),
    "another part is lost": (
        stored.contact() | {"missing": [_MISSING]},
        lambda new: new["missing"].append(_MISSING | {"part": "energy"}),
        ["dart native: lacks cost → lacks cost, energy"],
    ),
    "row is lost": (
        stored.history(),
        lambda new: new["rows"][0].update(kind="crashed", error_m=None),
        ["release 1.0, pair, native: done → crashed"],
    ),
    "step to the worse": (
        stored.history(),
        lambda new: new["steps"].append(_STEP),
        ["newest release: pass → fail"],
    ),
}


@pytest.mark.parametrize("kind", _WORSE)
def test_what_a_study_marks_is_worse(compare: Compare, kind: str) -> None:
    result, edit, worse = _WORSE[kind]

    ended, diff = compare(result, edit)

    assert (ended.code, diff["scenes"][0]["worse"]) == (1, worse)
    assert compare(result, lambda _: None)[1]["verdict"] == "same"


@pytest.mark.parametrize(
    ("result", "edit", "entry"),
    [
        (stored.ablation(), lambda new: new["rows"][1].update(change_1s_m=9.0), "noise × 0.5"),
        (stored.ablation(), lambda new: new["rows"][0].update(verdict="not needed"), "noise × 0"),
        (
            stored.contact(),
            lambda new: new["figures"][0].update(value=0.501),
            "dart native restitution, restitution 0.5, speed 1",
        ),
        (
            stored.history(),
            lambda new: new["rows"][0].update(error_m=9.0),
            "release 1.0, pair, native",
        ),
    ],
)
def test_figures_that_a_study_does_not_judge_only_change(
    compare: Compare, result: Json, edit: Callable[[Json], Any], entry: str
) -> None:
    ended, diff = compare(result, edit)

    assert (ended.code, diff["verdict"]) == (0, "changed")
    assert [one["name"] for one in diff["scenes"][0]["entries"]] == [entry]


def test_parts_without_an_answer_in_time_make_no_engine_worse(compare: Compare) -> None:
    late = _MISSING | {"reason": "no answer within 60 s"}

    def all_late(new: Json) -> None:
        new.update(figures=[], missing=[late, late | {"part": "impacts"}])

    _, diff = compare(stored.contact(), lambda new: new["missing"].append(late))
    whole = compare(stored.contact(), all_late)[1]
    crashed = compare(
        stored.contact(), lambda new: new["missing"].extend((late, _MISSING | {"part": "rest"}))
    )[1]

    (entry,) = diff["scenes"][0]["entries"]
    assert (diff["verdict"], entry["new_verdict"]) == ("changed", "lacks cost")
    assert (whole["verdict"], whole["scenes"][0]["worse"]) == ("changed", [])
    assert crashed["scenes"][0]["worse"] == ["dart native: complete → lacks cost, rest"]


@pytest.mark.parametrize(("reason", "worse"), [("no answer within 120 s", 0), ("crashed", 2)])
def test_a_release_that_is_not_driven_in_time_is_no_worse(
    compare: Compare, reason: str, worse: int
) -> None:
    _, diff = compare(stored.history(), lambda new: new["releases"][0].update(reason=reason))

    assert len(diff["scenes"][0]["worse"]) == worse


@pytest.mark.parametrize("reason", ["crash: no answer within 9 s", "crash: killed"])
def test_an_engine_of_an_ablation_that_is_late_is_no_worse(compare: Compare, reason: str) -> None:
    _, diff = compare(stored.ablation(), lambda new: new["failed"].update(dart=reason))

    assert diff["scenes"][0]["worse"] == ["dart: pass → fail"] * ("killed" in reason)


def test_times_and_keys_of_rows_are_no_change(compare: Compare) -> None:
    edit = compare(stored.history(), lambda new: new["rows"][0].update(key="0b", cpu_s=9.0))

    assert edit[1]["verdict"] == "same"


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


def test_a_training_that_took_another_time_is_the_same(compare: Compare) -> None:
    """Its file keeps the time, so that the checksum is another; that is a setting of one model."""
    runs = {"gns/mujoco-s0": {"steps_per_s": "50.0", "best_error": "1e-06"}}
    model = {"model": "gns", "training": "mujoco", "content": "3f"}
    domain = {"engine": "mujoco", "cost_s": 0.002}
    result = {"schema": "mbds-xsim/shift/1", "runs": runs, "models": [model], "domains": [domain]}

    def edit(new: Json) -> None:
        new["runs"]["gns/mujoco-s0"]["steps_per_s"] = "100.0"
        new["domains"][0]["cost_s"] = 0.009

    _, diff = compare(result, edit)
    assert diff["verdict"] == "same"
    (scene,) = diff["scenes"]
    units = {one["what"]: one["unit"] for entry in scene["entries"] for one in entry["timings"]}
    assert units == {"steps_per_s": "1", "cost_s": "s"}

    _, diff = compare(result, lambda new: new["models"][0].update(content="4a"))
    (entry,) = diff["scenes"][0]["entries"]
    assert (entry["name"], entry["settings"]) == (
        "models gns mujoco",
        [{"what": "content", "old": "3f", "new": "4a"}],
    )
