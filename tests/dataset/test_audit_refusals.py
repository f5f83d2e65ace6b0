"""Files that cannot be audited, each refused in one line."""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.audit import audit_file
from mbds_xsim.dataset.foreign import Provenance
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.registry import load_scene

from .foreign_files import INDEX, Arrays, Audit, only, write_csv


def _changed(rows: list[list[str]], line: int, column: int, text: str) -> list[list[str]]:
    rows[line][column] = text
    return rows


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rows: _changed(rows, 0, 1, "p0_q"), "got column 'p0_q', allowed for 1pendulum"),
        (lambda rows: _changed(rows, 0, 1, "p0_y"), "'p0_y' twice"),
        (lambda rows: [row[1:] for row in rows], "got no column 'time'"),
        (lambda rows: [row[:1] + row[2:] for row in rows], "p0_x is missing"),
        (lambda rows: [row[:1] for row in rows], "got no positions"),
        (
            lambda rows: _changed(rows, 3, 1, "nan"),
            "position: got nan in .*, frame 2; .* leave the",
        ),
        (lambda rows: _changed(rows, 3, 1, "x"), "frame 2, column p0_x: got 'x'"),
        (lambda rows: _changed(rows, 3, 1, "snan"), "frame 2, column p0_x: got 'snan'"),
        (lambda rows: _changed(rows, 3, 0, "0.045"), "time is not uniform: frame"),
        (lambda rows: _changed(rows, 3, 0, "inf"), "time: got inf in frame 2; allowed are finite"),
        (lambda rows: [*rows[:3], [*rows[3], "7"], *rows[4:]], "frame 2: got 5 cells, allowed are"),
        (lambda rows: rows[:2], "got 1 frame, allowed is"),
        (lambda rows: rows[:1] + rows[1::2], "got 5 steps of 0.04 s"),
        (lambda rows: [*rows, ["0.22", *rows[-1][1:]]], "got 11 steps of 0.02 s"),
    ],
)
def test_what_cannot_be_used_is_refused(
    change: Callable[[list[list[str]]], list[list[str]]],
    says: str,
    rod: Scene,
    swing: Arrays,
    tmp_path: Path,
) -> None:
    path = tmp_path / "it.csv"
    write_csv(path, rod, {"time": swing["time"], "position": swing["position"][0]})
    with path.open(newline="") as file:
        rows = change(list(csv.reader(file)))
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    with pytest.raises(InputError, match=says.replace("(", r"\(")) as caught:
        audit_file(path, rod, Provenance(index=(3,), seed=7))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"position": np.zeros((1, 11, 2, 3))}, "got shape (1, 11, 2, 3), allowed"),
        ({"speed": np.zeros(3)}, "got an array 'speed'"),
        ({"body/position": np.zeros((11, 1, 3))}, "belong together"),
        ({"velocity": np.zeros((1, 11, 1, 3))}, "different numbers of trajectories"),
        ({"position": np.array(["a"])}, "allowed are numbers"),
        (
            dict.fromkeys(("body/velocity", "body/angular_velocity"), np.zeros((2, 11, 1, 3))),
            "got body/velocity without body/position; give both",
        ),
        ({"input/torque": np.zeros((2, 10, 1))}, "(2, 10, 1), but 1pendulum has no hinges"),
    ],
)
def test_wrong_arrays_are_refused(
    change: Arrays, says: str, rod: Scene, swing: Arrays, audited: Audit
) -> None:
    with pytest.raises(InputError) as caught:
        audited(rod, only(swing, "position") | change)
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("fact", "value"),
    [
        ("index", np.array([3, -4])),
        ("index", np.array([3.0, 4.5])),
        ("seed", -1),
        ("seed", np.inf),
        ("method_order", 1.5),
        ("step_s", np.nan),
        ("step_s", 0.0),
        ("step_s", 5.0),  # of milliseconds
        ("contact_time_s", -1.0),
        ("contact_time_s", 5.0),  # of milliseconds
        ("noise", "perhaps"),
    ],
)
def test_wrong_facts_are_refused(
    fact: str, value: Any, rod: Scene, swing: Arrays, audited: Audit
) -> None:
    arrays = {"seed": np.array(7), "index": np.array(INDEX)} | only(swing, "position")
    with pytest.raises(InputError, match=rf"{fact}: got .*, allowed is ") as caught:
        audited(rod, arrays | {fact: np.array(value)}, Provenance())
    assert "\n" not in str(caught.value)


def test_numbers_of_starts_must_fit(rod: Scene, swing: Arrays, audited: Audit) -> None:
    with pytest.raises(InputError, match=r"--index: got 1 number, .* is one a trajectory, 2"):
        audited(rod, swing, Provenance(index=(3,)))
    one = {name: values[0] for name, values in only(swing, "position").items() if name != "time"}
    with pytest.raises(InputError, match="index: got 2 numbers, allowed is one a trajectory"):
        audited(rod, {"time": swing["time"], "index": np.arange(2)} | one, Provenance(seed=7))


@pytest.mark.parametrize("suffix", ["npz", "h5"])
def test_a_frame_that_no_scene_may_have_is_not_called_damage(
    suffix: str, rod: Scene, tmp_path: Path
) -> None:
    path = tmp_path / f"it.{suffix}"
    arrays = {"time": 1e-10 * np.arange(11), "position": np.zeros((11, 1, 3))}
    if suffix == "npz":
        np.savez(path, **arrays)  # type: ignore[arg-type]
    else:
        with h5py.File(path, "w") as file:
            file.update(arrays)
    with pytest.raises(InputError, match=rf"^{path}: frame: got 1e-10, allowed is 1e-09 or more"):
        audit_file(path, rod, Provenance())


def test_what_is_no_trajectory_at_all_is_one_line(tmp_path: Path) -> None:
    """A packed file that declares gigabytes is refused before it is unpacked."""
    with zipfile.ZipFile(tmp_path / "foreign.npz", "w") as archive:
        archive.writestr("notes.txt", "a text")
    with pytest.raises(InputError, match=r"holds notes\.txt, which is no array"):
        audit_file(tmp_path / "foreign.npz", None, Provenance())

    with zipfile.ZipFile(tmp_path / "cut.npz", "w") as archive:
        archive.writestr("time.npy", b"\x93NUMPY\x01\x00\x10\x00{'descr': garbage")
    with pytest.raises(InputError, match=r"holds time\.npy, which is no array"):
        audit_file(tmp_path / "cut.npz", None, Provenance())

    with zipfile.ZipFile(tmp_path / "sizeless.npz", "w") as archive:
        header = b"{'descr': '<U0', 'fortran_order': False, 'shape': ()}\n"
        archive.writestr("note.npy", b"\x93NUMPY\x01\x00" + bytes([len(header), 0]) + header)
    with pytest.raises(InputError, match=r"holds values of the type <U0; allowed are arrays of"):
        audit_file(tmp_path / "sizeless.npz", None, Provenance())

    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("position.npy", bytes(2**27))
    with pytest.raises(InputError, match="MB claim to unpack to 134 MB, allowed is 100"):
        audit_file(tmp_path / "bomb.npz", None, Provenance())

    (tmp_path / "wide.csv").write_text("time\n" + "1" * 200_000 + "\n0\n0\n")
    with pytest.raises(InputError, match=r"wide\.csv cannot be read as csv \(field larger"):
        audit_file(tmp_path / "wide.csv", load_scene("1pendulum"), Provenance())

    np.savez(tmp_path / "five.npz", time=np.arange(3.0), scene=5)
    with pytest.raises(InputError, match=r"five\.npz: its attribute scene is no scene"):
        audit_file(tmp_path / "five.npz", None, Provenance())


@pytest.mark.parametrize("key", ["step_s", "velocity_lag_s", "contact_time_s"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_times_that_are_no_numbers_are_refused(key: str, value: float) -> None:
    with pytest.raises(InputError, match=rf"^{key}: got .*, allowed are finite numbers$"):
        Provenance(**{key: value})  # type: ignore[arg-type]
