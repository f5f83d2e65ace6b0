"""The whole study on a tiny set: from data and models to tables, page and answers."""

from __future__ import annotations

import base64
import csv
import dataclasses
import json
import math
import shutil
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import HERE, Conduct, Crash, Silent, Task
from mbds_xsim.commands import app
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.dataset.shard import LOG, stage_times
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import LearnedModel, refusal, trainable
from mbds_xsim.learn.particles import RolloutFigures, figures_on
from mbds_xsim.learn.shift import rollouts, study
from mbds_xsim.learn.shift.domains import load_paired
from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.learn.trained import Selection, find_models, trivial_models
from mbds_xsim.learn.window import HISTORY, Motions
from mbds_xsim.scene.scene import Body, Inertia, Joint, Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.studies.shift.figures import draw_curves
from mbds_xsim.studies.shift.present import present, protocol
from mbds_xsim.studies.shift.tables import nearness, tables
from mbds_xsim.studies.shift.worth import costs_of
from tests.learn.shifts import ENGINES, SCENE, SEEDS, STEPS, TRAININGS, make, train

pytestmark = pytest.mark.usefixtures("apart")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("shift"))


@pytest.fixture(scope="module")
def shift(folder: Path, apart: None) -> Shift:
    del apart
    return shift_of(folder)


def shift_of(folder: Path, at: int | None = None) -> Shift:
    """Test the models of a folder on the data next to them."""
    question = study.question_of(folder / "models", folder / "data", SCENE)
    return study.study(question, at=at, conduct=HERE).shift


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


def test_the_protocol_names_what_the_models_were_trained_by_alone(shift: Shift) -> None:
    """Models that learn nothing have no profile."""
    (words,) = [part for part in protocol(shift).split("; ") if part.startswith("profile ")]
    (profile,) = {facts.profile for facts in shift.models if facts.engines}
    counts = {len(facts.engines): facts.trajectories for facts in shift.models}
    assert words == f"profile {profile}, trained on {counts[1]} (native) trajectories"
    assert counts[2] == 2 * counts[1] > 0


def test_a_model_with_fewer_seeds_than_another_is_named(shift: Shift) -> None:
    one = tuple(
        msgspec.structs.replace(m, seed=seed) for m in shift.models if m.engines and not m.seed
        for seed in range(3)
    )  # fmt: skip
    other = tuple(msgspec.structs.replace(m, model="sgnn") for m in one if m.seed == 1)
    few = "too few to tell of other runs of the same trainings; profile"
    for models, words in (
        (one, "Seeds 0, 1, 2; profile"),
        (other, f"Seeds 1, {few}"),
        (one + other, f"Seeds 0, 1, 2 (of sgnn 1 alone), {few}"),
    ):
        assert words in protocol(msgspec.structs.replace(shift, models=models))


def test_one_trajectory_is_told_as_one(shift: Shift) -> None:
    """The protocol also names the intervals of the starts if some are missing."""
    one = msgspec.structs.replace(shift, index=(7,))
    two = msgspec.structs.replace(shift, index=(8, 6))

    assert protocol(one).startswith("Tested on 1 trajectory of medium starts alone that all ")
    assert protocol(two).startswith("Tested on 2 trajectories of low and high starts alone that ")


def test_other_settings_of_an_engine_are_no_other_engine(shift: Shift) -> None:
    """The band of a chart is that of the other engines."""
    home = "mujoco-native"
    (other,) = (
        floor for floor in shift.floors
        if (floor.kind, floor.test) == ("restarted engine", home) and floor.first != home
    )  # fmt: skip
    far = msgspec.structs.replace(other, first="mujoco-matched", curve=(1e6,) * len(other.curve))
    both = msgspec.structs.replace(shift, floors=(*shift.floors, far))
    axes = Figure().subplots()

    draw_curves(axes, both, "gns", home)

    (band,) = axes.collections
    heights = np.asarray(band.get_paths()[0].vertices)[:, 1]
    assert heights.max() == pytest.approx(max(filter(None, other.curve)))


def test_what_data_cost_stands_beside_what_is_learned_from_them(folder: Path, shift: Shift) -> None:
    """Costs are from the logs of the shards; those of fetched data are unknown."""
    costs = {domain.name: domain.cost_s for domain in shift.domains}
    for engine in ENGINES:
        path = folder / "data" / SCENE / f"{engine}-native.h5"
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


def test_engine_floor_is_the_distance_of_the_data(folder: Path, shift: Shift) -> None:
    files = [load_dataset(folder / "data" / SCENE / f"{name}-native.h5") for name in ENGINES]
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


def test_what_was_tested_is_not_tested_again(
    folder: Path, shift: Shift, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(rollouts, "figures_on", refuse)
    again = shift_of(folder)
    assert again.cells == shift.cells
    assert again.gaps == shift.gaps


def test_without_the_cache_all_is_done_anew(
    folder: Path, shift: Shift, monkeypatch: pytest.MonkeyPatch
) -> None:
    tested: list[tuple[Any, ...]] = []
    gone_on: list[tuple[Any, ...]] = []
    predicted = rollouts._predicted

    def noted_figures(*words: Any, **more: Any) -> RolloutFigures:
        tested.append(words)
        return figures_on(*words, **more)

    def noted_restart(*words: Any) -> torch.Tensor:
        gone_on.append(words)
        return predicted(*words)

    monkeypatch.setattr(rollouts, "figures_on", noted_figures)
    monkeypatch.setattr(rollouts, "_predicted", noted_restart)
    question = study.question_of(folder / "models", folder / "data", SCENE)
    again = study.study(question, conduct=Conduct(0, cache=False)).shift
    assert len(tested) == len(TRAININGS) * SEEDS + 3
    assert all(len(motions) == 3 * len(shift.index) for _, motions in tested)
    assert len({(job.engine.name, job.domain.name) for job, *_ in gone_on}) == 2 * 3
    assert again.cells == shift.cells
    assert again.gaps == shift.gaps


def test_restarts_that_were_interrupted_go_on(
    folder: Path, shift: Shift, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = load_paired(folder / "data", SCENE).domains
    rollouts.Restart(one, two, shift.horizon).path.unlink()
    predicted, done = rollouts._predicted, []

    def noted(job: rollouts.Restart, motions: Motions, inputs: Batch, *part: int) -> torch.Tensor:
        done.append((job.engine.name, job.domain.name))
        return predicted(job, motions, inputs, *part)

    monkeypatch.setattr(rollouts, "_predicted", noted)
    again = shift_of(folder)
    assert set(done) == {(one.name, two.name)}
    assert again.gaps == shift.gaps


def test_nothing_goes_on_where_no_motion_is_known(folder: Path) -> None:
    """An example is the time after the truth's last first impact."""
    paired = load_paired(folder / "data", SCENE)
    one, two = paired.domains
    motions = rollouts.Restart(one, two, 3).domain.motions(torch.float64)
    assert motions.body is not None
    unknown = dataclasses.replace(motions, body=torch.full_like(motions.body, torch.nan))
    predicted = rollouts._predicted(rollouts.Restart(one, two, 3), unknown, paired.batch, 3)
    assert predicted.shape[:2] == (len(motions), 3)
    assert torch.isnan(predicted).all()


class Count(Silent):
    """A meter that counts."""

    whole = counted = 0

    def begin(self, total: int, done: int = 0) -> None:
        self.whole += total + done

    def advance(self, work: str) -> None:
        del work
        self.counted += 1


def test_a_restart_that_crashes_takes_no_other_along(
    folder: Path, shift: Shift, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The restarts of its process are done alone; an unreadable file is made again."""
    test = load_paired(folder / "data", SCENE)
    one, two = test.domains
    jobs = [rollouts.Restart(one, domain, shift.horizon) for domain in (one, two)]
    jobs[0].path.unlink()
    jobs[1].path.write_bytes(b"no archive")

    def crashing(
        tasks: Sequence[Task], *, workers: int | None, finished: Callable[[int, object], None]
    ) -> list[object]:
        assert workers is None
        answers: list[object] = []
        for place, task in enumerate(tasks):
            if any(job.name == jobs[0].name for job in task.arguments[1]):
                answers.append(Crash("it broke"))
            else:
                task.function(*task.arguments)
                answers.append(None)
            finished(place, answers[-1])
        return answers

    meter = Count()
    with monkeypatch.context() as patch:
        patch.setattr(rollouts, "run_tasks", crashing)
        restarted, lost = rollouts.restarted(
            test, test.domains, shift.horizon, conduct=Conduct(meter=meter)
        )
    assert lost == {f"{one.name} on {one.name}": "it broke"}
    assert set(restarted) == {(e.name, d.name) for e in (one, two) for d in (one, two)} - {
        (one.name, one.name)
    }
    assert (meter.whole, meter.counted) == (2, 2)
    again = shift_of(folder)
    assert again.gaps == shift.gaps


def test_memory_holds_few_trajectories_and_no_figures(
    folder: Path, shift: Shift, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If there are too many, one domain is read at a time; figures are the same."""
    test = load_paired(folder / "data", SCENE)
    refs: list[weakref.ref[Motions]] = []

    def watched(model: LearnedModel, motions: Motions, **plan: Any) -> RolloutFigures:
        alive = {id(found) for ref in refs if (found := ref()) is not None}
        assert alive <= {id(motions)}
        refs.append(weakref.ref(motions))
        return figures_on(model, motions, **plan)

    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path))
    monkeypatch.setattr(rollouts, "figures_on", watched)
    monkeypatch.setattr(rollouts, "_ROWS", len(test.index))
    entries, plan = trivial_models(), rollouts.RolloutPlan(shift.horizon)
    found = rollouts.evaluate(test.scene, entries, test.domains, plan, conduct=HERE)
    assert len(refs) == len(found) == len(entries) * len(test.domains)
    figures = weakref.ref(next(iter(found.values())))
    assert figures() is None
    alone = {key: found[key].error for key in found}
    monkeypatch.setattr(rollouts, "_ROWS", 512)
    anew = Conduct(0, cache=False)
    together = rollouts.evaluate(test.scene, entries, test.domains, plan, conduct=anew)
    assert len(refs) == len(found) + len(entries)
    for key, error in alone.items():
        np.testing.assert_allclose(together[key].error, error, rtol=1e-6)


def test_answers_and_tables_are_given_at_the_frame_asked_for(folder: Path, shift: Shift) -> None:
    early = shift_of(folder, at=1)
    assert (shift.at, early.at) == (10, 1)
    assert (shift.kept, early.kept) == (0, len(shift.models))
    assert f", {early.kept} of {early.kept} models tested before" in present(early).made
    assert "At t = 10 on native data" in shift.answers[0].answer
    assert "At t = 1 on native data" in early.answers[0].answer
    assert early.gaps == shift.gaps
    titles = [next(tables(result)).title for result in (shift, early)]
    assert titles == [f"Which model survives which change at t = {frame}" for frame in (10, 1)]
    with pytest.raises(InputError, match=r"--at: got 15, allowed is 1, 10$"):
        shift_of(folder, at=15)


def test_the_command_writes_all_files(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = {kind: str(folder / f"out.{kind}") for kind in ("json", "csv", "html", "png", "md")}
    words = ["shift", str(folder / "models"), str(folder / "data"), "--workers", "2"]
    words += ["--json", names["json"], "--csv", names["csv"], "--html", names["html"]]
    words += ["--png", names["png"], "--markdown", names["md"]]
    words += ["--rollouts", str(folder / "rollouts.png")]
    app(words, standalone_mode=False)
    text = capsys.readouterr().out
    assert "Is a shift resolvable?" in text
    result = msgspec.json.decode(Path(names["json"]).read_bytes(), type=Shift)
    assert result.schema == "mbds-xsim/shift/1"
    with Path(names["csv"]).open() as file:
        rows = list(csv.DictReader(file))
    # Trained and trivial models on three domains; engines on two others, restarted on all three.
    assert len(rows) == len(result.index) * (3 * (len(TRAININGS) * SEEDS + 3) + 4 + 6)
    cell = next(c for c in result.cells if c.model == "hold" and c.interval == "all")
    same = [
        float(row["squared_error_m2_t10"])
        for row in rows
        if row["model"] == "hold" and row["test"] == cell.test
    ]
    assert cell.mse[1] == pytest.approx(np.mean(same), rel=1e-6)
    page = Path(names["html"]).read_text()
    assert page.count("<svg") >= 3
    assert "not resolvable: own error exceeds the engine floor" in page
    assert "seeds 0, 1, too few to tell" in page.lower()
    _check_viewer(page)
    assert "http" not in page.replace("http://www.w3.org", "")
    assert "| engine mujoco-native |" in Path(names["md"]).read_text()
    assert "![" in Path(names["md"]).read_text()
    for picture in (Path(names["png"]), folder / "rollouts.png"):
        assert picture.read_bytes().startswith(b"\x89PNG")
    assert "NaN" not in json.dumps(json.loads(Path(names["json"]).read_text()))


def test_models_of_intervals_tell_what_speed_costs(folder: Path, tmp_path: Path) -> None:
    """Models of intervals say nothing about changes of engine."""
    for part in ("data", "models"):
        shutil.copytree(folder / part, tmp_path / part)
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


def _check_viewer(page: str) -> None:
    """Check that the viewer's arrays have the stated lengths, and rollouts start on the truth."""
    text = page.split('<script type="application/json" id="data">')[1].split("</script>")[0]
    viewer = json.loads(text)
    shape = (len(viewer["trajectories"]), viewer["frames"], viewer["points"], 3)
    assert len(base64.b64decode(viewer["base"])) == 2 * math.prod(shape)
    truth, *rollouts = viewer["entries"]
    assert truth["deviation"] is None
    assert [entry["dashed"] for entry in rollouts] == [False, True]
    for entry in rollouts:
        deviation = np.frombuffer(base64.b64decode(entry["deviation"]), "<i2").reshape(shape)
        assert (deviation[:, 0] == 0).all()
        assert (deviation[:, -1] != 0).any()
        error = np.frombuffer(base64.b64decode(entry["error"]), "<f4").reshape(shape[:2])
        assert (error[:, 0] == 0.0).all()
        assert (error[:, -1] > 0.0).all()


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
    none = "no trained model of it was tested"
    assert shift.left_out == dict.fromkeys(set(trainable()) - {"gns"}, none)
    assert refusal("gns", Graph.of(load_scene("balldrop"))) == ""
    assert "contact" in refusal("hgnn", Graph.of(load_scene("balldrop")))
    flat = Inertia(1.0, moments=(1.0, 1.0, 2.0))
    hinge = Joint("hinge", "hinge", "world", "plate", (0.0, 0.0, 1.0), (0.0, 1.0, 0.0))
    plate = Scene("plate", (Body("plate", inertia=flat),), 1.0, joints=(hinge,))
    assert "got joined bodies and no edges" in refusal("gns", Graph.of(plate))
    assert "points, which have no mass matrix for a flat body" in refusal("lgnn", Graph.of(plate))


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
