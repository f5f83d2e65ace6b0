"""Comparison of two studies: trade-offs, matched settings and maps of stability."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec

from mbds_xsim.studies.tradeoff import ModelResult, Point
from tests.cli import stored
from tests.cli.stored import Compare, Json
from tests.command_line import CommandLine


def test_a_point_of_a_curve_over_budget_is_worse(compare: Compare) -> None:
    def worse(result: Json) -> None:
        result["curves"][0]["points"][1].update(broken=["error at 1 s"], error_m=5e-3)

    ended, result = compare(stored.tradeoff(), worse)

    assert ended.code == 1
    assert result["scenes"][0]["worse"] == [
        "mujoco RK4: keeps all budgets → keeps them at no step",
        "mujoco RK4, 0.01 s: all budgets kept → over budget",
        "mujoco RK4, 0.01 s: error at 1 s no longer keeps its budget",
    ]


def test_a_point_too_slow_is_not_worse(compare: Compare) -> None:
    def slow(result: Json) -> None:
        result["curves"][0]["points"][0].update(kind="too slow", broken=[], error_m=None)

    ended, result = compare(stored.tradeoff(), slow)

    assert (ended.code, result["verdict"]) == (0, "changed")


def test_a_curve_that_is_gone_is_one_line(compare: Compare) -> None:
    _, result = compare(stored.tradeoff(), lambda study: study["curves"].pop())

    assert [one["name"] for one in result["scenes"][0]["only_old"]] == ["mujoco Euler"]


def test_matched_settings_that_fail_are_worse(compare: Compare) -> None:
    def worse(result: Json) -> None:
        result["engines"][0].update(
            meets_budget=False, reasons=["gap: 1 mm"], cpu_per_simulated_s=None
        )

    ended, result = compare(stored.match(), worse)

    assert ended.code == 1
    assert result["scenes"][0]["worse"] == ["mujoco: keeps all budgets → over budget"]


def test_a_cell_that_is_stable_no_more_is_worse(compare: Compare) -> None:
    def worse(data: Json) -> None:
        data["panels"][0]["cells"][0][0].update(outcome="blows up", broke_s=0.3)

    ended, data = compare(stored.stability(), worse)

    assert ended.code == 1
    assert data["scenes"][0]["worse"] == ["mujoco RK4, spin 10.0 rad/s, 0.01 s: stable → blows up"]


def test_models_of_one_name_are_told_apart_by_their_files(compare: Compare) -> None:
    maps = stored.stability()
    (panel,) = maps["panels"]
    maps["panels"] = [
        panel | {"cells": [[panel["cells"][0][0] | {"source": file}]]} for file in ("a.pt", "b.pt")
    ]

    def worse(data: Json) -> None:
        data["panels"][1]["cells"][0][0].update(outcome="blows up")

    ended, data = compare(maps, worse)

    assert ended.code == 1
    name = "mujoco RK4 of b.pt, spin 10.0 rad/s, 0.01 s"
    assert data["scenes"][0]["worse"] == [f"{name}: stable → blows up"]


def test_a_cell_that_times_out_is_not_worse(compare: Compare) -> None:
    def slower(data: Json) -> None:
        data["panels"][0]["cells"][0][0].update(outcome="timed out")

    ended, data = compare(stored.stability(), slower)

    assert (ended.code, data["verdict"], data["scenes"][0]["worse"]) == (0, "changed", [])


def test_lists_are_compared_scene_by_scene(run: CommandLine, here: Path) -> None:
    one, other = stored.tradeoff(), stored.tradeoff() | {"scene": "other"}
    (here / "old.json").write_text(json.dumps([one, other]))
    (here / "new.json").write_text(json.dumps(other))

    ended = run("diff", "old.json", "new.json", "--json", "diff.json", "--markdown", "diff.md")

    assert ended.code == 0
    assert "scenes only in the old one: pair" in ended.out
    assert "- scenes only in the old one: pair\n" in (here / "diff.md").read_text()
    assert json.loads((here / "diff.json").read_text())["verdict"] == "changed"


def test_trained_models_of_a_trade_off_are_compared(compare: Compare) -> None:
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
    result = stored.tradeoff() | {"models": [msgspec.to_builtins(model)]}

    def worse(study: Json) -> None:
        study["models"][0]["batched"].update(kind="failed", reason="not finite", error_m=None)

    ended, diff = compare(result, worse)

    assert ended.code == 1
    assert diff["scenes"][0]["worse"] == [
        "gns all-s0 matched, 64 at a time: all budgets kept → failed"
    ]
    _, gone = compare(result, lambda study: study["models"].pop())
    assert [one["name"] for one in gone["scenes"][0]["only_old"]] == ["gns all-s0 matched"]
