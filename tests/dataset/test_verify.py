"""Every change of a file is found, by accident or with its checksums made to fit."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import HERE
from mbds_xsim.base.versions import CHECKS
from mbds_xsim.dataset import shard
from mbds_xsim.dataset.encoding import encode
from mbds_xsim.dataset.gate import COLUMNS, judge_rows
from mbds_xsim.dataset.hdf5 import CONTENT
from mbds_xsim.dataset.points import Points
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.dataset.reaudit import making_of
from mbds_xsim.dataset.verify import Verified, recheck, verify
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import STATES, Batch
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.simulate.timed import Simulation, simulate

from .conftest import FILE, JOINT, SHARD, TEXTS, Make

Change = Callable[[dict[str, Any], dict[str, Any]], object]


def _verify(path: Path) -> Verified:
    return verify(path, conduct=HERE)


def _problems(verified: Verified) -> list[str]:
    return [problem for report in verified.files for problem in report.problems]


def test_a_finished_set_is_sound(few: Path) -> None:
    verified = _verify(few)
    assert _problems(verified) == []
    assert {report.kind: report.trajectories for report in verified.files} == {
        "shard": 8,
        "joined": 8,
        "joint": 8,
        "card": 0,
        "metadata": 0,
    }
    notes = [note for report in verified.files for note in report.notes]
    assert sorted(notes) == ["3 simulated again: the same bits", "train 6, validation 1, test 1"]
    (about,) = verified.about
    assert (about["engine"], about["certification"]) == ("mujoco", "certified")


def test_a_file_is_looked_at_with_its_shards(few: Path) -> None:
    assert [report.kind for report in _verify(few / FILE).files] == ["joined", "shard"]
    assert [report.kind for report in _verify(few / SHARD).files] == ["shard"]


def _with_one_rejected(make: Make, out: Path, which: int, trajectories: int) -> Verified:
    """Make a set of which one trajectory is spoilt; it is sound all the same."""
    from .test_generate import _spoil

    with pytest.MonkeyPatch.context() as patch:
        _spoil(which, patch)
        make(out, trajectories=trajectories)
    verified = _verify(out)
    assert _problems(verified) == []
    return verified


def test_rejected_ones_are_checked_too(make: Make, tmp_path: Path) -> None:
    verified = _with_one_rejected(make, tmp_path, 3, trajectories=8)
    assert [r.trajectories for r in verified.files if r.kind == "rejected"] == [1]
    rejected = tmp_path / "rejected/1pendulum/mujoco-matched"
    _rewrite(rejected / "0000000000.h5", _tell("engine_version", "0.1"))
    (problem,) = recheck(tmp_path / FILE, "joined").problems
    assert problem == "rejected 0000000000.h5 was made differently: engine_version"
    shutil.rmtree(rejected)
    rejected.mkdir()
    assert _problems(_verify(tmp_path)) == [
        "published and rejected trajectories do not make up 0 to 7"
    ]


def test_a_set_of_which_all_was_rejected_is_sound(make: Make, tmp_path: Path) -> None:
    verified = _with_one_rejected(make, tmp_path, 0, trajectories=1)
    assert {r.kind: r.trajectories for r in verified.files} == {
        "joined": 0,
        "shard": 0,
        "rejected": 1,
        "joint": 0,
        "card": 0,
        "metadata": 0,
    }


def test_a_motion_beyond_float32_is_sound_among_the_rejected(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def blown_up(*arguments: Any) -> Simulation:
        done = simulate(*arguments)
        done.trajectory.position[:, 5:] = 1e40
        return done

    monkeypatch.setattr(shard, "simulate", blown_up)
    with np.errstate(over="ignore"):
        make(tmp_path, trajectories=1)
        assert _problems(_verify(tmp_path)) == []


def _rewrite(path: Path, change: Change) -> None:
    """Change a shard, and make its checksums fit."""
    data = load_dataset(path)
    attributes = {key: value for key, value in data.attributes.items() if key != CONTENT}
    arrays = {name: np.array(values) for name, values in data.items()}
    change(arrays, attributes)
    path.write_bytes(b"".join(encode(arrays, attributes)))


def _late(arrays: dict[str, Any], attributes: dict[str, Any]) -> None:
    del attributes
    arrays["body/velocity"][2, 1:] = arrays["body/velocity"][2, :-1].copy()
    arrays["velocity"][2, 1:] = arrays["velocity"][2, :-1].copy()


def _set(name: str, place: Any, value: Any) -> Change:
    def change(arrays: dict[str, Any], attributes: dict[str, Any]) -> None:
        del attributes
        arrays[name][place] += value

    return change


def _tell(key: str, value: Any) -> Change:
    return lambda _, attributes: attributes.update({key: value})


def _drop(name: str) -> Change:
    return lambda arrays, _: arrays.pop(name)


def _shorten(name: str) -> Change:
    return lambda arrays, _: arrays.update({name: arrays[name][:, :-1]})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_late, "published trajectory 2 fails: "),
        (_set("body/position", (3, 4), 1e-3), "position: not that of the bodies, first of traj"),
        (_set("position", (3, 4, 0, 1), 1e-6), "position: not that of the bodies, first of traj"),
        (_set("velocity", (7, 0, 0, 0), 1e-6), "velocity: not that of the bodies"),
        (_set("start/velocity", 1, 1e-9), "pairing: velocity is not what seed 0 and index give"),
        (_set("input/force", (1, 3), 1e-6), "pairing: force is not what seed 0 and index give"),
        (_set("index", 5, 1), "index: not ascending from 0 to 7"),
        (_set("interval", 5, 1), "interval: not index mod 3"),
        (_set("time", 3, 1e-3), "time: not that of the scene's frames"),
        (
            _set("check/figure", (2, list(COLUMNS).index("gap")), 1e-3),
            "checks: gap of trajectory 2 is stored as figure",
        ),
        (
            _set("check/allowed", (2, list(COLUMNS).index("gap")), 1e-3),
            "checks: gap of trajectory 2 is stored as allowed",
        ),
        (_set("graph/point_body", 0, 1), "graph/point_body: not that of the scene"),
        (_tell("published", 7), "counts: published is 7, but 8 of 8 trajectories are here"),
        (_tell("seed", 1), "pairing: position is not what seed 1 and index give"),
        (_tell("steps", 11), "clock: steps and frame_s are not the scene's"),
        (_tell("dimension", 2), "scene_name and dimension are not the scene's"),
        (_tell("scene_name", "2pendulum"), "scene_name and dimension are not the scene's"),
        (_tell("profile", "native"), "certification: certified at settings called native"),
        (_set("check/unit", 0, "m"), "check/unit: not those of the checks"),
        (_tell("method", "Euler"), r"simulated again: \w+ of trajectory \d differs by"),
        (_tell("scene", "name = 1"), "cannot be read: .*its attribute scene is no scene"),
        (_drop("start/velocity"), "layout: dataset start/velocity is missing"),
        (_shorten("velocity"), r"layout: velocity has the shape \(8, 10, 1, 3\), not \(8, 11, 1"),
    ],
)
def test_a_change_with_fitting_checksums_is_found(change: Change, says: str, copy: Path) -> None:
    import re

    _rewrite(copy / SHARD, change)
    problems = recheck(copy / SHARD, "shard", 3).problems
    assert any(re.match(says, problem) for problem in problems), problems


@pytest.mark.parametrize("version", [0, CHECKS - 1, CHECKS + 1])
def test_figures_of_another_version_of_the_checks_are_not_blamed(version: int, copy: Path) -> None:
    """Stored figures may differ from today's; what fails today is reported all the same."""
    figure = _set("check/figure", (2, list(COLUMNS).index("gap")), 1e-3)
    for change in (figure, _tell("checks_version", version)):
        _rewrite(copy / SHARD, change)
    report = recheck(copy / SHARD, "shard")
    assert report.problems == []
    assert report.notes == [
        f"figures of checks of version {version} not compared, here is {CHECKS}; judged anew"
    ]

    _rewrite(copy / SHARD, _late)
    (problem,) = [each for each in recheck(copy / SHARD, "shard").problems if "fails" in each]
    assert problem.startswith("published trajectory 2 fails: ")


def test_a_file_older_than_the_attribute_is_read(copy: Path) -> None:
    _rewrite(copy / SHARD, lambda _, attributes: attributes.pop("checks_version"))
    assert load_dataset(copy / SHARD).attributes["checks_version"] == 0


def _to_float32(arrays: dict[str, Any], first: int = 0) -> None:
    for key in STATES:
        values = arrays[f"body/{key}"]
        values[:, first:] = values[:, first:].astype(np.float32)
        if key == "orientation":
            values /= np.linalg.norm(values, axis=-1, keepdims=True)


def _faster(arrays: dict[str, Any]) -> None:
    arrays["body/angular_velocity"][2:, 1:] *= 1.0 + 1e-9


def _turned(arrays: dict[str, Any]) -> None:
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(8, 10, 1, 1))
    arrays["body/orientation"][:, 1:] *= signs


def _forge(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change states, and make points, figures and checksums fit."""
    _rewrite(path, lambda arrays, _: change(arrays))
    forged = load_dataset(path)
    batch, trajectory = forged.batch(), forged.trajectory()
    verdict = judge_rows(forged.scene, batch, trajectory, making_of(forged))

    def fit(arrays: dict[str, Any], attributes: dict[str, Any]) -> None:
        del attributes
        arrays["position"], arrays["velocity"] = Points.of(forged.scene).motion(trajectory)
        arrays["check/figure"], arrays["check/allowed"] = verdict.figure, verdict.allowed

    _rewrite(path, fit)


_SINGLE = "published trajectory 0 fails: .*precision: .*rounded to 24 significant bits"


@pytest.mark.parametrize(
    ("change", "alone", "again"),
    [
        (_to_float32, _SINGLE, "differs by"),
        (lambda arrays: _to_float32(arrays, 3), _SINGLE, r"differs by .* at frame 3$"),
        (_faster, "", r"simulated again: angular_velocity of trajectory \d differs by .*frame 1$"),
        (_turned, r"body/orientation: changes its sign at frame \d of trajectory 0", "orientation"),
    ],
)
def test_forged_states_with_fitting_figures_are_found(
    change: Callable[[dict[str, Any]], None], alone: str, again: str, copy: Path
) -> None:
    """Some forgeries are found from the numbers alone, all of them by simulating again."""
    import re

    _forge(copy / SHARD, change)
    faults = recheck(copy / SHARD, "shard").problems
    assert any(re.match(alone, problem) for problem in faults) if alone else not faults, faults
    more = [each for each in recheck(copy / SHARD, "shard", 3).problems if each not in faults]
    assert any(re.search(again, problem) for problem in more), more


def test_nobody_can_foresee_what_is_simulated_again(
    few: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen: list[list[int]] = []

    def noted(scene: Scene, batch: Batch, engine: str, settings: Settings) -> Simulation:
        chosen.append(batch.index.tolist())
        return simulate(scene, batch, engine, settings)

    monkeypatch.setattr("mbds_xsim.dataset.reaudit.simulate", noted)
    verified = [_verify(few / SHARD) for _ in range(8)]
    assert len({tuple(rows) for rows in chosen}) > 1
    assert all(len(set(rows)) == 3 for rows in chosen)

    verify(few / SHARD, seed=verified[0].seed, conduct=HERE)
    assert chosen[-1] == chosen[0]


def test_an_engine_that_is_not_here_is_told(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def lacking(_: object) -> str:
        raise PackageNotFoundError("mujoco")

    _rewrite(copy / SHARD, _tell("engine_version", "0.1"))
    report = recheck(copy / SHARD, "shard", 3)
    assert report.problems == []
    assert report.notes[0].startswith("not simulated again: mujoco 0.1 is not installed, but ")
    monkeypatch.setattr(type(load_adapter("mujoco")), "version", lacking)
    report = recheck(copy / SHARD, "shard", 3)
    assert report.notes[0] == "not simulated again: mujoco 0.1 is not installed"


def test_motions_of_another_revision_of_the_adapter_are_not_blamed(copy: Path) -> None:
    """Its bits may differ; those of files that are older than the attribute are compared."""
    for change in (_tell("adapter_revision", 99), lambda arrays, _: _faster(arrays)):
        _rewrite(copy / SHARD, change)
    report = recheck(copy / SHARD, "shard", 3)
    assert report.problems == []
    assert any("driven by revision 99 of its adapter, here is" in note for note in report.notes)

    _rewrite(copy / SHARD, lambda _, attributes: attributes.pop("adapter_revision"))
    (problem,) = recheck(copy / SHARD, "shard", 3).problems
    assert problem.startswith("simulated again: angular_velocity of trajectory")


def test_a_shard_that_was_exchanged_is_found(copy: Path) -> None:
    _rewrite(copy / SHARD, _tell("engine_version", "0.1"))
    problems = recheck(copy / FILE, "joined").problems
    assert f"shard {SHARD.removeprefix('1pendulum/')} is not the one that was joined" in problems


def test_a_variant_that_was_taken_away_is_found(copy: Path) -> None:
    shutil.copy(copy / FILE, copy / "1pendulum/dart-matched.h5")
    (problem,) = recheck(copy / JOINT, "joint").problems
    assert problem == "lists mujoco-matched; its folder has dart-matched, mujoco-matched"


def test_shards_of_an_unfinished_run_are_told(copy: Path) -> None:
    (copy / FILE).unlink()
    (copy / JOINT).unlink()
    (report,) = _verify(copy).files
    assert report.problems == []
    assert "not joined yet: run mbds-xsim generate again to finish the set" in report.notes


def test_beside_a_shard_that_is_missing_no_other_is_unfinished(copy: Path) -> None:
    (copy / SHARD).rename((copy / SHARD).with_name("0000000016.h5"))
    assert not any("joined" in line for report in _verify(copy).files for line in report.notes)


@pytest.mark.parametrize("content", [b"", b"text"])
def test_what_is_no_data_file_is_found(content: bytes, copy: Path) -> None:
    (copy / SHARD).write_bytes(content)
    assert any(problem.startswith("cannot be read") for problem in _problems(_verify(copy / SHARD)))
    assert not _verify(copy).sound


def test_nothing_to_check(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds no \.h5 file"):
        _verify(tmp_path)
    with pytest.raises(InputError, match="there is no such file"):
        _verify(tmp_path / "nothing.h5")


@pytest.mark.parametrize(
    ("name", "old", "new", "says"),
    [
        (TEXTS[0], "8 of 8 are", "9 of 9 are", "does not say what the data give, first line"),
        (TEXTS[0], "| 8 | 8 | 0 |", "| 8 | 7 | 1 |", "does not say what the data give, first li"),
        (TEXTS[1], '"sha256": "', '"sha256": "0', "distribution: mujoco-matched.h5: sha256: not "),
        (TEXTS[1], '"counts/trajectories": 2', '"counts/trajectories": 3', "recordSet: not what"),
        (TEXTS[1], '"keywords"', '"words"', "keywords is missing"),
    ],
)
def test_texts_must_agree_with_the_data(
    name: str, old: str, new: str, says: str, copy: Path
) -> None:
    text = (copy / name).read_text("utf-8")
    assert old in text
    (copy / name).write_text(text.replace(old, new, 1), "utf-8")
    (problem,) = _problems(_verify(copy))
    assert problem.startswith(says)


def test_a_publisher_may_add_to_the_texts(copy: Path) -> None:
    card, metadata = (copy / name for name in TEXTS)
    card.write_text(card.read_text("utf-8") + "\n## Licence\n\nCC BY 4.0\n", "utf-8")
    extended = {**json.loads(metadata.read_text("utf-8")), "license": "CC-BY-4.0"}
    metadata.write_text(json.dumps(extended), "utf-8")
    assert _verify(copy).sound


def test_the_table_knows_what_it_is_about(few: Path) -> None:
    assert list(load_dataset(few / SHARD)["check/name"]) == list(COLUMNS)


def test_a_file_from_before_a_check_was_added_is_sound(copy: Path) -> None:
    def forget(arrays: dict[str, Any], attributes: dict[str, Any]) -> None:
        del attributes
        kept = [name not in ("displacement", "gap rate") for name in arrays["check/name"]]
        for name in ("check/name", "check/unit"):
            arrays[name] = arrays[name][kept]
        for name in ("check/figure", "check/allowed", "check/frame"):
            arrays[name] = arrays[name][:, kept]

    _rewrite(copy / SHARD, forget)

    assert _problems(_verify(copy / SHARD)) == []
