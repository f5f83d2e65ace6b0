"""Comparison of two validations: worse, merely different, and the same."""

from __future__ import annotations

from pathlib import Path

import pytest

from mbds_xsim.studies.diff.read import READERS
from tests.cli import stored
from tests.cli.stored import Compare, Json


def _engine(result: Json, name: str) -> Json:
    return next(engine for engine in result["engines"] if engine["engine"] == name)


def _finding(result: Json, engine: str, check: str) -> Json:
    return next(f for f in _engine(result, engine)["findings"] if f["check"] == check)


_RESULTS = {
    "validate": stored.validation,
    "tradeoff": stored.tradeoff,
    "match": stored.match,
    "stability": stored.stability,
    "ablate": stored.ablation,
    "contact": stored.contact,
    "releases": stored.history,
}


@pytest.mark.parametrize("kind", _RESULTS)
def test_a_result_is_the_same_as_itself(compare: Compare, kind: str) -> None:
    ended, result = compare(_RESULTS[kind](), lambda _: None)

    assert (ended.code, result["verdict"]) == (0, "same")
    (scene,) = result["scenes"]
    assert scene["entries"] == []
    assert scene["unchanged"] > 0


def test_every_schema_is_tried() -> None:
    assert {make()["schema"] for make in _RESULTS.values()} == set(READERS)


_FAILS = ("pass → fail", "gap no longer keeps its budget")


def _failed(result: Json) -> None:
    _engine(result, "mujoco")["verdict"] = "fail"
    _engine(result, "mujoco")["reasons"] = ["gap: 0.2 mm, allowed 0.1 mm (rung)"]
    _finding(result, "mujoco", "gap")["passed"] = False


def test_a_pass_that_fails_is_worse(compare: Compare) -> None:
    ended, result = compare(stored.validation(), _failed)

    assert ended.code == 1
    assert result["verdict"] == "worse"
    assert result["scenes"][0]["worse"] == [
        "mujoco matched: pass → fail",
        "mujoco matched: gap no longer keeps its budget",
    ]
    (entry,) = result["scenes"][0]["entries"]
    assert entry["reasons_new"] == ["gap: 0.2 mm, allowed 0.1 mm (rung)"]
    assert "WORSE" in ended.out


@pytest.mark.parametrize(
    ("gap", "end", "more", "worse"),
    [
        (None, "crash: no answer within 9 s", (), ()),
        (None, "crash: no answer within 9 s", ("read-back: step: got 1, want 2",), _FAILS[:1]),
        (1.0, "crash: no answer within 9 s", (), _FAILS),
        (None, "crash: killed", (), _FAILS),
    ],
)
def test_an_engine_that_is_late_is_worse_only_by_what_it_answered(
    compare: Compare, gap: float | None, end: str, more: tuple[str, ...], worse: tuple[str, ...]
) -> None:
    def late(result: Json) -> None:
        _engine(result, "mujoco").update(verdict="fail", failures=[end], reasons=[end, *more])
        finding = _finding(result, "mujoco", "gap")
        finding.update(passed=False, figures=[None, gap, *finding["figures"][2:]])

    _, result = compare(stored.validation(), late)

    assert result["scenes"][0]["worse"] == [f"mujoco matched: {line}" for line in worse]


def test_a_fail_that_passes_is_better(compare: Compare) -> None:
    bad = stored.validation()
    _failed(bad)

    def repaired(result: Json) -> None:
        result["engines"] = stored.validation()["engines"]

    ended, result = compare(bad, repaired)

    assert (ended.code, result["verdict"]) == (0, "changed")
    assert result["scenes"][0]["better"] == [
        "mujoco matched: fail → pass",
        "mujoco matched: gap keeps its budget now",
    ]
    assert result["scenes"][0]["entries"][0]["reasons_gone"]


def test_a_budget_lost_is_worse_where_the_verdict_is_not(compare: Compare) -> None:
    bad = stored.validation()
    _failed(bad)

    def another(result: Json) -> None:
        _finding(result, "mujoco", "energy")["passed"] = False

    ended, result = compare(bad, another)

    assert ended.code == 1
    assert result["scenes"][0]["worse"] == ["mujoco matched: energy no longer keeps its budget"]


@pytest.mark.parametrize(("part", "shown"), [(0.9e-6, False), (1.1e-6, True)])
def test_figures_of_physics_are_compared_closely(
    compare: Compare, part: float, shown: bool
) -> None:
    def other(result: Json) -> None:
        error = _finding(result, "dart", "error at 1 s")
        error["figure"] += part * error["budget"]  # the budget is larger than the figure
        _finding(result, "dart", "start")["figure"] *= 7  # rounding, far below what is allowed

    ended, result = compare(stored.validation(), other)

    assert ended.code == 0
    changed = [figure for entry in result["scenes"][0]["entries"] for figure in entry["figures"]]
    assert [figure["what"] for figure in changed] == (["error at 1 s"] if shown else [])
    assert result["verdict"] == ("changed" if shown else "same")


@pytest.mark.parametrize(
    ("factor", "words"),
    [(1.005, "+5.0e-03"), (1.03, "+3.0e-02"), (0.96, "-4.0e-02"), (1.2, "1.2×")],
)
def test_a_factor_that_would_read_1_is_told_as_a_difference(
    compare: Compare, here: Path, factor: float, words: str
) -> None:
    def other(result: Json) -> None:
        _finding(result, "dart", "error at 1 s")["figure"] *= factor

    compare(stored.validation(), other, "--markdown", "diff.md")

    (row,) = [
        line for line in (here / "diff.md").read_text().splitlines() if "| error at 1 s |" in line
    ]
    assert row.endswith(f"| {words} |")


@pytest.mark.parametrize(("factor", "shown"), [(1.4, False), (1.6, True), (0.5, True)])
def test_times_are_apart_and_never_worse(compare: Compare, factor: float, shown: bool) -> None:
    def slower(result: Json) -> None:
        _engine(result, "exudyn")["wall_per_simulated_s"] *= factor

    ended, result = compare(stored.validation(), slower)

    assert (ended.code, result["verdict"]) == (0, "same")
    times = [time for entry in result["scenes"][0]["entries"] for time in entry["timings"]]
    assert [time["ratio"] for time in times] == ([pytest.approx(factor)] if shown else [])


def test_figures_that_are_missing_now_are_told(compare: Compare) -> None:
    def gone(result: Json) -> None:
        _finding(result, "dart", "energy")["figure"] = None
        _engine(result, "dart")["agreement_time_s"] = 0.5

    _, result = compare(stored.validation(), gone)

    (entry,) = result["scenes"][0]["entries"]
    assert [(figure["what"], figure["ratio"]) for figure in entry["figures"]] == [
        ("energy", None),
        ("agreement time", None),
    ]


def test_reasons_with_other_numbers_are_the_same_reasons(compare: Compare) -> None:
    bad = stored.validation()
    _failed(bad)

    def moved(result: Json) -> None:
        _engine(result, "mujoco")["reasons"] = ["gap: 340 µm, allowed 0.1 mm (side)"]

    _, result = compare(bad, moved)

    assert result["scenes"][0]["entries"] == []


def test_settings_versions_and_starts_are_told(compare: Compare) -> None:
    def other(result: Json) -> None:
        _engine(result, "mujoco").update(version="5.0.0", step_s=0.004)
        result["versions"]["mujoco"] = "5.0.0"
        result["seed"] = 2

    ended, result = compare(stored.validation(), other)

    (scene,) = result["scenes"]
    assert [change["what"] for change in scene["entries"][0]["settings"]] == ["version", "step [s]"]
    assert scene["circumstances"] == [{"what": "mujoco", "old": "4.0.0", "new": "5.0.0"}]
    assert scene["sample"] == [{"what": "seed", "old": 1, "new": 2}]
    assert "not the same question: seed 1 → 2" in " ".join(ended.out.split())


@pytest.mark.parametrize(("left_out", "code"), [({}, 0), ({"mujoco": "mujoco cannot do it"}, 1)])
def test_an_engine_left_out_is_worse_than_one_not_asked(
    compare: Compare, left_out: dict[str, str], code: int
) -> None:
    def without(result: Json) -> None:
        result["engines"] = [e for e in result["engines"] if e["engine"] != "mujoco"]
        result["left_out"] = left_out

    ended, result = compare(stored.validation(), without)

    assert ended.code == code
    why = left_out.get("mujoco", "")
    assert result["scenes"][0]["only_old"] == [
        {"name": "mujoco matched", "verdict": "pass", "why": why}
    ]


def test_markdown_has_it_all(compare: Compare, here: Path) -> None:
    compare(stored.validation(), _failed, "--markdown", "diff.md")

    text = (here / "diff.md").read_text()
    assert text.startswith("# 3ladder: worse\n")
    assert "| **mujoco matched** | **verdict** | **pass** | **fail** | **worse** |" in text
    assert "- **worse: mujoco matched: gap no longer keeps its budget**" in text
