"""`mbds-xsim train`: the files it leaves, its plan, and input that it refuses in one line."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path

import msgspec
import pytest
import torch

from mbds_xsim.base.isolate import Task, run_tasks
from mbds_xsim.commands.learn import _cost_blocks
from mbds_xsim.dataset.generate import Request as DataRequest
from mbds_xsim.dataset.generate import generate
from mbds_xsim.dataset.read import Dataset
from mbds_xsim.learn import runs, trainings
from mbds_xsim.learn.curves import read_curve
from mbds_xsim.learn.model_file import read_facts, read_model
from mbds_xsim.learn.recipe import PROFILES, Profile, Recipe
from mbds_xsim.learn.trainings import planned
from mbds_xsim.report.blocks import Text
from mbds_xsim.scene.scene import Clock
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene
from tests.command_line import CommandLine
from tests.learn.carried import carry_out
from tests.learn.conftest import TINY, Ask


def test_end_to_end(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: CommandLine
) -> None:
    """The command trains in processes of its own; the second time nothing is left to do."""
    out = tmp_path / "models"
    words = ["train", str(made), "--models", "gns", "--on", "mujoco,all", "--seeds", "1"]
    words += ["--profile", "smoke", "--steps", "10", "--out", str(out)]
    words += ["--json", str(tmp_path / "told.json")]
    monkeypatch.setitem(PROFILES, "smoke", TINY)
    assert run(*words, "--png", str(tmp_path / "curves.png")).code == 0
    summary = json.loads((tmp_path / "told.json").read_bytes())
    names = {f"2pendulum/native/gns/{training}-s0" for training in ("mujoco", "all")}
    assert set(summary["runs"]) == names
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    for name in names:
        model, facts = read_model(out / f"{name}.pt")
        assert facts == summary["runs"][name]
        assert facts["ended"] == "steps"
        assert all(bool(value.isfinite().all()) for value in model.state_dict().values())
        curve = read_curve(out / f"{name}.curve.json")
        assert [point.step for point in curve.points] == [2, 4, 6, 8, 10]
        assert float(facts["best_error"]) == min(point.error for point in curve.points)
        assert not (out / f"{name}.checkpoint").exists()
    each = summary["runs"]["2pendulum/native/gns/mujoco-s0"]
    both = summary["runs"]["2pendulum/native/gns/all-s0"]
    assert (each["train_engines"], both["train_engines"]) == ("mujoco", "mujoco,pybullet")
    assert (each["variant"], each["seed"]) == ("native", "0")
    for key in ("steps", "train_trajectories", "validation_trajectories", "starts", "drawn"):
        assert each[key] == both[key]
    stamps = {path: path.stat().st_mtime_ns for path in out.rglob("*.pt")}
    again = run(*words)
    assert again.code == 0
    assert "2 runs done, 2 of them before, 0 failed" in again.out
    (out / "2pendulum/native/gns/all-s0.curve.json").unlink()
    (tmp_path / "told.json").unlink()
    fewer = run(*words, "--png", str(tmp_path / "fewer.png"))
    assert fewer.code == 0
    assert "all-s0.curve.json: not there, and not drawn" in fewer.out.replace("\n", "")
    assert (tmp_path / "fewer.png").read_bytes().startswith(b"\x89PNG")
    assert set(json.loads((tmp_path / "told.json").read_bytes())["runs"]) == names
    assert stamps == {path: path.stat().st_mtime_ns for path in out.rglob("*.pt")}


def test_divergence_is_a_result_and_a_failure(
    ask: Ask, made: Path, monkeypatch: pytest.MonkeyPatch, run: CommandLine
) -> None:
    def wild(run: runs.TrainingRun) -> Recipe:
        return msgspec.structs.replace(run.settings.recipe, rate=1e14)

    monkeypatch.setattr(runs.TrainingRun, "recipe", property(wild))
    monkeypatch.setitem(PROFILES, "smoke", TINY)
    outcome = carry_out(dataclasses.replace(ask("gns"), profile=TINY.of_exactly(12)))
    (facts,) = outcome.trained.values()
    assert outcome.failed == {}
    assert (facts["ended"], facts["level"]) == ("diverged", "no")
    assert read_facts(ask().out / "2pendulum/native/gns/all-s0.pt")["ended"] == "diverged"
    words = ["train", str(made), "--models", "gns", "--on", "all", "--seeds", "1", "--steps", "12"]
    words += ["--profile", "smoke", "--out", str(ask().out), "--json", str(ask().out / "told.json")]
    ended = run(*words)
    assert ended.code == 1
    summary = json.loads((ask().out / "told.json").read_bytes())
    assert summary["diverged"] == list(outcome.trained) == list(summary["runs"])
    output = " ".join(ended.out.split())
    assert "all-s0 diverged: no validation succeeded; its file has untrained parameters" in output


def test_a_run_without_a_successful_validation_counts_as_diverged(
    ask: Ask, made: Path, monkeypatch: pytest.MonkeyPatch, run: CommandLine
) -> None:
    monkeypatch.setattr("mbds_xsim.learn.train.validation_error", lambda *_: math.inf)
    monkeypatch.setitem(PROFILES, "smoke", TINY)
    outcome = carry_out(ask())
    ((name, facts),) = outcome.trained.items()
    assert (facts["ended"], facts["best_error"], facts["best_step"]) == ("steps", "inf", "0")
    (other,) = planned(ask(out="other")).runs
    untrained = runs.prepared(other)[0].state_dict()
    saved = read_model(ask().out / f"{name}.pt")[0].state_dict()
    assert all(torch.equal(value, saved[key]) for key, value in untrained.items())
    words = [
        "train",
        str(made),
        "--models",
        "gns",
        "--on",
        "all",
        "--seeds",
        "1",
        "--profile",
        "smoke",
    ]
    ended = run(*words, "--out", str(ask().out))
    assert ended.code == 1
    output = " ".join(ended.out.split())
    assert f"{name}: no validation succeeded; its file has untrained parameters" in output
    assert trainings._ended(facts).startswith("all 12 steps, no validation succeeded; its file")


def test_a_plan_tells_the_cost_and_trains_nothing(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: CommandLine
) -> None:
    def here(tasks: Sequence[Task], *, workers: int) -> list[object]:
        assert workers > 0
        return run_tasks(tasks, workers=0)

    monkeypatch.setattr("mbds_xsim.base.isolate.run_tasks", here)
    monkeypatch.setitem(PROFILES, "smoke", TINY)
    words = ["train", str(made), "--models", "gns, gns", "--profile", "smoke", "--plan"]
    ended = run(*words, "--json", "-", "--out", str(tmp_path / "models"))
    assert ended.code == 0
    (cost,) = json.loads(ended.out)["cost"]
    assert (cost["group"], cost["model"]) == ("2pendulum/native", "gns")
    seconds = TINY.steps / cost["steps_per_s"] + 3 * cost["validation_s"]
    assert cost["hours"] == pytest.approx(seconds / 3600)
    assert 1 < cost["steps_per_s"] < 10_000
    assert "6 runs, at most" in ended.err
    assert "level" not in ended.err  # the profile takes all its steps
    assert not (tmp_path / "models").exists()


@pytest.mark.parametrize(
    ("profile", "words"),
    [
        (TINY, "3 runs, at most 14 h of one process, about 10 h with 2; measured on a few steps"),
        (
            msgspec.structs.replace(TINY, until_level=True),
            "3 runs, at most 14 h of one process, about 10 h with 2; measured on a few steps; "
            "runs end earlier once they are level",
        ),
    ],
)
def test_a_plan_divides_no_run(ask: Ask, profile: Profile, words: str) -> None:
    request = dataclasses.replace(ask("gns", "sgnn", on="each"), profile=profile)
    plan = planned(request)
    sgnn = [run for run in plan.runs if run.model == "sgnn"]
    plan = dataclasses.replace(plan, runs=(*sgnn[:1], *(r for r in plan.runs if r.model == "gns")))
    assert len(plan.runs) == 3
    costs = [
        runs.Cost("2pendulum/native", model, 1.0, 1.0, hours)
        for model, hours in (("sgnn", 10.0), ("gns", 2.0))
    ]
    *_, text = _cost_blocks(plan, costs, 2)
    assert isinstance(text, Text)
    assert text.text == words


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["nothing"], "nothing: there is no such file or folder"),
        (["empty"], "empty holds no data set; name a folder that mbds-xsim generate has finished"),
        (
            ["DATA", "--models", "gsn"],
            "is called 'gsn'; did you mean 'gns'? There are: gns, gns+, hgnn, hgnn+, lgnn, lgnn+, "
            "mbd_node, nerd, sgnn, sgnn+",
        ),
        (["DATA", "--models", "hold"], "no model to train is called 'hold'"),
        (["DATA", "--on", "bullet"], "--on: got 'bullet', allowed for 2pendulum/native is each,"),
        (["ONE", "--on", "all"], "--on: all needs data of at least 2 engines"),
        (["ONE", "COPY"], "are both 2pendulum of mujoco native; give one of them"),
        (
            ["ONE", "OTHER"],
            "pybullet-native.h5: seed 1, unlike mujoco-native.h5 (0); domains must",
        ),
        (
            ["DATA", "--profile", "light"],
            "is called 'light'; did you mean 'lite'? There are: smoke, lite,",
        ),
        (
            ["DATA", "--track", "fast"],
            "--track: got 'fast', allowed for gns is paper, native, lite",
        ),
        (["DATA", "--device", "tpu"], "--device: got 'tpu', allowed is cpu or cuda"),
        (["DATA", "--plan", "--png", "x.png"], "--png: nothing is trained with --plan; leave one"),
        (
            ["DATA", "--plan", "--tensorboard", "events"],
            "--tensorboard: nothing is trained with --plan; leave one out",
        ),
        (["DATA", "--bf16"], "--bf16 and --compile: got --device cpu, allowed with them is cuda"),
        (["DATA", "--profile", "smoke", "--out", "a-file"], "cannot write"),
        (["DATA", "--tensorboard", "a-file/x"], "--tensorboard: cannot write a-file/x/events: "),
        (["DATA", "--tensorboard", "/proc/x"], "--tensorboard: cannot write /proc/x/events: /proc"),
        (["SHARD"], "is one shard; the split is in the file that joins the shards"),
        (["FEW"], "0 trajectories of 13 frames for validation that all engines have, needed"),
    ],
)
def test_bad_input_is_one_clear_line(
    words: list[str],
    line: str,
    places: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
    run: CommandLine,
) -> None:
    monkeypatch.chdir(places["EMPTY"])
    monkeypatch.setattr(Dataset, "check", lambda *_: pytest.fail("all data were read first"))
    assert line in run("train", *(places.get(word, word) for word in words)).refusal


@pytest.fixture(scope="module")
def places(made: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Paths of data that cannot be trained on as they are, or not together."""
    scene = msgspec.structs.replace(load_scene("2pendulum"), clock=Clock(steps=12))
    folder = tmp_path_factory.mktemp("places")

    def also(name: str, engine: str, trajectories: int, seed: int) -> str:
        choice = Choice.parse(engines=engine, profiles="native")
        request = DataRequest((scene,), choice, trajectories, folder / name, seed=seed)
        generate(request, workers=0)
        return str(folder / name)

    (folder / "cwd" / "empty").mkdir(parents=True)
    (folder / "cwd" / "a-file").write_text("")
    one = made / "2pendulum/mujoco-native.h5"
    return {
        "EMPTY": str(folder / "cwd"),
        "DATA": str(made),
        "ONE": str(one),
        "COPY": also("copy", "mujoco", 12, 0),
        "OTHER": also("other", "pybullet", 40, 1),
        "FEW": also("few", "mujoco", 3, 0),
        "SHARD": str(next((made / "2pendulum/mujoco-native").glob("*.h5"))),
    }
