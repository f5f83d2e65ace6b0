"""Comparison of two results: worse, merely different, and not comparable."""

from __future__ import annotations

import copy
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from mbds_xsim.commands.shared import command_line
from mbds_xsim.report.files import results_json
from mbds_xsim.studies.diff.read import READERS
from mbds_xsim.studies.tradeoff import ModelResult, Point, Ratio
from tests.results import curve, found, matched, survey, tradeoff

CommandLine = Callable[..., Any]
Json = dict[str, Any]
Edit = Callable[[Json], None]

_KEPT = Path(__file__).parents[2] / "reports" / "3ladder.json"


def _validation() -> Json:
    return json.loads(_KEPT.read_text())


def _engine(result: Json, name: str) -> Json:
    return next(engine for engine in result["engines"] if engine["engine"] == name)


def _finding(result: Json, engine: str, check: str) -> Json:
    return next(f for f in _engine(result, engine)["findings"] if f["check"] == check)


def _tradeoff() -> Json:
    plain = Point(steps_per_frame=2, step_s=0.01, kind="done", error_m=1e-4, wall_s=0.01)
    far = {"steps_per_frame": 1, "step_s": 0.02, "error_m": 1e-2, "broken": ("gap",)}
    points = (msgspec.structs.replace(plain, **far), plain)
    study = tradeoff(
        *(curve("mujoco", method, *points, measured_order=4.0) for method in ("RK4", "Euler")),
        ratios=(Ratio(error_m=1e-3, budget=True, wall_s=(0.01, 0.1), best=0),),
        measured=2,
    )
    return json.loads(results_json([study]))


def _match() -> Json:
    return json.loads(msgspec.json.encode(matched(found())))


def _stability() -> Json:
    return json.loads(results_json([survey()]))


_RESULTS = {
    "validate": _validation,
    "tradeoff": _tradeoff,
    "match": _match,
    "stability": _stability,
}


@pytest.fixture
def compare(run: CommandLine, here: Path) -> CommandLine:
    """Return a function that compares a result with an edited copy: its outcome and the JSON."""

    def call(result: Json, edit: Edit, *words: str) -> tuple[Any, Json]:
        other = copy.deepcopy(result)
        edit(other)
        (here / "old.json").write_text(json.dumps(result))
        (here / "new.json").write_text(json.dumps(other))
        ended = run("diff", "old.json", "new.json", "--json", "diff.json", *words)
        output = here / "diff.json"
        return ended, json.loads(output.read_text()) if output.exists() else {}

    return call


@pytest.mark.parametrize("kind", _RESULTS)
def test_a_result_is_the_same_as_itself(compare: CommandLine, kind: str) -> None:
    ended, result = compare(_RESULTS[kind](), lambda _: None)

    assert (ended.code, result["verdict"]) == (0, "same")
    (scene,) = result["scenes"]
    assert scene["entries"] == []
    assert scene["unchanged"] > 0


def test_every_schema_is_tried() -> None:
    assert {make()["schema"] for make in _RESULTS.values()} == set(READERS)


def _failed(result: Json) -> None:
    _engine(result, "mujoco")["verdict"] = "fail"
    _engine(result, "mujoco")["reasons"] = ["gap: 0.2 mm, allowed 0.1 mm (rung)"]
    _finding(result, "mujoco", "gap")["passed"] = False


def test_a_pass_that_fails_is_worse(compare: CommandLine) -> None:
    ended, result = compare(_validation(), _failed)

    assert ended.code == 1
    assert result["verdict"] == "worse"
    assert result["scenes"][0]["worse"] == [
        "mujoco matched: pass → fail",
        "mujoco matched: gap no longer keeps its budget",
    ]
    (entry,) = result["scenes"][0]["entries"]
    assert entry["reasons_new"] == ["gap: 0.2 mm, allowed 0.1 mm (rung)"]
    assert "WORSE" in ended.out


def test_a_fail_that_passes_is_better(compare: CommandLine) -> None:
    bad = _validation()
    _failed(bad)

    def repaired(result: Json) -> None:
        result["engines"] = _validation()["engines"]

    ended, result = compare(bad, repaired)

    assert (ended.code, result["verdict"]) == (0, "changed")
    assert result["scenes"][0]["better"] == [
        "mujoco matched: fail → pass",
        "mujoco matched: gap keeps its budget now",
    ]
    assert result["scenes"][0]["entries"][0]["reasons_gone"]


def test_a_budget_lost_is_worse_where_the_verdict_is_not(compare: CommandLine) -> None:
    bad = _validation()
    _failed(bad)

    def another(result: Json) -> None:
        _finding(result, "mujoco", "energy")["passed"] = False

    ended, result = compare(bad, another)

    assert ended.code == 1
    assert result["scenes"][0]["worse"] == ["mujoco matched: energy no longer keeps its budget"]


@pytest.mark.parametrize(("part", "shown"), [(0.9e-6, False), (1.1e-6, True)])
def test_figures_of_physics_are_compared_closely(
    compare: CommandLine, part: float, shown: bool
) -> None:
    def other(result: Json) -> None:
        error = _finding(result, "dart", "error at 1 s")
        error["figure"] += part * error["budget"]  # the budget is larger than the figure
        _finding(result, "dart", "start")["figure"] *= 7  # rounding, far below what is allowed

    ended, result = compare(_validation(), other)

    assert ended.code == 0
    changed = [figure for entry in result["scenes"][0]["entries"] for figure in entry["figures"]]
    assert [figure["what"] for figure in changed] == (["error at 1 s"] if shown else [])
    assert result["verdict"] == ("changed" if shown else "same")


@pytest.mark.parametrize(("factor", "shown"), [(1.4, False), (1.6, True), (0.5, True)])
def test_times_are_apart_and_never_worse(compare: CommandLine, factor: float, shown: bool) -> None:
    def slower(result: Json) -> None:
        _engine(result, "exudyn")["wall_per_simulated_s"] *= factor

    ended, result = compare(_validation(), slower)

    assert (ended.code, result["verdict"]) == (0, "same")
    times = [time for entry in result["scenes"][0]["entries"] for time in entry["timings"]]
    assert [time["ratio"] for time in times] == ([pytest.approx(factor)] if shown else [])


def test_figures_that_are_missing_now_are_told(compare: CommandLine) -> None:
    def gone(result: Json) -> None:
        _finding(result, "dart", "energy")["figure"] = None
        _engine(result, "dart")["agreement_time_s"] = 0.5

    _, result = compare(_validation(), gone)

    (entry,) = result["scenes"][0]["entries"]
    assert [(figure["what"], figure["ratio"]) for figure in entry["figures"]] == [
        ("energy", None),
        ("agreement time", None),
    ]


def test_reasons_with_other_numbers_are_the_same_reasons(compare: CommandLine) -> None:
    bad = _validation()
    _failed(bad)

    def moved(result: Json) -> None:
        _engine(result, "mujoco")["reasons"] = ["gap: 340 µm, allowed 0.1 mm (side)"]

    _, result = compare(bad, moved)

    assert result["scenes"][0]["entries"] == []


def test_settings_versions_and_starts_are_told(compare: CommandLine) -> None:
    def other(result: Json) -> None:
        _engine(result, "mujoco").update(version="5.0.0", step_s=0.004)
        result["versions"]["mujoco"] = "5.0.0"
        result["seed"] = 2

    ended, result = compare(_validation(), other)

    (scene,) = result["scenes"]
    assert [change["what"] for change in scene["entries"][0]["settings"]] == ["version", "step [s]"]
    assert scene["circumstances"] == [{"what": "mujoco", "old": "4.0.0", "new": "5.0.0"}]
    assert scene["sample"] == [{"what": "seed", "old": 1, "new": 2}]
    assert "not the same question: seed 1 → 2" in " ".join(ended.out.split())


@pytest.mark.parametrize(("left_out", "code"), [({}, 0), ({"mujoco": "mujoco cannot do it"}, 1)])
def test_an_engine_left_out_is_worse_than_one_not_asked(
    compare: CommandLine, left_out: dict[str, str], code: int
) -> None:
    def without(result: Json) -> None:
        result["engines"] = [e for e in result["engines"] if e["engine"] != "mujoco"]
        result["left_out"] = left_out

    ended, result = compare(_validation(), without)

    assert ended.code == code
    why = left_out.get("mujoco", "")
    assert result["scenes"][0]["only_old"] == [
        {"name": "mujoco matched", "verdict": "pass", "why": why}
    ]


def test_a_point_of_a_curve_over_budget_is_worse(compare: CommandLine) -> None:
    def worse(result: Json) -> None:
        result["curves"][0]["points"][1].update(broken=["error at 1 s"], error_m=5e-3)

    ended, result = compare(_tradeoff(), worse)

    assert ended.code == 1
    assert result["scenes"][0]["worse"] == [
        "mujoco RK4: keeps all budgets → keeps them at no step",
        "mujoco RK4, 0.01 s: all budgets kept → over budget",
        "mujoco RK4, 0.01 s: error at 1 s no longer keeps its budget",
    ]


def test_a_point_too_slow_is_not_worse(compare: CommandLine) -> None:
    def slow(result: Json) -> None:
        result["curves"][0]["points"][0].update(kind="too slow", broken=[], error_m=None)

    ended, result = compare(_tradeoff(), slow)

    assert (ended.code, result["verdict"]) == (0, "changed")


def test_a_curve_that_is_gone_is_one_line(compare: CommandLine) -> None:
    _, result = compare(_tradeoff(), lambda study: study["curves"].pop())

    assert [one["name"] for one in result["scenes"][0]["only_old"]] == ["mujoco Euler"]


def test_matched_settings_that_fail_are_worse(compare: CommandLine) -> None:
    def worse(result: Json) -> None:
        result["engines"][0].update(
            meets_budget=False, reasons=["gap: 1 mm"], cpu_per_simulated_s=None
        )

    ended, result = compare(_match(), worse)

    assert ended.code == 1
    assert result["scenes"][0]["worse"] == ["mujoco: keeps all budgets → over budget"]


def test_a_cell_that_is_stable_no_more_is_worse(compare: CommandLine) -> None:
    def worse(data: Json) -> None:
        data["panels"][0]["cells"][0][0].update(outcome="blows up", broke_s=0.3)

    ended, data = compare(_stability(), worse)

    assert ended.code == 1
    assert data["scenes"][0]["worse"] == ["mujoco RK4, spin 10.0 rad/s, 0.01 s: stable → blows up"]


def test_a_cell_that_times_out_is_not_worse(compare: CommandLine) -> None:
    def slower(data: Json) -> None:
        data["panels"][0]["cells"][0][0].update(outcome="timed out")

    ended, data = compare(_stability(), slower)

    assert (ended.code, data["verdict"], data["scenes"][0]["worse"]) == (0, "changed", [])


def test_lists_are_compared_scene_by_scene(run: CommandLine, here: Path) -> None:
    one, other = _tradeoff(), _tradeoff() | {"scene": "other"}
    (here / "old.json").write_text(json.dumps([one, other]))
    (here / "new.json").write_text(json.dumps(other))

    ended = run("diff", "old.json", "new.json", "--json", "diff.json", "--markdown", "diff.md")

    assert ended.code == 0
    assert "scenes only in the old one: pair" in ended.out
    assert "- scenes only in the old one: pair\n" in (here / "diff.md").read_text()
    assert json.loads((here / "diff.json").read_text())["verdict"] == "changed"


def test_markdown_has_it_all(compare: CommandLine, here: Path) -> None:
    compare(_validation(), _failed, "--markdown", "diff.md")

    text = (here / "diff.md").read_text()
    assert text.startswith("# 3ladder: worse\n")
    assert "| **mujoco matched** | **verdict** | **pass** | **fail** | **worse** |" in text
    assert "- **worse: mujoco matched: gap no longer keeps its budget**" in text


def test_the_command_that_is_told_compares_again(run: CommandLine, here: Path) -> None:
    (here / "old one.json").write_text(json.dumps(_match()))
    (here / "new.json").write_text(json.dumps(_match()))

    run("diff", "old one.json", "new.json", "--factor", "3", "--markdown", "diff.md")

    assert "`mbds-xsim diff 'old one.json' new.json --factor 3.0`" in (here / "diff.md").read_text()


_FILES: dict[str, tuple[bytes, str]] = {
    "missing": (b"", "cannot read new.json: No such file"),
    "empty": (b" ", "is not JSON, or was cut short"),
    "truncated": (_KEPT.read_bytes()[:-100], "is not JSON, or was cut short"),
    "not text": (b"\x89PNG\r\n\x1a\n\xff\xfe", "is not JSON, or was cut short"),
    "nested without end": (b"[" * 100_000, "is not JSON, or was cut short"),
    "foreign": (b'{"name": "x"}', "has no schema; compared are mbds-xsim/<command>/1"),
    "a number": (b"3", "has no schema"),
    "an empty list": (b"[]", "holds an empty list"),
    "a schema of later": (b'{"schema": "mbds-xsim/validate/2"}', "schema 'mbds-xsim/validate/2'"),
    "a schema of no text": (b'{"schema": [1]}', "schema [1]"),
    "hollow": (b'{"schema": "mbds-xsim/validate/1"}', "missing required field `scene`"),
    "a number beyond all": (
        b'{"schema": "mbds-xsim/audit/1", "gap_m": 1' + b"0" * 400 + b"}",
        "is not what mbds-xsim/audit/1 stands for: int too large",
    ),
    "another command's": (json.dumps(_match()).encode(), "give two of the same"),
}


@pytest.mark.parametrize("kind", _FILES)
def test_bad_files_are_one_line(run: CommandLine, here: Path, kind: str) -> None:
    content, message = _FILES[kind]
    if content:
        (here / "new.json").write_bytes(content)

    ended = run("diff", str(_KEPT), "new.json", "--json", "diff.json")

    assert ended.code == 2
    assert message in ended.err
    assert ended.err.count("\n") == 1
    assert not (here / "diff.json").exists()


def test_what_has_no_end_is_not_read_to_it(run: CommandLine) -> None:
    ended = run("diff", "/dev/zero", "/dev/zero")

    assert ended.code == 2
    assert ended.err == (
        "mbds-xsim: /dev/zero: got more than 100 MB, the largest results take 10 MB\n"
    )


def test_a_scene_of_other_physics_is_refused(compare: CommandLine) -> None:
    result = _match() | {"fingerprint": "a" * 16}

    other, _ = compare(result, lambda new: new.update(fingerprint="b" * 16))
    unknown, _ = compare(result, lambda new: new.update(fingerprint=""))

    assert other.code == 2
    assert "pair is not the same scene in both files: fingerprint is aaaa" in other.err
    assert unknown.code == 0


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda data: data.update(scene="2ladder"), "is about 3ladder and new.json about 2ladder"),
        (lambda data: data.update(length_m=2.0), "not the same scene in both files: length [m]"),
        (lambda data: data["engines"].append(data["engines"][0]), "has 'dart matched' twice"),
        (lambda data: data["engines"][0].update(step_s="x"), "$.engines[0].step_s"),
    ],
)
def test_other_scenes_are_refused(compare: CommandLine, edit: Edit, said: str) -> None:
    ended, data = compare(_validation(), edit)

    assert (ended.code, data) == (2, {})
    assert said in ended.err
    assert ended.err.count("\n") == 1


def _audit() -> Json:
    cases = [
        {"start": f"trajectory {i}", "verdict": "pass", "reasons": [], "gap_m": 1e-6 * (i + 1)}
        for i in range(3)
    ]
    return {"schema": "mbds-xsim/audit/1", "scene": "3ladder", "seed": 0, "cases": cases}


def test_results_of_any_command_are_compared(compare: CommandLine) -> None:
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
def test_records_keep_their_names_where_results_change(compare: CommandLine, kind: str) -> None:
    result, edit = _NAMED[kind]
    place = list(result)[-1]

    _, diff = compare(result, lambda new: new[place][0].update(edit))

    (scene,) = diff["scenes"]
    (entry,) = scene["entries"]
    assert (diff["verdict"], scene["only_old"], scene["only_new"]) == ("changed", [], [])
    assert [figure["what"] for figure in entry["figures"]] == [list(edit)[-1]]


def test_records_are_told_apart_by_name_where_some_are_gone(compare: CommandLine) -> None:
    fast = _REBOUND | {"at": {"speed": 2.0}}
    other = _REBOUND | {"engine": "mujoco"}
    result = _records("contact", "figures", other, _REBOUND, fast)

    _, diff = compare(result, lambda new: new["figures"].pop(0))

    (scene,) = diff["scenes"]
    assert scene["entries"] == []
    assert [one["name"] for one in scene["only_old"]] == ["figures mujoco native spin speed 1.0"]


def test_a_stored_key_is_no_result(compare: CommandLine) -> None:
    result = _records("releases", "rows", _RELEASED)

    assert compare(result, lambda new: new["rows"][0].update(key="0b"))[1]["verdict"] == "same"


def test_trained_models_of_a_trade_off_are_compared(compare: CommandLine) -> None:
    point = Point(steps_per_frame=1, step_s=0.02, kind="done", error_m=1e-4, wall_s=0.01)
    model = ModelResult(
        model="gns",
        training="all-s0",
        variant="matched",
        engines=("mujoco",),
        source="m.pt",
        known_frames=6,
        at_once=64,
        alone=point,
        batched=point,
    )
    result = _tradeoff() | {"models": [msgspec.to_builtins(model)]}

    def worse(study: Json) -> None:
        study["models"][0]["batched"].update(kind="failed", reason="not finite", error_m=None)

    ended, diff = compare(result, worse)

    assert ended.code == 1
    assert diff["scenes"][0]["worse"] == [
        "gns all-s0 matched, 64 at a time: all budgets kept → failed"
    ]
    _, gone = compare(result, lambda study: study["models"].pop())
    assert [one["name"] for one in gone["scenes"][0]["only_old"]] == ["gns all-s0 matched"]


def test_flags_are_words_and_only_times_are_in_seconds(compare: CommandLine) -> None:
    record = {"passed": True, "closed": True, "bytes": 1000, "wall_s": 1.0}
    result = {"schema": "mbds-xsim/audit/1", "cases": [record]}

    _, diff = compare(
        result, lambda new: new["cases"][0].update(passed=False, bytes=5000, wall_s=9.0)
    )

    (entry,) = diff["scenes"][0]["entries"]
    assert entry["settings"] == [{"what": "passed", "old": True, "new": False}]
    assert entry["figures"] == []
    assert {one["what"]: one["unit"] for one in entry["timings"]} == {"bytes": "1", "wall_s": "s"}


def test_names_of_files_that_are_no_utf_8_are_told(run: CommandLine, here: Path) -> None:
    name = os.fsdecode(b"\xff.json")
    (here / name).write_text(json.dumps(_match()))

    ended = run("diff", name, name, "--json", "diff.json", "--markdown", "diff.md")

    assert ended.code == 0
    assert json.loads((here / "diff.json").read_text())["old"] == "\\udcff.json"


def test_a_command_with_such_a_name_can_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["mbds-xsim", "validate", os.fsdecode(b"\xff.toml")])

    assert command_line().encode() == b"mbds-xsim validate '\\udcff.toml'"
