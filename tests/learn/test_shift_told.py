"""What a study tells: its protocol, its answers at each frame, and all files."""

from __future__ import annotations

import base64
import csv
import json
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from matplotlib.figure import Figure

from mbds_xsim.commands import app
from mbds_xsim.learn.gns import GNS
from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.studies.shift.figures import draw_curves
from mbds_xsim.studies.shift.present import present, protocol
from mbds_xsim.studies.shift.tables import tables
from tests.learn.shifts import SCENE, SEEDS, TRAININGS, shift_of

pytestmark = pytest.mark.usefixtures("apart")


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


def test_answers_and_tables_are_given_at_the_frame_asked_for(studied: Path, shift: Shift) -> None:
    early = shift_of(studied, at=1)
    assert (shift.at, early.at) == (10, 1)
    assert (shift.kept, early.kept) == (0, len(shift.models))
    assert f", {early.kept} of {early.kept} models tested before" in present(early).made
    assert "At t = 10 on native data" in shift.answers[0].answer
    assert "At t = 1 on native data" in early.answers[0].answer
    assert early.gaps == shift.gaps
    titles = [next(tables(result)).title for result in (shift, early)]
    assert titles == [f"Which model survives which change at t = {frame}" for frame in (10, 1)]


def test_the_command_writes_all_files(
    studied: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    predict = GNS.predict
    monkeypatch.setattr(GNS, "predict", lambda *given: print("hello") or predict(*given))
    names = {kind: str(tmp_path / f"out.{kind}") for kind in ("json", "csv", "html", "png", "md")}
    words = ["shift", str(studied / "models"), str(studied / "data"), "--workers", "2"]
    words += 2 * ["--scene", SCENE]  # named twice, it is studied once
    words += ["--json", names["json"], "--csv", names["csv"], "--html", names["html"]]
    words += ["--png", names["png"], "--markdown", names["md"]]
    words += ["--rollouts", str(tmp_path / "rollouts.png")]
    app(words, standalone_mode=False)
    text, apart = capsys.readouterr()
    assert "Is a shift resolvable?" in text
    assert "hello" in apart, "what a model prints is not in the output, which may be JSON"
    assert "hello" not in text
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
    for picture in (Path(names["png"]), tmp_path / "rollouts.png"):
        assert picture.read_bytes().startswith(b"\x89PNG")
    assert "NaN" not in json.dumps(json.loads(Path(names["json"]).read_text()))


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
