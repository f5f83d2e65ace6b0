"""Files that are audited: of each kind, with rounded numbers, and of a data set."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import msgspec
import numpy as np
import pytest

from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.audit import audit_file
from mbds_xsim.dataset.foreign import Provenance
from mbds_xsim.scene.scene import Clock, Scene

from .foreign_files import (
    FIRST,
    INDEX,
    Arrays,
    Audit,
    checks_of,
    failed_in,
    first_of,
    simulated,
    write_csv,
)


def test_files_of_each_kind_say_the_same(
    rod: Scene, swing: Arrays, tmp_path: Path, audited: Audit
) -> None:
    one = first_of(swing)
    expected = audited(rod, one, FIRST)
    write_csv(tmp_path / "it.csv", rod, one)
    with h5py.File(tmp_path / "it.h5", "w") as file:
        for name, values in one.items():
            file[name] = values
    for name in ("it.csv", "it.h5"):
        result = audit_file(tmp_path / name, rod, FIRST)
        assert result.findings == expected.findings


def test_times_may_be_rounded(rod: Scene, swing: Arrays, tmp_path: Path, audited: Audit) -> None:
    """Long float32 recordings, and milliseconds in CSV, have rounded times."""
    late = swing | {"time": (swing["time"] + 100.0).astype(np.float32)}
    assert audited(rod, late).verdict == "pass"
    scene = msgspec.structs.replace(rod, clock=Clock(frame=1 / 60, steps=12))
    one = first_of(simulated(scene))
    write_csv(tmp_path / "it.csv", scene, one | {"time": one["time"].round(3)})
    result = audit_file(tmp_path / "it.csv", scene, FIRST)
    assert (result.verdict, result.frame_s) == ("pass", 1 / 60)


def test_frames_that_are_not_the_scenes_are_told(rod: Scene, swing: Arrays, audited: Audit) -> None:
    """Times in milliseconds would otherwise be very slow motion."""
    slow = audited(rod, swing | {"time": 1000.0 * swing["time"]}, Provenance())
    assert "frames: every 20 s, as its times are in seconds; the scene's are every 0.02 s" in (
        slow.taken
    )
    assert not any("frames" in line for line in audited(rod, swing, Provenance()).taken)


@pytest.mark.parametrize("shown", [str, "{:.6e}".format, "{:.7f}".format])
def test_digits_of_a_constant_column_excuse_nothing(
    shown: Callable[[float], str], drop: tuple[Scene, Arrays], tmp_path: Path
) -> None:
    """A column 0.0 says nothing of the others' digits; all are as fine as they are written."""
    scene, arrays = drop
    one = first_of(arrays)
    one |= {"input/force": 0.0 * one["input/force"]}
    off = dict(zip("xyz", np.diag([0.009, 0.0, 0.0]), strict=True))["x"]
    moved = one | {"body/position": one["body/position"] + off}
    turned = one | {"body/orientation": 1.04 * one["body/orientation"]}
    failed = []
    for case in (one, moved, turned):
        write_csv(tmp_path / "it.csv", scene, case, shown)
        failed.append(failed_in(audit_file(tmp_path / "it.csv", scene, FIRST)))
    assert not {"start", "finite"} & failed[0]
    assert "force" in failed[0]
    assert "start" in failed[1]
    assert "finite" in failed[2]


@pytest.mark.parametrize("shown", ["{:.4e}".format, "{:.5g}".format])
def test_numbers_of_few_digits_are_rounded_by_their_size(
    shown: Callable[[float], str], rod: Scene, swing: Arrays, tmp_path: Path
) -> None:
    """A number near 0 shows more decimals than the others have."""
    one = first_of(swing)
    found = []
    for off in (1.0, 1.001):
        case = one | {"input/force": off * one["input/force"]}
        write_csv(tmp_path / "it.csv", rod, case, shown)
        found.append(failed_in(audit_file(tmp_path / "it.csv", rod, FIRST)))
    assert found == [set(), {"force"}]
    times = {"time": np.arange(61) / 30.0, "position": np.ones((61, 1, 3))}
    write_csv(tmp_path / "it.csv", rod, times, shown)
    frame = audit_file(tmp_path / "it.csv", rod, Provenance()).frame_s
    assert frame == pytest.approx(1 / 30, rel=1e-4)


@pytest.mark.parametrize("decimals", [5, 6, 8])
def test_the_rounded_start_of_a_small_mechanism_is_no_fault(
    decimals: int, rod: Scene, swing: Arrays, tmp_path: Path
) -> None:
    """The figure is over the scene's length of half a metre, by which rounding counts double."""
    one = first_of({name: swing[name] for name in swing if name.startswith(("time", "body", "in"))})
    for off, failed in ((0.0, set()), (10.0 * 10.0**-decimals, {"start"})):
        moved = one | {"body/position": one["body/position"] + off}
        write_csv(tmp_path / "it.csv", rod, moved, f"{{:.{decimals}f}}".format)
        result = audit_file(tmp_path / "it.csv", rod, FIRST)
        assert failed_in(result) & {"start", "finite"} == failed


@pytest.mark.parametrize("decimals", [4, 3])
def test_rounded_bodies_still_carry_their_particles(
    decimals: int, drop: tuple[Scene, Arrays], tmp_path: Path
) -> None:
    """What rounding does to the other checks is told; more than it does is found."""
    scene, arrays = drop
    one = first_of(arrays)
    for off in (0.0, 100.0 * 10.0**-decimals):
        moved = one | {key: one[key] + off for key in ("position", "velocity")}
        write_csv(tmp_path / "it.csv", scene, moved, f"{{:.{decimals}f}}".format)
        result = audit_file(tmp_path / "it.csv", scene, FIRST)
        carried = {"particles", "particle velocities"}
        assert failed_in(result) & carried == (carried if off else set())
        assert any(f"known to 5e-0{decimals + 1} m only" in line for line in result.taken)


@pytest.mark.parametrize("suffix", ["npz", "h5"])
def test_the_index_of_one_trajectory_may_be_a_scalar(
    suffix: str, rod: Scene, swing: Arrays, tmp_path: Path
) -> None:
    one = first_of(swing)
    if suffix == "npz":
        np.savez(tmp_path / "it.npz", index=INDEX[0], seed=7, **one)  # type: ignore[arg-type]
    else:
        with h5py.File(tmp_path / "it.h5", "w") as file:
            file.attrs["index"], file.attrs["seed"] = INDEX[0], 7
            for name, values in one.items():
                file[name] = values
    result = audit_file(tmp_path / f"it.{suffix}", rod, Provenance())
    assert (result.verdict, "start" in checks_of(result)) == ("pass", True)
    assert f"seed 7, index {INDEX[0]}," in result.taken[0]
    other = audit_file(tmp_path / f"it.{suffix}", rod, Provenance(index=INDEX[1:]))
    assert "start" in failed_in(other)


def test_indices_may_be_an_attribute(rod: Scene, swing: Arrays, tmp_path: Path) -> None:
    for seed, failed in ((7, set()), (8, {"start"})):
        with h5py.File(tmp_path / "it.h5", "w") as file:
            file.attrs["index"], file.attrs["seed"] = INDEX, seed
            file.update(swing)
        result = audit_file(tmp_path / "it.h5", rod, Provenance())
        assert failed_in(result) & {"start"} == failed


def test_rounding_hides_no_missing_frame(rod: Scene, swing: Arrays, tmp_path: Path) -> None:
    one = first_of(swing)
    lost = {name: np.delete(values, 4, axis=0) for name, values in one.items()}
    write_csv(tmp_path / "it.csv", rod, lost | {"time": lost["time"].round(2)})
    with pytest.raises(InputError, match="time is not uniform: frame 4"):
        audit_file(tmp_path / "it.csv", rod, Provenance())


def test_a_data_set_can_be_audited_too(whole: Path) -> None:
    shard = whole / "1pendulum" / "mujoco-matched" / "0000000016.h5"
    result = audit_file(shard, None, Provenance())
    assert (result.verdict, result.trajectories) == ("pass", 16)
    assert any("seed 0, index 16 … 31" in line for line in result.taken)
