"""`mbds-xsim audit`: trajectories from elsewhere, right ones and planted wrong ones."""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.audit import Audited, audit_file
from mbds_xsim.dataset.foreign import Provenance
from mbds_xsim.dataset.points import Points, recover
from mbds_xsim.dataset.table import groups
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.scene.state import STATES, Batch, Trajectory
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.simulate.timed import simulate
from mbds_xsim.testing.joint_cases import JOINT_CASES

Arrays = dict[str, NDArray[Any]]

INDEX = (3, 4)
NAMED = Provenance(index=INDEX, seed=7)


def _run(scene: Scene) -> tuple[Batch, Trajectory]:
    contender = Choice.parse(engines="mujoco").contenders(scene)[0][0]
    batch = draw_batch(scene, INDEX, seed=7)
    return batch, simulate(scene, batch, "mujoco", contender.settings).trajectory


def _arrays(scene: Scene, batch: Batch, motion: Trajectory) -> Arrays:
    position, velocity = Points.of(scene).motion(motion)
    arrays: Arrays = {"time": motion.time, "position": position, "velocity": velocity}
    arrays |= {f"body/{key}": getattr(motion, key) for key in STATES}
    return arrays | {"input/force": batch.force, "input/torque": batch.torque}


@pytest.fixture(scope="module")
def swing(rod: Scene) -> Arrays:
    return _arrays(rod, *_run(rod))


@pytest.fixture(scope="module")
def drop() -> tuple[Scene, Arrays]:
    """A disc of 19 particles in a plane, which determine its rotation."""
    scene = load_scene("balldrop")
    return scene, _arrays(scene, *_run(scene))


Audit = Callable[..., Audited]


@pytest.fixture
def audited(tmp_path: Path) -> Audit:
    def run(scene: Scene, arrays: Arrays, provenance: Provenance = NAMED) -> Audited:
        np.savez(tmp_path / "it.npz", **arrays)  # type: ignore[arg-type]
        return audit_file(tmp_path / "it.npz", scene, provenance)

    return run


def _only(arrays: Arrays, *names: str) -> Arrays:
    return {name: arrays[name] for name in ("time", *names)}


def _checks(result: Audited) -> set[str]:
    return {finding.check for finding in result.findings}


def _failed(result: Audited) -> set[str]:
    return {finding.check for finding in result.findings if not finding.passed}


def test_all_checks_run_on_states_of_bodies(rod: Scene, swing: Arrays, audited: Audit) -> None:
    result = audited(rod, swing)
    assert result.reasons == ()
    assert {"finite", "start", "gap", "kinematics", "energy", "force", "particles"} <= _checks(
        result
    )
    assert {"error growth-weighted", "error of turns"} <= _checks(result)
    assert set(result.not_checked) == {"error at 1 s"}  # it lasts a fifth of a second


def test_velocities_of_particles_without_those_of_bodies_are_not_checked(
    rod: Scene, swing: Arrays, audited: Audit
) -> None:
    part = _only(swing, "body/position", "body/orientation", "velocity")
    result = audited(rod, part)
    assert result.not_checked["particle velocities"] == "no velocities of bodies"
    assert "particle velocities" in _checks(audited(rod, swing))


def test_float32_is_no_fault(rod: Scene, swing: Arrays, audited: Audit) -> None:
    coarse = {name: values.astype(np.float32) for name, values in swing.items()}
    result = audited(rod, coarse)
    assert result.verdict == "pass"
    assert any(line.startswith("rounding") for line in result.taken)


@pytest.mark.parametrize(
    ("name", "fault", "sees"),
    [
        ("body/position", lambda x: x + 0.001, {"start", "gap"}),
        ("body/velocity", lambda x: 1.02 * x, {"start", "energy", "momentum"}),
        ("body/velocity", lambda x: x[:, [0, *range(10)]], {"velocity lag", "energy"}),
        ("body/orientation", lambda x: 1.001 * x, {"finite"}),
        ("body/orientation", lambda x: x[..., [1, 2, 3, 0]], {"start", "gap"}),
        ("input/force", lambda x: 0.5 * x, {"force"}),
        ("position", lambda x: x[:, ::-1], {"particles"}),
        ("velocity", lambda x: -x, {"particle velocities"}),
    ],
)
def test_planted_faults_are_found(
    name: str,
    fault: Callable[[Any], Any],
    sees: set[str],
    rod: Scene,
    swing: Arrays,
    audited: Audit,
) -> None:
    result = audited(rod, swing | {name: fault(swing[name])})
    assert sees <= _failed(result)


def test_an_unnamed_start_is_the_files_own(rod: Scene, swing: Arrays, audited: Audit) -> None:
    result = audited(rod, swing, Provenance())
    assert result.verdict == "pass"
    errors = {"error at 1 s", "error growth-weighted", "error of turns"}
    assert {"start", *errors} == set(result.not_checked)
    assert "forces: those of the file" in result.taken


def test_an_order_that_friction_in_joints_lowers_is_told(audited: Audit) -> None:
    (brake,) = (case.scene for case in JOINT_CASES if case.name == "brake")
    scene = msgspec.structs.replace(brake, clock=Clock(steps=5))
    batch, motion = _run(scene)
    arrays = _only(_arrays(scene, batch, motion), *(f"body/{key}" for key in STATES))
    result = audited(scene, arrays, Provenance(method_order=4))
    assert (
        "method: of order 4, judged as of order 1 (forces have kinks), velocities at the frames"
        in result.taken
    )
    (energy,) = (one for one in result.findings if one.check == "energy")
    assert energy.budget == scene.budget.energy_first_order


def test_forces_that_are_not_told_are_missed(rod: Scene, swing: Arrays, audited: Audit) -> None:
    """Noise that acted but is not in the file must not pass as physics."""
    states = _only(swing, *(f"body/{key}" for key in STATES))
    without = audited(rod, states, Provenance())
    assert "forces: none but what the scene lists" in without.taken
    energy = {finding.check: finding.figure for finding in without.findings}["energy"]
    complete = audited(rod, swing, Provenance())
    assert energy > 100 * {one.check: one.figure for one in complete.findings}["energy"]


def test_a_wrong_turn_is_seen_beside_the_reference(
    rod: Scene, swing: Arrays, audited: Audit
) -> None:
    """A turn about the rod's own axis moves no particle."""
    q = swing["body/orientation"]
    about = rotation.from_vector(np.array([0.0, 0.0, 0.2]))
    turned = swing | {"body/orientation": rotation.multiply(q, np.broadcast_to(about, q.shape))}
    assert "error of turns" in _failed(audited(rod, turned))
    assert "error growth-weighted" not in _failed(audited(rod, turned))


def test_positions_alone_leave_velocities_unchecked(
    rod: Scene, swing: Arrays, audited: Audit
) -> None:
    result = audited(rod, _only(swing, "body/position", "body/orientation"))
    assert result.verdict == "pass"
    assert result.not_checked["energy"] == "no velocities"
    assert {"finite", "start", "gap"} <= _checks(result)
    assert not {"energy", "kinematics", "momentum"} & _checks(result)


def test_particles_of_a_rod_tell_its_length(rod: Scene, swing: Arrays, audited: Audit) -> None:
    result = audited(rod, _only(swing, "position"))
    assert result.verdict == "pass"
    assert {"rigidity", "start", "error growth-weighted"} == _checks(result)
    for left_out in ("energy", "error of turns"):
        assert "do not show how" in result.not_checked[left_out]
    longer = audited(rod, _only(swing | {"position": 1.01 * swing["position"]}, "position"))
    assert {"rigidity", "start"} <= _failed(longer)


def test_particles_of_a_disc_tell_all(drop: tuple[Scene, Arrays], audited: Audit) -> None:
    scene, arrays = drop
    result = audited(scene, _only(arrays, "position", "velocity"))
    assert result.reasons == ()
    assert {"start", "energy", "friction", "restitution", "rigidity"} <= _checks(result)
    assert {"error growth-weighted", "error of turns"} <= _checks(result)
    assert any("fitted" in line for line in result.taken)
    fit = recover(scene, arrays["position"], arrays["velocity"])
    for key in STATES[:1] + STATES[2:]:
        np.testing.assert_allclose(getattr(fit, key), arrays[f"body/{key}"], atol=1e-9)
    facing = np.abs(np.sum(fit.orientation * arrays["body/orientation"], axis=-1))
    np.testing.assert_allclose(facing, 1.0, atol=1e-12)


def test_rounding_does_not_excuse_another_start(drop: tuple[Scene, Arrays], audited: Audit) -> None:
    """A float32 start that is moved by a tenth of a millimetre, or sheared as little, fails."""
    scene, arrays = drop
    points = arrays["position"].astype(np.float32)
    assert "start" not in _failed(audited(scene, {"time": arrays["time"], "position": points}))
    turned = points + 1e-4 * (points[..., ::-1] - points.mean(axis=2, keepdims=True))
    for moved in (points + np.float32(1e-4), turned):
        assert "start" in _failed(audited(scene, {"time": arrays["time"], "position": moved}))


def test_a_learned_models_wobble_is_seen(drop: tuple[Scene, Arrays], audited: Audit) -> None:
    scene, arrays = drop
    shake = np.random.default_rng(0).normal(scale=1e-3, size=arrays["position"].shape)
    result = audited(scene, _only(arrays | {"position": arrays["position"] + shake}, "position"))
    assert "rigidity" in _failed(result)


def test_files_of_each_kind_say_the_same(
    rod: Scene, swing: Arrays, tmp_path: Path, audited: Audit
) -> None:
    one = {name: values if name == "time" else values[0] for name, values in swing.items()}
    provenance = Provenance(index=INDEX[:1], seed=7)
    expected = audited(rod, one, provenance)
    _write_csv(tmp_path / "it.csv", rod, one)
    with h5py.File(tmp_path / "it.h5", "w") as file:
        for name, values in one.items():
            file[name] = values
    for name in ("it.csv", "it.h5"):
        result = audit_file(tmp_path / name, rod, provenance)
        assert result.findings == expected.findings


def test_times_may_be_rounded(rod: Scene, swing: Arrays, tmp_path: Path, audited: Audit) -> None:
    """Long float32 recordings, and milliseconds in CSV, have rounded times."""
    late = swing | {"time": (swing["time"] + 100.0).astype(np.float32)}
    assert audited(rod, late).verdict == "pass"
    scene = msgspec.structs.replace(rod, clock=Clock(frame=1 / 60, steps=12))
    exact = _arrays(scene, *_run(scene))
    one = {name: values if name == "time" else values[0] for name, values in exact.items()}
    _write_csv(tmp_path / "it.csv", scene, one | {"time": one["time"].round(3)})
    result = audit_file(tmp_path / "it.csv", scene, Provenance(index=INDEX[:1], seed=7))
    assert (result.verdict, result.frame_s) == ("pass", 1 / 60)


@pytest.mark.parametrize("shown", [str, "{:.6e}".format, "{:.7f}".format])
def test_digits_of_a_constant_column_excuse_nothing(
    shown: Callable[[float], str], drop: tuple[Scene, Arrays], tmp_path: Path
) -> None:
    """A column 0.0 says nothing of the others' digits; all are as fine as they are written."""
    scene, arrays = drop
    one = {name: values if name == "time" else values[0] for name, values in arrays.items()}
    one |= {"input/force": 0.0 * one["input/force"]}
    origin = Provenance(index=INDEX[:1], seed=7)
    off = dict(zip("xyz", np.diag([0.009, 0.0, 0.0]), strict=True))["x"]
    moved = one | {"body/position": one["body/position"] + off}
    turned = one | {"body/orientation": 1.04 * one["body/orientation"]}
    failed = []
    for case in (one, moved, turned):
        _write_csv(tmp_path / "it.csv", scene, case, shown)
        failed.append(_failed(audit_file(tmp_path / "it.csv", scene, origin)))
    assert not {"start", "finite"} & failed[0]
    assert "force" in failed[0]
    assert "start" in failed[1]
    assert "finite" in failed[2]


@pytest.mark.parametrize("suffix", ["npz", "h5"])
def test_the_index_of_one_trajectory_may_be_a_scalar(
    suffix: str, rod: Scene, swing: Arrays, tmp_path: Path
) -> None:
    one = {name: values if name == "time" else values[0] for name, values in swing.items()}
    if suffix == "npz":
        np.savez(tmp_path / "it.npz", index=INDEX[0], seed=7, **one)  # type: ignore[arg-type]
    else:
        with h5py.File(tmp_path / "it.h5", "w") as file:
            file.attrs["index"], file.attrs["seed"] = INDEX[0], 7
            for name, values in one.items():
                file[name] = values
    result = audit_file(tmp_path / f"it.{suffix}", rod, Provenance())
    assert (result.verdict, "start" in _checks(result)) == ("pass", True)
    assert f"seed 7, index {INDEX[0]}," in result.taken[0]
    other = audit_file(tmp_path / f"it.{suffix}", rod, Provenance(index=INDEX[1:]))
    assert "start" in _failed(other)


def test_rounding_hides_no_missing_frame(rod: Scene, swing: Arrays, tmp_path: Path) -> None:
    one = {name: values if name == "time" else values[0] for name, values in swing.items()}
    lost = {name: np.delete(values, 4, axis=0) for name, values in one.items()}
    _write_csv(tmp_path / "it.csv", rod, lost | {"time": lost["time"].round(2)})
    with pytest.raises(InputError, match="time is not uniform: frame 4"):
        audit_file(tmp_path / "it.csv", rod, Provenance())


def _write_csv(path: Path, scene: Scene, one: Arrays, shown: Callable[[float], str] = repr) -> None:
    columns, names = [one["time"].tolist()], ["time"]
    for group in groups(scene):
        if group.name in one:
            values = one[group.name].reshape(len(one[group.name]), -1)
            names += group.columns.ravel().tolist()
            padded = [[shown(value) for value in column] for column in values.T.tolist()]
            columns += [column + [""] * (len(one["time"]) - len(column)) for column in padded]
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([names, *zip(*columns, strict=True)])


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
        (lambda rows: _changed(rows, 3, 1, "nan"), "position: got nan in trajectory 0, frame 2"),
        (lambda rows: _changed(rows, 3, 1, "x"), "frame 2, column p0_x: got 'x'"),
        (lambda rows: _changed(rows, 3, 1, "snan"), "frame 2, column p0_x: got 'snan'"),
        (lambda rows: _changed(rows, 3, 0, "0.045"), "time is not uniform: frame"),
        (lambda rows: _changed(rows, 3, 0, "inf"), "time: got inf in frame 2; allowed are finite"),
        (lambda rows: rows[:2], "got 1 frames"),
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
    _write_csv(path, rod, {"time": swing["time"], "position": swing["position"][0]})
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
    ],
)
def test_wrong_arrays_are_refused(
    change: Arrays, says: str, rod: Scene, swing: Arrays, audited: Audit
) -> None:
    with pytest.raises(InputError) as caught:
        audited(rod, _only(swing, "position") | change)
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
        ("contact_time_s", -1.0),
        ("noise", "perhaps"),
    ],
)
def test_wrong_facts_are_refused(
    fact: str, value: Any, rod: Scene, swing: Arrays, audited: Audit
) -> None:
    arrays = {"seed": np.array(7), "index": np.array(INDEX)} | _only(swing, "position")
    with pytest.raises(InputError, match=rf"{fact}: got .*, allowed is ") as caught:
        audited(rod, arrays | {fact: np.array(value)}, Provenance())
    assert "\n" not in str(caught.value)


def test_numbers_of_starts_must_fit(rod: Scene, swing: Arrays, audited: Audit) -> None:
    with pytest.raises(InputError, match="--index: got 1 numbers"):
        audited(rod, swing, Provenance(index=(3,)))
    one = {name: values[0] for name, values in _only(swing, "position").items() if name != "time"}
    with pytest.raises(InputError, match="index: got 2 numbers, allowed is one a trajectory"):
        audited(rod, {"time": swing["time"], "index": np.arange(2)} | one, Provenance(seed=7))


def test_a_data_set_can_be_audited_too(whole: Path) -> None:
    shard = whole / "1pendulum" / "mujoco-matched" / "0000000016.h5"
    result = audit_file(shard, None, Provenance())
    assert (result.verdict, result.trajectories) == ("pass", 16)
    assert any("seed 0, index 16 … 31" in line for line in result.taken)


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
