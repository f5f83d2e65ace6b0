"""An audit of a few trajectories at a time comes to the same as one of all at once."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset import foreign
from mbds_xsim.dataset.audit import audit_file
from mbds_xsim.dataset.foreign import Provenance
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import STATES


@pytest.mark.parametrize("form", ["h5", "npz", "compressed", "by columns"])
def test_pieces_of_a_file_are_as_the_whole(
    form: str, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The result does not depend on the number of trajectories in memory."""
    path = whole / "1pendulum" / "mujoco-matched" / "0000000016.h5"
    provenance = Provenance(index=tuple(range(16, 32)), seed=0, method_order=4, step_s=0.005)
    scene = load_dataset(path).scene
    if form != "h5":
        with h5py.File(path) as file:
            arrays = {name: file[name][()] for name in ("time", "position", "velocity")}
            arrays |= {f"body/{key}": file[f"body/{key}"][()] for key in STATES}
        if form == "by columns":
            arrays = {name: np.asfortranarray(values) for name, values in arrays.items()}
        path = tmp_path / "it.npz"
        (np.savez_compressed if form == "compressed" else np.savez)(path, **arrays)
    at_once = audit_file(path, scene, provenance)
    # Pieces have fewer trajectories than are compared with the reference.
    monkeypatch.setattr(foreign, "_AT_ONCE", 2 * 11)
    pieces = audit_file(path, scene, provenance)
    assert [len(finding.figures) for finding in pieces.findings] == [
        len(finding.figures) for finding in at_once.findings
    ]
    for one, other in zip(pieces.findings, at_once.findings, strict=True):
        assert (one.check, one.passed) == (other.check, other.passed)
        figures, others = (np.array(f.figures, dtype=np.float64) for f in (one, other))
        np.testing.assert_allclose(figures, others, rtol=1e-9)
        assert one.figure == pytest.approx(other.figure, rel=1e-9)
        assert one.trajectory == other.trajectory or abs(one.figure) < 1e-15  # rounding
        assert one.note == ""  # a note on a piece need not hold for all
    assert any(finding.note for finding in at_once.findings)
    assert pieces.taken == at_once.taken
    assert (pieces.trajectories, pieces.verdict) == (16, at_once.verdict)


def test_a_bad_trajectory_is_found_in_any_piece(
    rod: Scene, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = whole / "1pendulum" / "mujoco-matched" / "0000000016.h5"
    with h5py.File(path) as file:
        arrays = {f"body/{key}": file[f"body/{key}"][()] for key in STATES}
        arrays["time"] = file["time"][()]
    arrays["body/position"][5, 4] += 0.01
    np.savez(tmp_path / "it.npz", **arrays)
    monkeypatch.setattr(foreign, "_AT_ONCE", 4 * 11)
    provenance = Provenance(index=tuple(range(16, 32)), seed=0)
    for origin, number in ((provenance, 21), (Provenance(), 5)):
        result = audit_file(tmp_path / "it.npz", rod, origin)
        assert result.verdict == "fail"
        (line,) = [line for line in result.reasons if line.startswith("gap:")]
        assert f"trajectory {number} " in line
    arrays["body/position"][6, 4] = np.nan
    np.savez(tmp_path / "it.npz", **arrays)
    with pytest.raises(InputError, match="in trajectory 6, frame 4"):
        audit_file(tmp_path / "it.npz", rod, provenance)
