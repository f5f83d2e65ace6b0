"""Trained models next to engines: their measurements, their inputs, and refusals."""

from __future__ import annotations

import csv
from pathlib import Path

import msgspec
import pytest
import torch
from torch import Tensor

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import HERE, Conduct
from mbds_xsim.learn import simulator as simulating
from mbds_xsim.learn.gns import GNS
from mbds_xsim.learn.model_file import read_model
from mbds_xsim.learn.simulator import LearnedSimulator
from mbds_xsim.learn.trained import Known, known_start, particle_motion, trained_in
from mbds_xsim.learn.window import HISTORY, KnownInputs
from mbds_xsim.report.files import results_json, rows_csv, to_html, to_markdown
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.studies.tradeoff import AT_ONCE, Measurement, Tradeoff, learned, read_tradeoff
from mbds_xsim.studies.tradeoff import bench as measuring
from mbds_xsim.studies.tradeoff.bench import measure, references
from mbds_xsim.studies.tradeoff.learned import with_models
from mbds_xsim.studies.tradeoff.present import present, to_png
from mbds_xsim.studies.tradeoff.study import tradeoff_with_rows
from tests.command_line import CommandLine
from tests.learn.models import untrained

FRAMES = 60
pytestmark = pytest.mark.usefixtures("apart")


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A pendulum over little more than a second."""
    return msgspec.structs.replace(registry.load_scene("1pendulum"), clock=Clock(steps=FRAMES))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two models of the pendulum, and one of another."""
    folder = tmp_path_factory.mktemp("models")
    untrained(folder, "1pendulum", "mujoco")
    untrained(folder, "1pendulum", "all", seed=1)
    untrained(folder, "2pendulum", "mujoco")
    return folder


@pytest.fixture(scope="module")
def engines(scene: Scene) -> Tradeoff:
    """Trade-off of an engine at two starts, to which models are added."""
    study, _ = tradeoff_with_rows(
        scene, choice=Choice.parse(engines="pybullet"), starts=2, limit=2.0, conduct=HERE
    )
    return study


@pytest.fixture(scope="module")
def both(engines: Tradeoff, scene: Scene, folder: Path) -> tuple[Tradeoff, list[Measurement]]:
    """The engine and the models, of which a second place names one again."""
    return with_models(engines, scene, trained_in([folder, folder / "1pendulum"]), conduct=HERE)


class _Perfect(GNS):
    """Model that knows the motions by heart, whatever their batch."""

    truth: Tensor

    def predict(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        del inputs
        frames = torch.tensor([self._frame(one) for one in history])
        after = self.truth[0, frames + 1].to(history)
        return after - 2.0 * history[:, -1] + history[:, -2]

    def _frame(self, history: Tensor) -> int:
        apart = (self.truth[0].to(history) - history[-1]).square().sum((-1, -2))
        return min(int(apart.argmin()), self.truth.shape[1] - 2)


def test_engines_stay_as_they_were_and_models_of_other_scenes_are_left_out(
    engines: Tradeoff, both: tuple[Tradeoff, list[Measurement]]
) -> None:
    study, rows = both

    assert study.curves == engines.curves
    assert study.ratios == engines.ratios
    assert [model.name for model in study.models] == ["gns all-s1 native", "gns mujoco-s0 native"]
    (reason,) = [text for text in study.left_out.values() if "trained on" in text]
    assert reason == "1 trained on 2pendulum, not on this 1pendulum or its frames"
    assert len(rows) == 2 * 2 * 2  # models, starts, alone and in a batch
    assert {row.trajectory for row in rows} == set(engines.trajectories)


def test_a_point_has_cost_errors_and_what_training_took(
    both: tuple[Tradeoff, list[Measurement]],
) -> None:
    for model in both[0].models:
        alone, batched = model.alone, model.batched
        assert (alone.kind, batched.kind, alone.starts) == ("done", "done", 2)
        assert alone.wall_s is not None
        assert batched.wall_s is not None
        assert 0.0 < batched.wall_s < alone.wall_s
        assert alone.error_m is not None
        assert alone.error_m > 0.01
        assert alone.error_m == batched.error_m
        assert alone.gap_m is not None
        assert alone.energy is not None
        assert (model.train_wall_s, model.train_cpu_s, model.train_device) == (12.5, 12.0, "cpu")
        assert (model.known_frames, model.at_once) == (HISTORY, AT_ONCE)


@pytest.fixture(scope="module")
def starts(engines: Tradeoff, scene: Scene) -> tuple[Batch, Batch]:
    """The study's starts, and the same without random forces."""
    drawn = [
        draw_batch(scene, engines.trajectories, seed=engines.seed, noise=noise)
        for noise in (True, False)
    ]
    return drawn[0], drawn[1]


@pytest.mark.parametrize("together", [1, AT_ONCE])
def test_a_model_that_knows_the_motion_has_no_error(
    together: int, starts: tuple[Batch, Batch], scene: Scene, folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    drawn, quiet = starts
    (truth, _) = references(scene, drawn, HERE)
    trained = trained_in([folder / "1pendulum"])[0]
    model, _ = read_model(trained.file, scene)
    model.__class__ = _Perfect
    assert isinstance(model, _Perfect)
    due = particle_motion(model.graph, drawn[[0]], truth.trajectory)
    model.truth = torch.from_numpy(due.position)[None]
    monkeypatch.setattr(simulating, "read_model", lambda *_: (model, {}))
    simulator = LearnedSimulator.of(trained, "by heart", together=together, quiet=quiet)

    row = measure(simulator, scene, drawn[[0]], 1, truth)

    assert "kind" not in row
    assert row["error_m"] < 1e-4
    assert row["error_weighted_m"] < 1e-4
    # What random forces did is no merit of a model that happens to follow.
    assert row["energy"] < 0.05


def test_a_model_is_given_the_first_frames_and_no_random_forces(
    starts: tuple[Batch, Batch], scene: Scene, folder: Path
) -> None:
    drawn, quiet = starts
    model, _ = read_model(trained_in([folder / "1pendulum"])[0].file, scene)
    truth = references(scene, drawn, HERE)[0].trajectory

    known = known_start(model, truth, quiet[[0]])

    assert drawn.force.any()
    assert not known.inputs.force.any()
    assert known.inputs.force.shape[1] == FRAMES - HISTORY + 1
    due = particle_motion(model.graph, drawn[[0]], truth).position[None]
    assert known.start.history.numpy() == pytest.approx(due[:, :HISTORY], abs=1e-6)
    speed = (due[:, HISTORY] - due[:, HISTORY - 2]) / (2 * scene.clock.frame)
    assert known.start.velocity.numpy() == pytest.approx(speed, abs=0.01)
    assert _rows(known.repeated(5)) == 5


def _rows(known: Known) -> int:
    return len(known.start.history)


def test_a_lost_prediction_is_a_failed_point(
    engines: Tradeoff, scene: Scene, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path))

    def lost(*known: object) -> Tensor:
        del known
        rolled = torch.zeros(1, FRAMES - HISTORY + 1, 1, 3)
        rolled[:, 10:] = torch.nan
        return rolled

    monkeypatch.setattr(simulating, "carry_on", lost)
    study, _ = with_models(engines, scene, trained_in([folder / "1pendulum"])[:1], conduct=HERE)

    (model,) = study.models
    assert model.alone.kind == "failed"
    assert "not finite from 0.32 s on" in model.alone.reason
    assert model.alone.error_m is None
    assert "not finite" in to_markdown([present(study)])
    assert to_png([study])[:4] == b"\x89PNG"


def test_what_is_measured_is_kept(
    engines: Tradeoff, both: tuple[Tradeoff, list[Measurement]], scene: Scene, folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    fresh, _ = with_models(engines, scene, trained_in([folder]), conduct=Conduct(0, fresh=True))

    def refused(*anything: object) -> dict[str, object]:
        raise AssertionError(anything)

    monkeypatch.setattr(measuring, "measure", refused)
    again, _ = with_models(engines, scene, trained_in([folder]), conduct=HERE)

    assert again.models == fresh.models
    errors = [[m.alone.error_m for m in study.models] for study in (again, both[0])]
    assert errors[0] == errors[1]


def test_all_files_have_the_models(
    both: tuple[Tradeoff, list[Measurement]], tmp_path: Path
) -> None:
    study, rows = both
    (tmp_path / "study.json").write_bytes(results_json([study]))
    table = list(csv.DictReader(rows_csv(Measurement, rows).decode().splitlines()))
    page, words = to_html([present(study)], ""), to_markdown([present(study)])

    assert read_tradeoff(tmp_path / "study.json") == study
    assert {row["variation"] for row in table} == {"", f"{AT_ONCE} at a time"}
    assert "| gns | mujoco-s0 native |" in words
    for text in (page, words):
        assert "first 6 frames" in text
        assert "not told the random forces" in text.replace("\n", " ")
    assert page.count("training took 12 s") >= 4  # two models, alone and in a batch
    assert to_png([study])[:4] == b"\x89PNG"
    assert "rained models" not in to_markdown([present(msgspec.structs.replace(study, models=()))])


def test_a_study_of_another_scene_or_no_model_of_it_is_refused(
    engines: Tradeoff, scene: Scene, folder: Path
) -> None:
    longer = msgspec.structs.replace(scene, clock=Clock(steps=FRAMES + 1))

    with pytest.raises(InputError, match="is not of 1pendulum as it is now"):
        with_models(engines, longer, trained_in([folder]), conduct=HERE)
    with pytest.raises(InputError, match="1 trained on 2pendulum, not on this 1pendulum"):
        with_models(engines, scene, trained_in([folder / "2pendulum"]), conduct=HERE)


def test_where_the_reference_ends_at_once_nothing_can_be_given(
    engines: Tradeoff, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    car = registry.load_scene("particlecar")
    from mbds_xsim.scene.state import fingerprint

    study = msgspec.structs.replace(engines, fingerprint=fingerprint(car), trajectories=(1,))
    monkeypatch.setattr(learned, "models_of", lambda _, models: (models, {}))

    with pytest.raises(InputError, match="the reference ends within the 6 frames"):
        with_models(study, car, trained_in([folder]), conduct=HERE)


def test_the_command_puts_models_onto_a_stored_study(
    engines: Tradeoff, scene: Scene, folder: Path, tmp_path: Path, run: CommandLine
) -> None:
    from mbds_xsim.scene.file import write_scene

    names = ("scene.toml", "study.json", "both.json", "rows.csv")
    path, stored, out, rows = (tmp_path / name for name in names)
    path.write_text(write_scene(scene))
    stored.write_bytes(results_json([engines]))
    words = ["tradeoff", str(path), "--models", str(folder / "1pendulum"), "--onto", str(stored),
             "--json", str(out), "--csv", str(rows), "--workers", "1"]  # fmt: skip

    assert run(*words).code == 0

    study = read_tradeoff(out)
    assert study.curves == engines.curves
    assert len(study.models) == 2
    assert " && mbds-xsim tradeoff" in study.command
    assert [model.alone.reason for model in study.models] == ["", ""]
    assert len(rows.read_text().splitlines()) > len(study.models)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["1pendulum", "--onto", "x.json"], "--onto"),
        (["1pendulum", "2pendulum", "--onto", "x.json", "--models", "{models}"], "--onto"),
        (["1pendulum", "--onto", "{text}", "--models", "{models}"], "no result of one scene"),
        (["1pendulum", "--onto", "{text}", "--models", "{models}", "--starts", "5"], "leave --eng"),
        (["1pendulum", "--onto", "{text}", "--models", "{models}", "--engines", "dart"], "leave "),
        (["1pendulum", "--models", "{text}"], "no trained model"),
        (["1pendulum", "--models", "{models}/nowhere"], "no trained model"),
        (["ballscroll", "--models", "{models}"], "no trained models of ballscroll: 2 trained on"),
    ],
)
def test_bad_input_is_one_clear_line(
    words: list[str], told: str, folder: Path, tmp_path: Path, run: CommandLine
) -> None:
    (tmp_path / "text").write_text("{}")
    filled = [word.format(models=folder, text=tmp_path / "text") for word in words]
    assert told in run("tradeoff", *filled).refusal
