"""`mbds-xsim inspect`: its counts, and a picture that shows the motion."""

from __future__ import annotations

import io
import json
import os
import shutil
from pathlib import Path

import h5py
import msgspec
import numpy as np
import pytest
from rich.console import Console

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.text import encoded
from mbds_xsim.commands.data import summary_blocks
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.dataset.shard import cause_of
from mbds_xsim.dataset.summary import draw_paths, summaries
from mbds_xsim.report.terminal import print_blocks
from mbds_xsim.report.themed import INTERVALS
from mbds_xsim.simulate.registry import load_scene
from tests.dataset.conftest import Make
from tests.fuzz.campaign import run_command

SET = "1pendulum/mujoco-matched"


@pytest.mark.parametrize(
    ("reason", "cause"),
    [
        ("kinematics: 3, allowed 1", "kinematics"),
        ("together: mass of rod: relative error 0.1", "together: mass of rod"),
        ("ended at frame 7", "ended early"),
    ],
)
def test_a_cause_is_the_check_that_failed(reason: str, cause: str) -> None:
    assert cause_of(reason) == cause


def test_counts_and_figures_are_those_of_the_files(whole: Path) -> None:
    (summary,) = summaries(whole)
    data = load_dataset(whole / f"{SET}.h5")
    assert (summary.drawn, summary.published, summary.rejected, summary.shards) == (40, 40, 0, 3)
    for part, counts in summary.counts.items():
        rows = data.rows_of(part)
        assert sum(counts.values()) == len(rows)
        assert counts["medium"] == int((data.index[rows] % 3 == 1).sum())
    energy = next(figure for figure in summary.figures if figure.check == "energy")
    column = list(data["check/name"]).index("energy")
    figures = np.asarray(data["check/figure"])[:, column]
    assert (energy.smallest, energy.largest) == (figures.min(), figures.max())
    assert energy.trajectories == 40
    assert energy.largest <= (energy.allowed or 0)
    sampled = next(figure for figure in summary.figures if figure.check == "error growth-weighted")
    assert sampled.trajectories == 3
    size = sum(path.stat().st_size for path in whole.rglob("*.h5") if path.name != "joint.h5")
    assert summary.bytes == size


def test_a_shard_has_no_split(whole: Path) -> None:
    (summary,) = summaries(whole / SET / "0000000016.h5")
    assert (summary.kind, summary.drawn, summary.shards) == ("shard", 16, 1)
    assert summary.counts == {"all": {"low": 5, "medium": 6, "high": 5}}


def test_rejected_ones_are_counted_by_reason(make: Make, tmp_path: Path) -> None:
    """Every trajectory fails a budget of no energy error at all."""

    scene = load_scene("1pendulum")
    strict = msgspec.structs.replace(scene.budget, energy=1e-15, energy_first_order=1e-15)
    scene = msgspec.structs.replace(
        scene, budget=strict, clock=msgspec.structs.replace(scene.clock, steps=10)
    )
    make(tmp_path, scene=scene, trajectories=3)
    (summary,) = summaries(tmp_path)
    assert (summary.published, summary.rejected) == (0, 3)
    assert summary.rejected_by == {"energy": 3}
    (aside,) = summaries(tmp_path / "rejected" / SET / "0000000000.h5")
    assert (aside.kind, aside.rejected_by) == ("rejected", {"energy": 3})
    stream = io.StringIO()
    print_blocks(summary_blocks(aside), Console(file=stream, width=120))
    assert "rejected, do not use as data" in stream.getvalue()
    assert "certified" not in stream.getvalue()
    with pytest.raises(InputError, match="has no trajectories to draw"):
        draw_paths(load_dataset(tmp_path / f"{SET}.h5"), tmp_path / "it.png")


def test_a_folder_whose_name_is_no_utf_8_has_a_summary_as_json(whole: Path, tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"\xff")
    shutil.copytree(whole, folder)

    ended = run_command("inspect", str(folder), "--json", str(tmp_path / "it.json"))

    assert ended.code == 0, ended
    assert "\\udcff" in json.loads((tmp_path / "it.json").read_text())[0]["file"]
    odd = {os.fsdecode(b"\xff"): [os.fsdecode(b"\xfe")]}
    assert json.loads(encoded(odd)) == {"\\udcff": ["\\udcfe"]}


def test_the_summary_can_be_read(whole: Path) -> None:
    stream = io.StringIO()
    print_blocks(summary_blocks(summaries(whole)[0]), Console(file=stream, width=120))
    text = stream.getvalue()
    for words in ("1pendulum", "joined, certified", "40 published and 0 rejected of 40", "✓"):
        assert words in text


def test_the_picture_shows_the_paths(whole: Path, tmp_path: Path) -> None:
    """Everything coloured in a panel has the colour of its interval."""
    from matplotlib.colors import to_rgb
    from matplotlib.image import imread

    target = tmp_path / "it.png"
    draw_paths(load_dataset(whole / f"{SET}.h5"), target)
    pixels = imread(target)[..., :3]
    third = pixels.shape[1] // 3
    colours = np.array([to_rgb(colour) for colour in INTERVALS])
    for k in range(3):
        panel = pixels[:, k * third : (k + 1) * third].reshape(-1, 3)
        strength = np.ptp(panel, axis=1)
        full = panel[strength > 0.8 * strength.max()]
        assert 10 < len(full) < 0.1 * len(panel)
        assert np.linalg.norm(np.median(full, axis=0) - colours, axis=1).argmin() == k
    again = tmp_path / "again.png"
    draw_paths(load_dataset(whole / f"{SET}.h5"), again)
    assert again.read_bytes() == target.read_bytes()


@pytest.mark.parametrize("text", ["name = [", 'name = "rod"', "\x1b[31m = 1"])
def test_a_scene_text_that_cannot_be_read_is_one_line(
    whole: Path, tmp_path: Path, text: str
) -> None:
    damaged = tmp_path / "damaged.h5"
    shutil.copy(whole / f"{SET}/0000000032.h5", damaged)
    with h5py.File(damaged, "a") as file:
        file.attrs["scene"] = text

    ended = run_command("inspect", damaged)

    assert ended.code == 2
    assert ended.err.startswith(f"mbds-xsim: {damaged}: ")
    assert "scene" in ended.err
