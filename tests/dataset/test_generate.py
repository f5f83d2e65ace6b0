"""Published data: they pass, are the same whoever makes them, and are paired over engines."""

from __future__ import annotations

import dataclasses
import pickle
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

import h5py
import msgspec
import numpy as np
import pytest

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import put
from mbds_xsim.base.isolate import HERE, Task
from mbds_xsim.checks import audit
from mbds_xsim.dataset import gate, shard
from mbds_xsim.dataset.gate import COLUMNS
from mbds_xsim.dataset.generate import Request, generate
from mbds_xsim.dataset.hdf5 import CONTENT
from mbds_xsim.dataset.layout import rejected_folder, split_of
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.dataset.variant import Item, Variant
from mbds_xsim.dataset.verify import recheck, verify
from mbds_xsim.scene.file import write_scene
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import HingeRate, Levels, Turn
from mbds_xsim.scene.scene import Body, Clock, Joint, Particle, Scene
from mbds_xsim.scene.servo import Servo
from mbds_xsim.scene.state import Batch, Failure
from mbds_xsim.simulate import timed
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.choice import Choice, settings_for
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.simulate.timed import Simulation, simulate
from mbds_xsim.testing.joint_cases import JOINT_CASES

from .conftest import TRAJECTORIES, Make, Silence, contents

FILE = "1pendulum/mujoco-matched.h5"


def test_two_processes_make_what_one_makes(make: Make, whole: Path, tmp_path: Path) -> None:
    make(tmp_path, workers=2)
    assert contents(tmp_path) == contents(whole)
    # Three shards, the joined file, the joint one, the card and the metadata.
    assert len(contents(tmp_path)) == 7


def test_every_trajectory_is_there_once_with_its_split(whole: Path) -> None:
    with h5py.File(whole / FILE) as file:
        assert np.array_equal(file["index"][()], np.arange(TRAJECTORIES))
        assert np.array_equal(file["interval"][()], np.arange(TRAJECTORIES) % 3)
        assert np.bincount(file["split"][()]).tolist() == [32, 4, 4]
        assert np.isfinite(file["position"][()]).all()


def test_the_paper_s_split() -> None:
    split = split_of(np.arange(15_000), 15_000)
    assert np.bincount(split).tolist() == [12_000, 1_500, 1_500]
    assert (np.diff(split.astype(int)) >= 0).all()


def test_a_trajectory_made_alone_has_the_same_bits(rod: Scene, whole: Path) -> None:
    batch = draw_batch(rod, [27])
    adapter = load_adapter("mujoco")
    with h5py.File(whole / FILE) as file:
        alone = simulate(rod, batch, "mujoco", settings_for(rod, adapter, "matched")).trajectory
        for key in ("position", "orientation", "velocity", "angular_velocity"):
            assert np.array_equal(file[f"body/{key}"][27], getattr(alone, key)[0])
            assert np.array_equal(file[f"start/{key}"][27], getattr(batch, key)[0])
        assert np.array_equal(file["input/force"][27], batch.force[0])


def test_points_are_the_particles_in_float32(whole: Path) -> None:
    with h5py.File(whole / FILE) as file:
        exact = file["body/position"][()]  # the particle is the body's centre of mass
        assert np.array_equal(file["position"][()], exact.astype(np.float32))
        with h5py.File(whole / "1pendulum/mujoco-matched/0000000016.h5") as part:
            stated = part["position"].attrs["largest_rounding"]
            off = np.abs(part["position"][()] - part["body/position"][()])
        assert off.max() == stated < 3e-8


def test_points_of_a_plane_scene_have_two_components(make: Make, tmp_path: Path) -> None:
    make(tmp_path, scene=load_scene("balldrop"), trajectories=2)
    with h5py.File(tmp_path / "balldrop/mujoco-matched.h5") as file:
        position, center = file["position"][()], file["body/position"][()]
        assert position.shape == (2, 201, 19, 2)
        # A disc of equal particles: their mean is its centre.
        assert np.allclose(position.mean(axis=2), center[:, :, 0][..., [0, 2]], atol=1e-6)
        speed = np.diff(position, axis=1)[:, :5] / 0.02
        means = (file["velocity"][:, :5] + file["velocity"][:, 1:6]) / 2
        assert np.allclose(speed, means, atol=5e-2)  # in free fall still, turning


def _pushed() -> Scene:
    """A cart that a servo moves along a slider on the world."""
    return Scene(
        "cart",
        (Body("cart", particles=(Particle((0.0, 0.0, 0.0)),)),),
        1.0,
        joints=(Joint("rail", "slider", "world", "cart", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),),
        servos=(Servo("rail", velocity=(0.0, 1.0), damping=5.0, hold=2),),
        noise=0.1,
    )


@pytest.mark.parametrize("scene", [load_scene("1ladder"), _pushed()], ids=lambda scene: scene.name)
def test_known_forces_are_those_without_the_noise(scene: Scene, make: Make, tmp_path: Path) -> None:
    short = msgspec.structs.replace(scene, clock=msgspec.structs.replace(scene.clock, steps=4))
    make(tmp_path, scene=short, trajectories=2)
    with h5py.File(tmp_path / scene.name / "mujoco-matched.h5") as file:
        known = draw_batch(short, [0, 1], noise=False).force
        assert known.any()
        assert np.array_equal(file["input/known_force"][()], known)
        assert np.abs(file["input/force"][()] - known).max() > 0.05


def test_without_noise_nothing_pushes(make: Make, tmp_path: Path) -> None:
    make(tmp_path, trajectories=3, noise=False)
    with h5py.File(tmp_path / FILE) as file:
        assert not file["input/force"][()].any()
        assert not file.attrs["noise"]


def test_what_takes_minutes_is_announced_before_it_begins(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    progress = Silence()
    make(tmp_path, trajectories=3, progress=progress)
    assert progress.notices == []
    monkeypatch.setattr(timed, "_LONG", 0.0)
    make(tmp_path, trajectories=6, progress=progress)
    make(tmp_path, trajectories=6, progress=progress)  # nothing is left to be made
    assert progress.notices == [
        "mujoco (matched) on 1pendulum: 2.4e+02 steps of 0.005 s, about 0 s of processor time"
    ]


def test_copies_are_not_published(make: Make, rod: Scene, tmp_path: Path) -> None:
    still = msgspec.structs.replace(rod, name="still", sampling=())
    with pytest.raises(InputError, match=r"still: trajectories 0 and 1 would be the same, .* give"):
        make(tmp_path, scene=still, trajectories=2, noise=False)
    assert not list(tmp_path.iterdir())
    make(tmp_path / "noise", scene=still, trajectories=2)
    make(tmp_path / "one", scene=still, trajectories=1, noise=False)


def test_a_seed_that_no_file_can_store_is_refused(make: Make, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"--seed: got {2**63}, allowed is 0 to {2**63 - 1}"):
        make(tmp_path / "out", trajectories=3, seed=2**63)
    assert not (tmp_path / "out").exists()
    make(tmp_path / "out", trajectories=3, seed=2**63 - 1)
    assert load_dataset(tmp_path / "out" / FILE).attributes["seed"] == 2**63 - 1


@pytest.mark.parametrize("count", [0, 10**20])
def test_a_count_that_cannot_be_made_is_refused(count: int, make: Make, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"--trajectories: got {count}, allowed is 1 to 10+$"):
        make(tmp_path / "out", trajectories=count)
    assert not (tmp_path / "out").exists()


def test_one_start_an_interval_makes_copies_of_the_fourth(
    make: Make, rod: Scene, tmp_path: Path
) -> None:
    rate = Levels((1.0, 1.0), (2.0, 2.0), (3.0, 3.0))
    turn = Turn(point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0), angle=(0.5, 0.5), rate=rate)
    turned = msgspec.structs.replace(rod, name="turned", sampling=(turn,))
    make(tmp_path / "three", scene=turned, trajectories=3, noise=False)
    with pytest.raises(InputError, match=r"0 and 3 would be the same, .*; .* --trajectories 3$"):
        make(tmp_path / "four", scene=turned, trajectories=4, noise=False)
    assert not (tmp_path / "four").exists()


def test_files_say_how_they_were_made(rod: Scene, whole: Path) -> None:
    with h5py.File(whole / FILE) as file:
        facts = dict(file.attrs)
        assert facts["scene"] == write_scene(rod, defaults=True)
        assert (facts["engine"], facts["certification"]) == ("mujoco", "certified")
        assert (facts["method"], facts["seed"], facts["count"]) == ("RK4", 0, TRAJECTORIES)
        for name in ("position", "velocity", "input/force"):
            assert file[name].attrs["unit"]
        assert file["check/name"].asstr()[()].tolist() == list(COLUMNS)


@pytest.mark.parametrize("name", ["ballscroll", "particlecar", "simplecubli", "workbench"])
def test_every_check_has_a_column(name: str) -> None:
    scene, adapter = load_scene(name), load_adapter("mujoco")
    batch, settings = draw_batch(scene, [0]), settings_for(scene, adapter, "native")
    trajectory = simulate(scene, batch, "mujoco", settings).trajectory
    for finding in audit(scene, batch, trajectory, adapter.methods[settings.method]):
        assert COLUMNS[finding.check] == finding.unit


def test_figures_are_those_of_the_checks(rod: Scene, whole: Path) -> None:
    adapter = load_adapter("mujoco")
    settings = settings_for(rod, adapter, "matched")
    batch = draw_batch(rod, [3, 4])
    trajectory = simulate(rod, batch, "mujoco", settings).trajectory
    method = adapter.methods[settings.method]
    with h5py.File(whole / FILE) as file:
        for finding in audit(rod, batch, trajectory, method, step=settings.step):
            column = list(COLUMNS).index(finding.check)
            stored = file["check/figure"][3:5, column]  # from kernels, which round differently
            assert np.allclose(stored, finding.figure, rtol=1e-7, atol=1e-13)
            allowed = (finding.budget or 0.0) + finding.uncertainty
            assert np.allclose(file["check/allowed"][3:5, column], allowed, rtol=1e-9, atol=1e-13)


def _spoil(index: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a body jump by 1 mm in one trajectory, which no check can miss."""

    def spoilt(*arguments: object) -> Simulation:
        done = simulate(*arguments)  # type: ignore[arg-type]
        rows = np.flatnonzero(arguments[1].index == index)  # type: ignore[attr-defined]
        position = done.trajectory.position.copy()
        position[rows, 5:] += 1e-3  # in each component
        return dataclasses.replace(
            done, trajectory=dataclasses.replace(done.trajectory, position=position)
        )

    monkeypatch.setattr(shard, "simulate", spoilt)


def test_what_fails_is_kept_aside_with_its_reason(
    make: Make, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _spoil(23, monkeypatch)
    progress = Silence()
    (count,) = make(tmp_path, progress=progress).variants
    assert (count.published, count.rejected, count.rejected_by) == (39, 1, {"gap": 1})
    assert (progress.done, progress.rejected) == (40, 1)
    with h5py.File(tmp_path / FILE) as file, h5py.File(whole / FILE) as clean:
        index = file["index"][()]
        assert 23 not in index
        assert np.array_equal(file["position"][()], clean["position"][()][index])
        assert np.array_equal(file["split"][()], clean["split"][()][index])
    aside = tmp_path / "rejected/1pendulum/mujoco-matched/0000000016.h5"
    with h5py.File(aside) as file:
        assert file["index"][()].tolist() == [23]
        assert file.attrs["seed"] == 0
        reason = file["reason"].asstr()[0]
        # From frame 5 on it is equally large, up to rounding.
        match = re.match(r"gap: 0.00173 m, allowed 0.0001 \(joint joint1\), frame (\d+); ", reason)
        assert match is not None
        assert int(match[1]) >= 5
    with h5py.File(tmp_path / "1pendulum/joint.h5") as file:
        assert np.flatnonzero(~file["valid_in_all"][()]).tolist() == [23]


@pytest.mark.parametrize("settings", ["matched", "native"])
def test_what_its_engine_calls_a_failure_is_never_published(
    settings: str, make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*arguments: object) -> Simulation:
        done = simulate(*arguments)  # type: ignore[arg-type]
        failures = (None, Failure(5, "constraint solver: no convergence"), None)
        return dataclasses.replace(
            done, trajectory=dataclasses.replace(done.trajectory, failures=failures)
        )

    monkeypatch.setattr(shard, "simulate", failing)  # all its numbers are finite
    (count,) = make(tmp_path, trajectories=3, settings=settings).variants
    assert (count.published, count.rejected_by) == (2, {"ended early": 1})


@pytest.mark.parametrize("first", [0, 16])
def test_a_pull_that_only_a_vanishing_step_shows_rejects_its_shard(
    first: int, rod: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pull of 2e-5 of the weight, in the audit sample and where one trajectory stands for all."""
    (contender,), _ = Choice.parse(engines="mujoco").contenders(rod)
    item = Item(Variant(rod, contender, 0, True), first, 6)
    path = item.path(tmp_path)

    def published(pull: float) -> int:
        def pulled(scene: Scene, batch: Batch, engine: str, settings: Settings) -> Simulation:
            force = batch.force + pull * np.array(rod.gravity)  # of 1 kg
            return simulate(scene, dataclasses.replace(batch, force=force), engine, settings)

        for module in (shard, gate):
            monkeypatch.setattr(module, "simulate", pulled)
        shard.make_shard(item, tmp_path)
        with h5py.File(path) as file:
            return int(file.attrs["published"])

    assert published(0.0) == 6
    assert published(2e-5) == 0
    with h5py.File(rejected_folder(path.parent) / path.name) as file:
        reasons = file["reason"].asstr()[()]
    for reason in reasons:  # no other check sees it
        assert all(part.startswith("together: consistency of ") for part in reason.split("; "))


def test_native_sets_keep_what_is_whole_and_say_uncertified(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _spoil(1, monkeypatch)
    (count,) = make(tmp_path, trajectories=3, settings="native").variants
    assert (count.published, count.rejected) == (3, 0)
    with h5py.File(tmp_path / "1pendulum/mujoco-native.h5") as file:
        assert file.attrs["certification"] == "uncertified"
        column = list(COLUMNS).index("gap")
        failed = file["check/figure"][:, column] > file["check/allowed"][:, column]
        assert failed.tolist() == [False, True, False]


def test_engines_are_paired(make: Make, tmp_path: Path) -> None:
    counts = make(tmp_path, trajectories=4, engines="mujoco,exudyn").variants
    one, other = (h5py.File(tmp_path / count.file) for count in counts)
    for name in ("index", "start/velocity", "input/force", "split"):
        assert np.array_equal(one[name][()], other[name][()])
    assert np.allclose(one["position"][()], other["position"][()], atol=1e-4)
    assert not np.array_equal(one["body/position"][()], other["body/position"][()])
    with h5py.File(tmp_path / "1pendulum/joint.h5") as file:
        assert file["variant"].asstr()[()].tolist() == ["exudyn-matched", "mujoco-matched"]
        assert file["valid_in_all"][()].all()


def test_motions_of_two_revisions_of_an_adapter_do_not_mix(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(tmp_path, trajectories=3)
    adapter = load_adapter("mujoco")
    monkeypatch.setattr(type(adapter), "revision", adapter.revision + 1)
    with pytest.raises(InputError, match=r"was made differently: its adapter_revision is \d+, now"):
        make(tmp_path, trajectories=6)


def test_shards_that_other_workers_made_differently_are_not_joined(
    rod: Scene, tmp_path: Path
) -> None:
    """On a cluster versions are compared, but two states of the code may have the same."""

    def elsewhere(tasks: Sequence[Task], **_: object) -> list[None]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(type(load_adapter("mujoco")), "revision", 99)
            for task in tasks:
                function, arguments = pickle.loads(pickle.dumps((task.function, task.arguments)))
                function(*arguments)
        return [None] * len(tasks)

    request = Request((rod,), Choice.parse(engines="mujoco"), 3, tmp_path)
    with pytest.raises(InputError, match="made differently: its adapter_revision is 99, now asked"):
        generate(request, workers=1, carry_out=elsewhere)
    assert not list(tmp_path.rglob("mujoco-matched.h5"))


def test_a_set_grows(make: Make, whole: Path, tmp_path: Path) -> None:
    make(tmp_path, trajectories=25)
    progress = Silence()
    assert make(tmp_path, progress=progress).made == 24  # the shard that was short, and a new one
    assert (progress.total, progress.done) == (TRAJECTORIES, TRAJECTORIES)
    assert contents(tmp_path) == contents(whole)


def test_a_shard_in_the_place_of_another_is_found(whole: Path, make: Make, tmp_path: Path) -> None:
    """Joined, its trajectories would be there twice, and others not at all."""
    out = Path(shutil.copytree(whole, tmp_path / "copy"))
    folder = (out / FILE).with_suffix("")
    shutil.copy(folder / "0000000016.h5", folder / "0000000000.h5")
    with pytest.raises(
        InputError, match=r"was made differently: its first is 16, now asked for is 0"
    ):
        make(out)
    attributes = load_dataset(out / FILE).attributes
    del attributes[CONTENT]
    shards = [shard.Shard(path) for path in sorted(folder.glob("*.h5"))]
    put(out / FILE, *shard.joined(shards, TRAJECTORIES, attributes))
    assert "index: not ascending from 0 to 39" in recheck(out / FILE, "joined").problems


def test_data_of_the_reference_are_sound_where_friction_stops_joints(
    make: Make, tmp_path: Path
) -> None:
    """Such data keep the budgets of the reference's order, not of the first of fixed steps."""
    (brake,) = (case.scene for case in JOINT_CASES if case.name == "brake")
    draw = HingeRate(("axle",), rate=(0.0, 1.0))
    scene = msgspec.structs.replace(brake, clock=Clock(steps=10), sampling=(draw,))
    make(tmp_path, scene=scene, engines="reference", trajectories=3)
    assert verify(tmp_path, conduct=HERE).sound


def test_no_trajectories(make: Make, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--trajectories: got 0"):
        make(tmp_path, trajectories=0)
