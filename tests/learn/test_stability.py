"""Trained models on the axes of the engines: where they hold, and what pages say of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import msgspec
import pytest
import torch
from torch import Tensor
from typer.testing import CliRunner

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import HERE
from mbds_xsim.commands import app
from mbds_xsim.learn import simulator as simulating
from mbds_xsim.learn.gns import GNS
from mbds_xsim.learn.model_file import read_model
from mbds_xsim.learn.simulator import LearnedSimulator, simulators_in
from mbds_xsim.learn.trained import trained_in
from mbds_xsim.learn.window import HISTORY, KnownInputs
from mbds_xsim.report.files import to_html, to_markdown
from mbds_xsim.scene.scene import Clock
from mbds_xsim.studies.stability import Outcome, Survey, words
from mbds_xsim.studies.stability.present import present, to_png
from mbds_xsim.studies.stability.studies import STUDIES
from mbds_xsim.studies.stability.survey import SurveyPlan, simulators_of, survey
from mbds_xsim.studies.stability.verdict import run_cell
from tests.command_line import CommandLine
from tests.learn.models import untrained
from tests.learn.motions import CLOCK, particles_of, solved

pytestmark = pytest.mark.usefixtures("apart")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small untrained model of a pendulum."""
    folder = tmp_path_factory.mktemp("models")
    untrained(folder, "2pendulum")
    return folder


class _Perfect(GNS):
    """Model that knows the reference by heart."""

    truth: Tensor
    frame = HISTORY

    def predict(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        del inputs
        after = self.truth[:, self.frame].to(history)
        self.frame += 1
        return after - 2.0 * history[:, -1] + history[:, -2]


def test_a_model_that_knows_the_motion_is_stable_from_the_frames_it_is_given(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, batch, truth = solved(STUDIES["swing"], 5.0)
    model, _ = read_model(next(folder.rglob("*.pt")), scene)
    model.__class__ = _Perfect
    assert isinstance(model, _Perfect)
    model.truth = torch.from_numpy(particles_of(scene, batch, truth).position)[None]
    monkeypatch.setattr(simulating, "read_model", lambda *_: (model, {}))

    cell = run_cell(simulators_in([folder])[0], scene, batch, 1, truth)

    assert cell["outcome"] == "stable"
    assert cell["error"] == pytest.approx(0.0, abs=1e-4)
    assert cell["wall_s"] > 0.0


@pytest.fixture(scope="module")
def sweep(folder: Path) -> Survey:
    """Survey of an engine's method and a model."""
    plan = SurveyPlan(
        STUDIES["swing"], ("mujoco",), ("RK4",), ("matched",), values=(0.0, 5.0), counts=(5, 10),
        conduct=HERE, others=simulators_in([folder]),
    )  # fmt: skip
    return survey(plan)


def test_a_model_has_a_panel_of_its_frame_beside_the_engine(sweep: Survey, folder: Path) -> None:
    engine, model = sweep.panels

    assert (engine.learned, len(engine.steps_s)) == (False, 2)
    assert (model.name, model.learned) == ("gns 2pendulum-mujoco-s0 native", True)
    assert model.steps_s == (0.02,)
    for (cell,) in model.cells:
        assert cell.failed
        assert cell.silent
        assert cell.told == "nobody"
        assert cell.duration_s == engine.cells[0][0].duration_s
        assert Path(cell.source).is_relative_to(folder)
        assert cell.broke_s is not None
        assert cell.broke_s >= HISTORY * 0.02 - 1e-9
    assert "torch" in sweep.versions


def test_what_was_predicted_is_kept_until_the_model_is_another(
    sweep: Survey, folder: Path, tmp_path: Path
) -> None:
    plan = SurveyPlan(
        STUDIES["swing"], values=(0.0, 5.0), conduct=HERE, others=simulators_in([folder])
    )
    again = survey(plan)
    path = untrained(tmp_path, "1pendulum")
    other = survey(dataclasses.replace(plan, others=simulators_in([path])))

    assert (again.measured, again.kept) == (0, 2)
    assert [row[0].outcome for row in again.panels[0].cells] == [
        row[0].outcome for row in sweep.panels[1].cells
    ]
    assert (other.measured, other.kept) == (2, 0)


def test_what_a_model_of_a_files_settings_predicted_is_kept(tmp_path: Path) -> None:
    others = simulators_in([untrained(tmp_path, "2pendulum", variant="fine")])
    plan = SurveyPlan(STUDIES["swing"], values=(0.0,), conduct=HERE, others=others)

    first, again = survey(plan), survey(plan)

    assert (first.measured, again.measured, again.kept) == (1, 0, 1)
    assert again.cells[0].profile == again.panels[0].profile == "fine"


def test_pages_tell_how_far_models_hold_and_how_to_run_a_cell_again(sweep: Survey) -> None:
    (name, text), _ = words.stable_ranges(sweep)
    cell = sweep.panels[1].cells[0][0]

    assert name == sweep.panels[1].name
    assert text.startswith("stable nowhere, on course nowhere; at 0 m/s ")
    assert text.endswith("told by nobody")
    assert f"--engines none --models {cell.source} --value 0" in words.command_of(cell, sweep)
    assert "first six" in to_markdown([present(sweep)])
    assert "first six" in to_html([present(sweep)], "")
    alone = msgspec.structs.replace(sweep, panels=sweep.panels[1:])
    assert words.conclusion(alone).endswith("none is stable")
    for each in (sweep, alone):
        assert to_png([each])[:4] == b"\x89PNG"
    assert "most stable: mujoco RK4 (4 of 4)" in words.conclusion(sweep)


def test_values_that_hold_are_told_as_ranges(sweep: Survey) -> None:
    model = sweep.panels[1]
    cell = model.cells[0][0]
    outcomes: list[tuple[float, Outcome]] = [
        (0.0, "off course"), (1.0, "stable"), (2.0, "stable"), (5.0, "comes apart"), (9.0, "stable")
    ]  # fmt: skip
    cells = tuple(
        (msgspec.structs.replace(cell, value=value, outcome=outcome, broke_s=0.5),)
        for value, outcome in outcomes
    )
    swept = msgspec.structs.replace(sweep, panels=(msgspec.structs.replace(model, cells=cells),))

    (_, text), _ = words.stable_ranges(swept)

    assert text == (
        "stable at 0 m/s to 2 m/s and at 9 m/s, on course at 1 m/s to 2 m/s and at 9 m/s; "
        "at 5 m/s comes apart from 500 ms on, told by nobody"
    )


def test_a_model_whose_process_ends_is_told_by_that(sweep: Survey) -> None:
    model = sweep.panels[1]
    crashed = msgspec.structs.replace(
        model.cells[0][0],
        outcome="crashed",
        told="process",
        reason="ValueError: no",
        broke_s=None,
        ended_s=None,
    )
    swept = msgspec.structs.replace(
        sweep, panels=(msgspec.structs.replace(model, cells=((crashed,), *model.cells[1:])),)
    )

    (_, text), _ = words.stable_ranges(swept)

    assert text.endswith("; at 0 m/s crashed, told by the process, by its end: ValueError: no")


def test_no_steps_are_said_to_be_tried_where_models_are_alone(sweep: Survey) -> None:
    alone = msgspec.structs.replace(sweep, panels=sweep.panels[1:])

    assert words.reading(sweep).startswith("in ms, of 20, 10 tried over 1 s; ")
    assert words.reading(alone).startswith("in ms, over 1 s; ")


def test_without_models_nothing_is_said_of_them() -> None:
    plan = SurveyPlan(
        STUDIES["swing"],
        ("mujoco",),
        ("RK4",),
        ("matched",),
        values=(0.0,),
        counts=(5,),
        conduct=HERE,
    )
    assert "first six" not in to_markdown([present(survey(plan))])


def test_a_scene_that_the_parameters_do_not_fit_is_left_out(folder: Path) -> None:
    ball = STUDIES["throw"]  # a ground and no anchor: other features at a node
    (model,) = simulators_in([folder])

    assert "its parameters do not fit ballscroll" in model.refusal(ball.scene(5.0))
    with pytest.raises(InputError, match="nothing to run in throw"):
        survey(SurveyPlan(ball, values=(5.0,), conduct=HERE, others=(model,)))


def test_without_a_reference_nothing_can_be_given_to_a_model(folder: Path) -> None:
    (model,) = simulators_in([folder])
    scene, batch, _ = solved(STUDIES["swing"], 0.0)

    with pytest.raises(InputError, match=r"nothing to run in wheels: .* no reference"):
        simulators_of(SurveyPlan(STUDIES["wheels"], values=(10.0,), others=(model,)))
    with pytest.raises(InputError, match="no reference"):
        run_cell(model, scene, batch, 1, None)


def test_frames_are_the_models_over_the_studys_time(folder: Path) -> None:
    (trained,) = trained_in([folder])
    slow = dataclasses.replace(
        trained, trained_on=msgspec.structs.replace(trained.scene, clock=Clock(0.1, 40))
    )

    usual = STUDIES["swing"].clock
    assert LearnedSimulator.of(trained, "").clock(usual) == CLOCK
    assert LearnedSimulator.of(slow, "").clock(usual) == Clock(0.1, 10)


@pytest.mark.parametrize(
    ("place", "told"),
    [
        ("nothing", "no trained model"),
        ("empty", r"no trained models \(\*.pt\)"),
        ("*.pt", r"no trained models \(\*.pt\)"),
    ],
)
def test_what_is_no_model_is_one_clear_line(
    tmp_path: Path, place: str, told: str, run: CommandLine
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "nothing").write_text("no model")
    words = ["stability", "swing", "--models", str(tmp_path / place), "--engines", "none"]
    assert run(*words).refusal
    with pytest.raises(InputError, match=told):
        simulators_in([tmp_path / place])


def test_results_name_files_as_the_user_did(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)

    (model,) = simulators_in([Path("2pendulum")])

    assert model.source == "2pendulum/native/gns/mujoco-s0.pt"
    assert model.trained.file.is_absolute()


def test_models_are_found_by_file_folder_and_pattern(folder: Path) -> None:
    path = folder / "2pendulum" / "native" / "gns" / "mujoco-s0.pt"

    for place in (path, folder, folder / "*" / "native" / "*" / "mujoco-s?.pt"):
        assert [trained.path for trained in trained_in([place])] == [path]


def test_the_command_runs_models_alone(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "map.csv"
    words = ["stability", "links", "--models", str(folder), "--engines", "none", "--value", "3",
             "--csv", str(out), "--workers", "1"]  # fmt: skip
    done = CliRunner().invoke(app, words)

    assert done.exit_code == 0, done.output
    header, row = out.read_text().splitlines()
    cells = dict(zip(header.split(","), row.split(","), strict=False))
    assert (cells["engine"], cells["family"], cells["value"]) == ("gns", "learned", "3.0")


@pytest.mark.parametrize("option", [("--step", "0.01"), ("--settings", "native")])
def test_steps_and_settings_are_refused_where_models_are_alone(
    folder: Path, run: CommandLine, option: tuple[str, str]
) -> None:
    words = ["stability", "links", "--models", str(folder), "--engines", "none", *option]

    assert f"{option[0]}: got it, but models step by frames" in run(*words).refusal
