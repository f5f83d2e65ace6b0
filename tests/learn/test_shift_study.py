"""The whole study on a tiny set: its cells, its floors, and what it holds against each other."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from mbds_xsim.base.isolate import HERE
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.dataset.shard import LOG, stage_times
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import refusal, trainable
from mbds_xsim.learn.shift import study
from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.learn.trained import Selection, find_models
from mbds_xsim.learn.window import HISTORY
from mbds_xsim.scene.scene import Body, Inertia, Joint, Scene
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.studies.shift.present import answers
from mbds_xsim.studies.shift.tables import nearness, tables
from mbds_xsim.studies.shift.worth import costs_of
from tests.learn.shifts import ENGINES, SCENE, SEEDS, STEPS, TRAININGS, shift_of, train

pytestmark = pytest.mark.usefixtures("apart")


def test_every_model_is_tested_on_every_domain(shift: Shift) -> None:
    domains = [domain.name for domain in shift.domains]
    assert domains == ["exudyn-native", "mujoco-native", "reference"]
    cells = [c for c in shift.cells if c.interval == "all"]
    trained = {(c.training, c.seed, c.test) for c in cells if c.model == "gns"}
    assert len(trained) == len(TRAININGS) * SEEDS * len(domains)
    trivial = {(c.model, c.test) for c in cells if c.training == "nothing"}
    assert len(trivial) == 3 * len(domains)
    assert {(c.training, c.test) for c in cells if c.model == "engine"} == {
        (first, test) for first in domains[:2] for test in domains if first != test
    }
    assert {c.interval for c in shift.cells} == {"all", "low", "medium", "high"}
    assert shift.frames == (1, 10)
    assert shift.horizon == STEPS + 1 - HISTORY
    assert [(g.kind, g.training, g.test) for g in shift.gaps] == [
        ("single", "exudyn-native", "mujoco-native"),
        ("single", "mujoco-native", "exudyn-native"),
        ("all", "all-native", "exudyn-native"),
        ("all", "all-native", "mujoco-native"),
    ]


def test_engine_floor_is_the_distance_of_the_data(studied: Path, shift: Shift) -> None:
    files = [load_dataset(studied / "data" / SCENE / f"{name}-native.h5") for name in ENGINES]
    one, two = (np.stack([file.position[int(r)] for r in file.rows_of("test")]) for file in files)
    apart = ((one.astype(float) - two) ** 2).sum(-1).mean(axis=(0, 2))
    floor = next(
        f for f in shift.floors
        if (f.kind, f.first, f.test, f.interval)
        == ("engine", "mujoco-native", "exudyn-native", "all")
    )  # fmt: skip
    assert floor.mse == pytest.approx(tuple(apart[[HISTORY, HISTORY + 9]]), rel=1e-6)
    gap = next(g for g in shift.gaps if g.kind == "single" and g.test == "exudyn-native")
    gone_on = next(
        f for f in shift.floors
        if (f.kind, f.first, f.test, f.interval)
        == ("restarted engine", "mujoco-native", "exudyn-native", "all")
    )  # fmt: skip
    assert gap.engine_floor == pytest.approx(gone_on.mse)
    assert not any(gap.resolved)  # untrained models are far worse than engines differ
    assert gap.noise_floor[1] is not None
    assert 0.0 < gap.noise_floor[1] < 1e-3


def test_restarted_engines_keep_their_own_motion(shift: Shift) -> None:
    """Going on from its own frame, an engine repeats what it published, to float32."""
    restarted = {
        (c.training, c.test): c
        for c in shift.cells
        if c.model == "restarted engine" and c.interval == "all"
    }
    assert len(restarted) == 2 * 3
    for (first, test), cell in restarted.items():
        assert cell.mse[1] is not None
        assert cell.mse[0] is not None
        assert cell.one_step is not None
        if first == test:
            assert cell.mse[1] < 1e-12
            assert cell.one_step < 1e-12
        else:  # of the same size from windows all over the motion, not the same as from the first
            assert 0.1 < cell.one_step / cell.mse[0] < 10.0
            assert cell.one_step != cell.mse[0]
    apart = next(
        c for c in shift.cells
        if (c.model, c.training, c.test, c.interval)
        == ("engine", "mujoco-native", "exudyn-native", "all")
    )  # fmt: skip
    gone_on = restarted["mujoco-native", "exudyn-native"]
    # The published motions have parted for six frames more.
    assert gone_on.mse[0] is not None
    assert apart.mse[0] is not None
    assert gone_on.mse[0] < 0.5 * apart.mse[0]
    assert not any(name.startswith("restarted") for name in shift.left_out)


def test_models_that_are_not_there_are_said_so(shift: Shift) -> None:
    none = "no trained model was tested"
    others = sorted(set(trainable()) - {"gns"})
    assert shift.left_out == dict.fromkeys(others, none)
    assert (f"{', '.join(others)} left out", f"{none}.") in answers(shift)
    assert refusal("gns", Graph.of(load_scene("balldrop"))) == ""
    assert "contact" in refusal("hgnn", Graph.of(load_scene("balldrop")))
    flat = Inertia(1.0, moments=(1.0, 1.0, 2.0))
    hinge = Joint("hinge", "hinge", "world", "plate", (0.0, 0.0, 1.0), (0.0, 1.0, 0.0))
    plate = Scene("plate", (Body("plate", inertia=flat),), 1.0, joints=(hinge,))
    assert "got joined bodies and no edges" in refusal("gns", Graph.of(plate))
    assert "points, which have no mass matrix for a flat body" in refusal("lgnn", Graph.of(plate))


def test_a_model_in_a_folder_of_its_own_name_was_tested(studied: Path, apart: None) -> None:
    """Two trainings of one model are compared by folders of different names."""
    del apart
    part = Selection.parse("native", "each", 1)
    places = studied / "models", studied / "data"
    test, trained, frame = study.question_of(*places, SCENE, trajectories=2, part=part)
    wide = [
        replace(entry, model="wide", facts={**entry.facts, "model": "gns"}) for entry in trained
    ]
    shift = study.study((test, wide, frame), conduct=HERE).shift
    assert {"gns", "sgnn"} & set(shift.left_out) == {"sgnn"}


def test_a_model_is_held_against_the_nearest_other_engine(shift: Shift) -> None:
    """An engine nearer than the noise has no row; briefly trained models are farther off."""
    assert nearness(shift).rows == ()
    floors = [f for f in shift.floors if f.kind != "noise"]
    rows = nearness(msgspec.structs.replace(shift, floors=tuple(floors))).rows
    assert len(rows) == len(ENGINES)
    for row in rows:
        home, text = row.texts
        own, sign, other = text.split()
        (floor,) = (
            f for f in floors
            if (f.kind, f"gns, {f.test}") == ("restarted engine", home) and f.first != f.test
        )  # fmt: skip
        assert float(other) == pytest.approx(floor.mse[1], rel=0.1)
        assert sign == ">"
        assert float(own) > float(other)


def test_what_data_cost_stands_beside_what_is_learned_from_them(
    studied: Path, shift: Shift
) -> None:
    """Costs are from the logs of the shards; those of fetched data are unknown."""
    costs = {domain.name: domain.cost_s for domain in shift.domains}
    for engine in ENGINES:
        path = studied / "data" / SCENE / f"{engine}-native.h5"
        lines = [json.loads(x) for x in (path.with_suffix("") / LOG).read_text().splitlines()]
        shards = {line["first"]: line for line in lines}
        count = sum(line["count"] for line in shards.values())
        each = sum(line["rollout_s"] for line in shards.values()) / count
        assert 0.0 < each < sum(line["simulate_s"] for line in shards.values()) / count
        assert costs[f"{engine}-native"] == pytest.approx(each)
        assert stage_times(path.with_name("fetched.h5")) == {}
    assert costs["reference"] is None

    (table,) = (table for table in tables(shift) if "training data cost" in table.title)
    dear = sorted(ENGINES, key=lambda engine: costs[f"{engine}-native"] or 0.0)
    assert [row.texts[0] for row in table.rows] == [f"{engine}-native" for engine in dear]
    points = costs_of(shift, "gns")
    assert [name for name, _, _ in points] == [f"{engine}-native" for engine in dear]
    for name, _, error in points:
        seeds = [
            c.mse[1]
            for c in shift.cells
            if (c.model, c.training, c.test, c.interval) == ("gns", name, "reference", "all")
        ]
        assert error == pytest.approx(np.mean(np.array(seeds, dtype=float)))


def test_models_of_intervals_tell_what_speed_costs(studied: Path, tmp_path: Path) -> None:
    """Models of intervals say nothing about changes of engine."""
    for part in ("data", "models"):
        shutil.copytree(studied / part, tmp_path / part)
    for interval in ("low", "medium", "high"):
        train(tmp_path, f"mujoco-{interval}", ("mujoco",), 0, interval=interval)
    parts = find_models(tmp_path / "models", SCENE, Selection.parse(None, "by-interval", None))
    assert [entry.interval for entry in parts] == ["low", "medium", "high"]
    result = shift_of(tmp_path)
    assert {gap.training for gap in result.gaps} == {"exudyn-native", "mujoco-native", "all-native"}
    answer = next(answer for answer in result.answers if answer.kind == "speed")
    assert answer.question == "What does a change of speed cost (mujoco-native)?"
    table = next(t for t in tables(result) if "trained on one interval, tested on all" in t.title)
    assert [row.texts[0] for row in table.rows] == [
        f"gns, mujoco-{interval}-native" for interval in ("low", "medium", "high")
    ]
    # All are the same untrained model: only the hardness of the intervals remains.
    assert [row.texts[4:] for row in table.rows] == [("1", "1", "1")] * 3
    for path in {*(tmp_path / "models").rglob("*.pt")} - {entry.path for entry in parts}:
        path.unlink()
    # Where no change of engine can be asked about, what can be told comes first.
    assert [each.kind for each in shift_of(tmp_path).answers] == ["speed", "resolvable"]
