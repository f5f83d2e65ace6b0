"""`mbds-xsim train`: the data of each training, the files it leaves, and how it goes on."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import h5py
import msgspec
import pytest
import torch
from rich.console import Console

from mbds_xsim.__main__ import main
from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.base.isolate import Task, run_tasks
from mbds_xsim.commands.learn import _cost_blocks
from mbds_xsim.dataset.cluster import Cluster
from mbds_xsim.dataset.generate import Request as DataRequest
from mbds_xsim.dataset.generate import generate
from mbds_xsim.dataset.read import Dataset
from mbds_xsim.learn import runs, trainings
from mbds_xsim.learn.curves import EventLog, LearningCurve, log_whole, read_curve, write_curve
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.groups import groups
from mbds_xsim.learn.model_file import read_facts, read_model
from mbds_xsim.learn.recipe import PROFILES, Profile, Recipe
from mbds_xsim.learn.runs import TrainingRequest
from mbds_xsim.learn.train import CurvePoint, Training, check_identity
from mbds_xsim.learn.trainings import carry, planned, watched
from mbds_xsim.report.blocks import Text
from mbds_xsim.report.terminal import TrainingBar
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene
from tests.farm import Farm
from tests.learn.conftest import TINY, Ask

ENGINES = "mujoco,pybullet"


class Deaf:
    """Progress sink that discards everything."""

    def begin(self, done: int, most_steps: object) -> None:
        pass

    def reached(self, name: str, step: int, error: float, *, before: bool) -> None:
        pass

    def ended(self, name: str, most_steps: int, how: str) -> None:
        pass


def _carry(request: TrainingRequest) -> trainings.TrainingOutcome:
    return carry(planned(request), workers=0, carrier=run_tasks, progress=Deaf())


def _end(words: list[str], monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", ["mbds-xsim", "train", *words])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


@pytest.mark.slow
def test_a_cluster_trains_the_same_models(farm: Farm, ask: Ask) -> None:
    pytest.importorskip("distributed")
    here, there = ask(on="each"), ask(on="each", out="there")
    _carry(here)
    farm.worker()
    farm.wait_for(1)
    there.out.mkdir()
    with Cluster(farm.address, there.out) as cluster:
        carry(planned(there), workers=cluster.workers, carrier=cluster, progress=Deaf())
    for name in ("mujoco-s0", "pybullet-s0"):
        one, two = (
            read_model(next(request.out.rglob(f"{name}.pt")))[0] for request in (here, there)
        )
        assert all(map(torch.equal, one.state_dict().values(), two.state_dict().values()))


def test_a_curve_that_was_left_over_is_not_the_runs(
    ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run's model was removed, so that it is trained anew; the bar starts from zero."""
    _carry(ask())
    (run,) = (r for r in planned(ask(out="other")).runs)
    run = dataclasses.replace(run, request=ask())
    run.path.unlink()
    calls = []
    monkeypatch.setattr(Deaf, "reached", lambda *words, **more: calls.append((words, more)))
    with watched([run], Deaf()):
        pass
    assert calls == []
    run.checkpoint.touch()
    with watched([run], Deaf()):
        pass
    assert [more for _, more in calls] == [{"before": True}]


def test_end_to_end(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command trains in processes of its own; the second time nothing is left to do."""
    out = tmp_path / "models"
    words = [str(made), "--models", "gns", "--on", "mujoco,all", "--seeds", "1"]
    words += ["--profile", "smoke", "--steps", "10", "--out", str(out)]
    words += ["--json", str(tmp_path / "told.json")]
    monkeypatch.setitem(PROFILES, "smoke", TINY)
    assert _end([*words, "--png", str(tmp_path / "curves.png")], monkeypatch) == 0
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
    capsys.readouterr()
    stamps = {path: path.stat().st_mtime_ns for path in out.rglob("*.pt")}
    assert _end(words, monkeypatch) == 0
    assert "2 runs done, 2 of them before, 0 failed" in capsys.readouterr().out
    (out / "2pendulum/native/gns/all-s0.curve.json").unlink()
    (tmp_path / "told.json").unlink()
    assert _end([*words, "--png", str(tmp_path / "fewer.png")], monkeypatch) == 0
    assert "all-s0.curve.json: not there, and not drawn" in "".join(
        capsys.readouterr().out.split("\n")
    )
    assert (tmp_path / "fewer.png").read_bytes().startswith(b"\x89PNG")
    assert set(json.loads((tmp_path / "told.json").read_bytes())["runs"]) == names
    assert stamps == {path: path.stat().st_mtime_ns for path in out.rglob("*.pt")}


@pytest.mark.parametrize("model", ["gns", "sgnn", "hgnn"])
def test_an_interrupted_campaign_goes_on_to_the_same_bits(
    ask: Ask, model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    _carry(ask(model, out="whole"))

    def halt(curve: LearningCurve) -> bytes:
        if curve.points[-1].step == 8:
            raise KeyboardInterrupt
        return write_curve(curve)

    monkeypatch.setattr("mbds_xsim.learn.runs.write_curve", halt)
    with pytest.raises(KeyboardInterrupt):
        _carry(ask(model, out="halted"))
    monkeypatch.undo()
    (run,) = planned(ask(model, out="halted")).runs
    assert run.checkpoint.exists()
    assert not run.path.exists()
    _carry(ask(model, out="halted"))
    whole = read_model(ask(model, out="whole").out / f"{run.name}.pt")[0].state_dict()
    resumed = read_model(run.path)[0].state_dict()
    assert all(torch.equal(value, resumed[key]) for key, value in whole.items())
    curves = [
        read_curve(ask(out=out).out / f"{run.name}.curve.json") for out in ("whole", "halted")
    ]
    assert curves[0] == curves[1]


def test_divergence_is_a_result_and_a_failure(
    ask: Ask, made: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def wild(run: runs.TrainingRun) -> Recipe:
        return msgspec.structs.replace(run.settings.recipe, rate=1e14)

    monkeypatch.setattr(runs.TrainingRun, "recipe", property(wild))
    monkeypatch.setitem(PROFILES, "smoke", TINY)
    outcome = _carry(dataclasses.replace(ask("gns"), profile=TINY.of_exactly(12)))
    (facts,) = outcome.trained.values()
    assert outcome.failed == {}
    assert (facts["ended"], facts["level"]) == ("diverged", "no")
    assert read_facts(ask().out / "2pendulum/native/gns/all-s0.pt")["ended"] == "diverged"
    words = [str(made), "--models", "gns", "--on", "all", "--seeds", "1", "--steps", "12"]
    words += ["--profile", "smoke", "--out", str(ask().out), "--json", str(ask().out / "told.json")]
    assert _end(words, monkeypatch) == 1
    summary = json.loads((ask().out / "told.json").read_bytes())
    assert summary["diverged"] == list(outcome.trained) == list(summary["runs"])
    output = " ".join(capsys.readouterr().out.split())
    assert "all-s0 diverged: no validation succeeded; its file has untrained parameters" in output


def test_a_run_without_a_successful_validation_counts_as_diverged(
    ask: Ask, made: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("mbds_xsim.learn.train.validation_error", lambda *_: math.inf)
    monkeypatch.setitem(PROFILES, "smoke", TINY)
    outcome = _carry(ask())
    ((name, facts),) = outcome.trained.items()
    assert (facts["ended"], facts["best_error"], facts["best_step"]) == ("steps", "inf", "0")
    (run,) = planned(ask(out="other")).runs
    untrained = runs.prepared(run)[0].state_dict()
    saved = read_model(ask().out / f"{name}.pt")[0].state_dict()
    assert all(torch.equal(value, saved[key]) for key, value in untrained.items())
    words = [str(made), "--models", "gns", "--on", "all", "--seeds", "1", "--profile", "smoke"]
    assert _end([*words, "--out", str(ask().out)], monkeypatch) == 1
    output = " ".join(capsys.readouterr().out.split())
    assert f"{name}: no validation succeeded; its file has untrained parameters" in output
    assert trainings._ended(facts).startswith("all 12 steps, no validation succeeded; its file")


def test_what_a_model_cannot_represent_is_left_out(data: Callable[..., Dataset], ask: Ask) -> None:
    (ball,) = groups([data("balldrop").path])
    request = dataclasses.replace(ask("gns", "hgnn", on="each"), groups=[ball])
    plan = planned(request)
    assert [run.model for run in plan.runs] == ["gns"]
    assert list(plan.left_out) == ["balldrop/native/hgnn"]
    assert "contact" in plan.left_out["balldrop/native/hgnn"]


def test_a_scene_that_has_no_graph_is_left_out_for_every_model(
    ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The refusal is a reason like any other, and does not end the planning."""

    def refuse(_: Scene) -> Graph:
        raise Unsupported("servo of 'rail': got targets that change")

    request = ask("gns", "gns+")
    monkeypatch.setattr(Graph, "of", refuse)
    with pytest.raises(InputError, match=r"^nothing to train: gns: servo .*; gns\+: servo"):
        planned(request)


def test_nothing_to_train_is_said_with_every_reason(data: Callable[..., Dataset], ask: Ask) -> None:
    (ball,) = groups([data("balldrop").path])
    request = dataclasses.replace(ask("hgnn", "lgnn", on="each"), groups=[ball])
    with pytest.raises(InputError, match=r"^nothing to train: hgnn: .*contact.*; lgnn: .*contact"):
        planned(request)


def test_damaged_data_are_not_trained_on(made: Path, ask: Ask, tmp_path: Path) -> None:
    folder = shutil.copytree(made, tmp_path / "data")
    shard_file = folder / "2pendulum/mujoco-native/0000000000.h5"
    with h5py.File(shard_file, "r+") as file:
        file["position"][2, 3] += 1e-6
    request = dataclasses.replace(ask(on="each"), groups=groups([folder]))
    with pytest.raises(InputError, match="dataset position is not what was written"):
        planned(request)
    planned(dataclasses.replace(request, on="pybullet"))  # reads none of these data


def test_another_run_in_its_place_is_refused(ask: Ask) -> None:
    _carry(ask())
    longer = msgspec.structs.replace(TINY, steps=16)
    plan = planned(dataclasses.replace(ask(), profile=longer), only=True)
    assert list(plan.blocked) == [run.name for run in plan.runs]
    assert "a model of another profile" in next(iter(plan.blocked.values()))
    with pytest.raises(InputError, match=r"of another profile \(steps 12, now 16\); name another"):
        planned(dataclasses.replace(ask(), profile=longer))
    with pytest.raises(InputError, match=r"a model of another track, settings;"):
        planned(dataclasses.replace(ask(), track="native"))
    with pytest.raises(InputError, match=r"a model of another device;"):
        planned(dataclasses.replace(ask(), device="cuda"))


def test_a_file_that_states_no_device_fits_any(ask: Ask) -> None:
    (run,) = planned(ask()).runs
    stated = {key: value for key, value in run.identity.items() if key != "device"}
    check_identity(run.path, "a model", stated, run.identity)


def test_a_plan_tells_the_cost_and_trains_nothing(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def here(tasks: Sequence[Task], *, workers: int) -> list[object]:
        assert workers > 0
        return run_tasks(tasks, workers=0)

    monkeypatch.setattr("mbds_xsim.base.isolate.run_tasks", here)
    monkeypatch.setitem(PROFILES, "smoke", TINY)
    words = [str(made), "--models", "gns", "--profile", "smoke", "--plan", "--json", "-"]
    assert _end([*words, "--out", str(tmp_path / "models")], monkeypatch) == 0
    output = capsys.readouterr()
    (cost,) = json.loads(output.out)["cost"]
    assert (cost["group"], cost["model"]) == ("2pendulum/native", "gns")
    seconds = TINY.steps / cost["steps_per_s"] + 3 * cost["validation_s"]
    assert cost["hours"] == pytest.approx(seconds / 3600)
    assert 1 < cost["steps_per_s"] < 10_000
    assert "6 runs, at most" in output.err
    assert "level" not in output.err  # the profile takes all its steps
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


def test_the_bar_counts_runs_and_only_the_steps_of_this_process() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=160)
    with TrainingBar(console) as bar:
        bar.begin(1, [100, 100])
        bar.reached("a", 40, 2e-3, before=True)
        bar.reached("a", 50, 1e-3, before=False)
        (task,) = bar._progress.tasks
        assert (task.completed, task.total) == (50, 200)
        assert bar._taken == 10
        assert task.fields["last"] == "a: 0.001 m² at 50"
        bar.ended("a", 100, "level after 50 steps")
        assert task.completed == 100
        assert task.fields["runs"] == "2/3 runs"
    stream = console.file
    assert isinstance(stream, io.StringIO)
    assert "a: level after 50 steps" in stream.getvalue()


def test_tensorboard_is_told(tmp_path: Path) -> None:
    reading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    with EventLog(tmp_path) as log:
        points = [CurvePoint(step, 1.0 / step, 2.0 / step, 1e-3) for step in (10, 20)]
        for count in (1, 2, 2):
            log.add(points[:count])
    read = reading.EventAccumulator(str(tmp_path))
    read.Reload()
    assert [(e.step, e.value) for e in read.Scalars("error")] == [
        (10, pytest.approx(0.2)),
        (20, pytest.approx(0.1)),
    ]


@pytest.mark.parametrize("logged", [True, False])
def test_tensorboard_is_told_of_the_time_before_an_interruption(
    ask: Ask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, logged: bool
) -> None:
    reading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")

    def halt(curve: LearningCurve) -> bytes:
        if curve.points[-1].step == 8:
            raise KeyboardInterrupt
        return write_curve(curve)

    watched_run = dataclasses.replace(ask(), events=tmp_path / "events")
    monkeypatch.setattr("mbds_xsim.learn.runs.write_curve", halt)
    with pytest.raises(KeyboardInterrupt):
        _carry(watched_run if logged else ask())
    monkeypatch.undo()
    (run,) = planned(watched_run).runs
    _carry(watched_run)
    read = reading.EventAccumulator(str(tmp_path / "events" / run.name))
    read.Reload()
    assert [event.step for event in read.Scalars("error")] == [4, 8, 12]


def test_tensorboard_is_told_of_a_run_that_was_finished_before(ask: Ask, tmp_path: Path) -> None:
    reading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    request = ask()
    _carry(request)
    (name,) = planned(request).done
    for _ in range(2):  # once is enough
        log_whole(request.out / f"{name}.curve.json", tmp_path / "events")
    read = reading.EventAccumulator(str(tmp_path / "events"))
    read.Reload()
    points = read_curve(request.out / f"{name}.curve.json").points
    assert [event.step for event in read.Scalars("error")] == [point.step for point in points]


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
            "pybullet-native.h5: seed 1, unlike mujoco-native.h5; domains must",
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
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(places["EMPTY"])
    monkeypatch.setattr(Dataset, "check", lambda *_: pytest.fail("all data were read first"))
    arguments = [places.get(word, word) for word in words]
    assert _end(arguments, monkeypatch) == 2
    error = capsys.readouterr().err
    assert line in error
    assert len(error.strip().splitlines()) == 1


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


def test_the_telling_of_level_follows_the_curve(ask: Ask) -> None:
    (run,) = planned(ask()).runs
    model, _, parts = runs.prepared(run)
    level = [
        CurvePoint(4 * k + 4, 1.0, error, 1e-3)
        for k, error in enumerate((4.0, 2.0, 1.0, 1.0, 0.99))
    ]
    falling = [*level[:-1], CurvePoint(20, 1.0, 0.5, 1e-3)]
    for curve, word in ((level, "yes"), (falling, "no")):
        training = Training(model, curve, ended="steps", wall_s=1.0)
        assert runs.facts_of(run, training, parts)["level"] == word
