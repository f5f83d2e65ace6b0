"""Reference solutions kept on disk."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim.reference import cache, sensitivity, solve
from mbds_xsim.reference.compiled import march_compiled
from mbds_xsim.reference.marching import Marched
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Joint, Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.testing import CASES
from mbds_xsim.testing.case import even

SCENE = load_scene("5pendulum")
BATCH = draw_batch(SCENE, [0, 1]).truncated(3)


@pytest.fixture(autouse=True)
def _directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path))


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Record the sizes of the batches that are integrated."""
    sizes: list[int] = []

    def counted(*args: Any, **options: Any) -> Marched:
        result = march_compiled(*args, **options)
        sizes.append(len(result.states))
        return result

    monkeypatch.setattr("mbds_xsim.reference.compiled.march_compiled", counted)
    return sizes


def files(directory: Path) -> list[Path]:
    return [path for path in directory.rglob("*") if path.is_file()]


def test_second_call_reads_what_the_first_wrote(tmp_path: Path, computed: list[int]) -> None:
    first, second = solve(SCENE, BATCH), solve(SCENE, BATCH)
    assert computed == [2]
    assert len(files(tmp_path)) == 2
    for field in ("time", "position", "orientation", "velocity", "angular_velocity", "failures"):
        np.testing.assert_array_equal(getattr(first, field), getattr(second, field))


def test_only_missing_trajectories_are_computed(computed: list[int]) -> None:
    solve(SCENE, BATCH[[1]])
    both = solve(SCENE, BATCH)
    assert computed == [1, 1]
    np.testing.assert_array_equal(both.position[:, 0], BATCH.position)


def test_nothing_is_kept_where_it_is_forbidden(tmp_path: Path, computed: list[int]) -> None:
    solve(SCENE, BATCH)
    before = files(tmp_path)
    solve(SCENE, BATCH, cache=False, rtol=1e-10)
    solve(SCENE, BATCH, cache=False)
    assert computed == [2, 2, 2]
    assert files(tmp_path) == before


def test_damaged_entries_are_computed_again(tmp_path: Path, computed: list[int]) -> None:
    whole = solve(SCENE, BATCH)
    cut, flipped = files(tmp_path)
    cut.write_bytes(cut.read_bytes()[:500])
    content = bytearray(flipped.read_bytes())
    content[len(content) // 2] ^= 0xFF
    flipped.write_bytes(bytes(content))
    again = solve(SCENE, BATCH)
    assert computed == [2, 2]
    np.testing.assert_array_equal(whole.position, again.position)
    solve(SCENE, BATCH)
    assert computed == [2, 2]


def _shift(path: Path) -> None:
    """Write a valid file with numbers that differ from the stored ones."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    states = {name: values for name, values in arrays.items() if values.dtype.kind == "f"}
    with path.open("wb") as stream:
        np.savez(stream, **arrays | {name: values + 1e-3 for name, values in states.items()})


def _rename(path: Path) -> None:
    with np.load(path) as file:
        first, *rest = file.files
        arrays = {"other": file[first], **{name: file[name] for name in rest}}
    with path.open("wb") as stream:
        np.savez(stream, **arrays)


def _exchange(path: Path) -> None:
    """Replace the entry by that of another trajectory."""
    other = next(each for each in files(cache.directory()) if each != path)
    path.write_bytes(other.read_bytes())


@pytest.mark.parametrize("change", [_shift, _rename, _exchange])
def test_entries_that_were_changed_are_computed_again(
    change: Callable[[Path], None], tmp_path: Path, computed: list[int]
) -> None:
    whole = solve(SCENE, BATCH)
    change(files(tmp_path)[0])
    again = solve(SCENE, BATCH)
    assert computed == [2, 1]
    np.testing.assert_allclose(again.position, whole.position, rtol=0, atol=1e-12)


def test_key_follows_physics_start_inputs_and_tolerance() -> None:
    def key(scene: Scene = SCENE, batch: Batch = BATCH, rtol: float = 1e-11) -> str:
        return cache.key_of("solve", scene, batch, 0, rtol)

    heavier = msgspec.structs.replace(SCENE, gravity=(0.0, 0.0, -9.8))
    renamed = msgspec.structs.replace(SCENE, name="other", noise=0.5)
    blown = dataclasses.replace(BATCH, force=BATCH.force + 1e-15)
    moved = dataclasses.replace(BATCH, velocity=-BATCH.velocity)
    different = {key(), key(scene=heavier), key(batch=blown), key(batch=moved), key(rtol=1e-12)}
    assert len(different) == 5
    assert key(scene=renamed) == key()


def _turned(start: float) -> Scene:
    hinge = Joint("pivot", "hinge", "world", "a", (0.0,) * 3, (1.0, 1.0, 1.0), start=start)
    sprung = msgspec.structs.replace(hinge, stiffness=1.0)
    return Scene("door", (even("a", 1.0, 0.1, (1.0, 0.0, 0.0)),), 1.0, joints=(sprung,))


@pytest.mark.parametrize(
    ("version", "scenes"),
    [
        (
            "_IDLE",
            (*(case.scene for case in CASES if case.name == "welded"), load_scene("bricard")),
        ),
        ("_HALF_TURN", (_turned(np.pi), _turned(3.0))),
    ],
)
def test_only_some_solutions_have_a_version_of_their_own(
    monkeypatch: pytest.MonkeyPatch, version: str, scenes: tuple[Scene, ...]
) -> None:
    pairs = [(scene, draw_batch(scene, [0])) for scene in (*scenes, SCENE)]
    before = [cache.key_of("solve", *pair, 0, 1e-11) for pair in pairs]
    monkeypatch.setattr(cache, version, 0)
    after = [cache.key_of("solve", *pair, 0, 1e-11) for pair in pairs]
    assert [a != b for a, b in zip(before, after, strict=True)] == [True, False, False]


def test_sensitivity_is_kept_beside_solutions(tmp_path: Path, computed: list[int]) -> None:
    first = sensitivity(SCENE, BATCH)
    np.testing.assert_array_equal(first, sensitivity(SCENE, BATCH))
    assert computed == [4]
    assert len(files(tmp_path)) == 2


def test_a_directory_that_cannot_be_written_only_warns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a directory")
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(blocked))
    with pytest.warns(UserWarning, match="not kept"):
        result = solve(SCENE, BATCH)
    assert np.isfinite(result.position).all()
