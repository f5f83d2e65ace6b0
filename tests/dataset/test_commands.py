"""`mbds-xsim generate`, `verify` and others: their output and their exit codes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import h5py
import pytest

from mbds_xsim.dataset.shard import LOG
from mbds_xsim.scene.file import save_scene
from mbds_xsim.scene.scene import Scene

Ended = subprocess.CompletedProcess[str]


@pytest.fixture(scope="module")
def folder(rod: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("commands")
    save_scene(rod, folder / "rod.toml")
    return folder


def _run(folder: Path, *words: str) -> Ended:
    return subprocess.run(
        [sys.executable, "-m", "mbds_xsim", *words],
        cwd=folder,
        env=os.environ | {"COLUMNS": "200"},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )


@pytest.fixture(scope="module")
def made(folder: Path) -> Ended:
    words = ("generate", "rod.toml", "--engines", "mujoco", "--settings", "matched,native")
    return _run(folder, *words, "--trajectories", "4", "--out", "data", "--json", "counts.json")


def test_generate_tells_what_came_of_it(made: Ended, folder: Path) -> None:
    assert (made.returncode, made.stderr) == (0, "")
    assert "1pendulum/mujoco-native.h5" in made.stdout
    assert "8 trajectories made in" in made.stdout
    counts = json.loads((folder / "counts.json").read_text())
    assert [row["published"] for row in counts["variants"]] == [4, 4]
    facts = json.loads((folder / "data/1pendulum/mujoco-matched" / LOG).read_text())
    assert facts["count"] == 4
    assert facts["simulate_s"] > 0


def test_verify_tells_what_the_data_are(made: Ended, folder: Path) -> None:
    assert made.returncode == 0
    ended = _run(folder, "verify", "data")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "certified; 4 of 4 published, with noise, seed 0" in ended.stdout
    assert "uncertified; 4 of 4 published" in ended.stdout
    assert "3 simulated again: the same bits (2 files)" in ended.stdout
    assert "7 files, 8 trajectories checked: everything holds what it says" in ended.stdout


def test_verify_ends_with_1_where_something_is_wrong(made: Ended, folder: Path) -> None:
    assert made.returncode == 0
    path = folder / "data/1pendulum/mujoco-native/0000000000.h5"
    whole = path.read_bytes()
    with h5py.File(path, "r+") as file:
        file["position"][1, 2] += 0.01
    ended = _run(folder, "verify", str(path))
    path.write_bytes(whole)
    assert ended.returncode == 1
    assert "✗" in ended.stdout
    assert "checksum: dataset position is not what was written" in ended.stdout


def test_a_set_goes_out_and_is_audited(made: Ended, folder: Path) -> None:
    assert made.returncode == 0
    words = ("export", "data", "--out", "out", "--format", "csv", "--indices", "1")
    ended = _run(folder, *words)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "2 trajectories in 2 files" in ended.stdout
    assert "not carried over:" in ended.stdout
    file = folder / "out/1pendulum/mujoco-matched/0000000001.csv"
    ended = _run(folder, "audit", str(file), "--scene", "rod.toml", "--json", "found.json")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "every check that ran holds" in ended.stdout
    assert json.loads((folder / "found.json").read_text())["verdict"] == "pass"
    lines = file.read_text().splitlines()
    cells = lines[-1].split(",")
    cells[lines[-12].split(",").index("b0_z")] = "0.5"
    file.write_text("\n".join([*lines[:-1], ",".join(cells)]))
    ended = _run(folder, "audit", str(file), "--scene", "rod.toml")
    assert ended.returncode == 1
    assert "out of budget on 1 trajectory of 1pendulum: gap, " in ended.stdout


def test_reference_solutions_that_cannot_be_kept_are_one_line(
    made: Ended, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert made.returncode == 0
    monkeypatch.setenv("MBDS_XSIM_CACHE", "/proc/nowhere")
    ended = _run(folder, "audit", "data/1pendulum/mujoco-matched.h5")
    assert ended.returncode == 0
    (line,) = ended.stderr.splitlines()
    told = "mbds-xsim: reference solutions are not kept: cannot write to /proc/nowhere: No such"
    assert line.startswith(told)


def test_inspect_tells_and_draws(made: Ended, folder: Path) -> None:
    assert made.returncode == 0
    ended = _run(folder, "inspect", "data/1pendulum/mujoco-native.h5", "--png", "paths.png")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "4 published and 0 rejected of 4" in ended.stdout
    assert (folder / "paths.png").read_bytes().startswith(b"\x89PNG")
    ended = _run(folder, "inspect", "data", "--png", "both.png")
    assert ended.returncode == 2
    assert "--png: data holds 2 data sets; name one of them" in ended.stderr


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("generate rod.toml --out data --trajectories 0", "--trajectories"),
        ("generate rod.toml --trajectories 3", "Missing option '--out'"),
        ("generate --out data", "Missing argument 'SCENE…'"),
        ("generate rod.toml --engines ode --out new", "no engine is called 'ode'"),
        ("generate rod.toml --settings best --out new", "no settings profile is called 'best'"),
        ("generate rod.toml --out rod.toml", "--out: cannot write to rod.toml"),
        ("audit rod.toml --scene rod.toml", "got a file .toml, allowed is .npz, .csv, .h5"),
        ("audit . --scene rod.toml", ".: this is no file but a folder, a pipe or a device"),
        ("export nothing --out new --format npz", "nothing: there is no such file or folder"),
        ("inspect rod.toml", "rod.toml cannot be read as HDF5"),
        ("plan rod.toml --engines ode", "no engine is called 'ode'"),
        ("verify nothing.h5", "nothing.h5: there is no such file"),
        ("verify .git", ".git: there is no such file"),
    ],
)
def test_bad_input_is_one_line(words: str, says: str, folder: Path) -> None:
    ended = _run(folder, *words.split())
    assert ended.returncode == 2
    assert says in ended.stderr
    assert len(ended.stderr.splitlines()) == 1
    assert not (folder / "new").exists()
