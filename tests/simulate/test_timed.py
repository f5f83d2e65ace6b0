"""Long work is announced, with an estimate that measurement confirms."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from mbds_xsim.base.isolate import Conduct, Silent
from mbds_xsim.measure import campaign, runner
from mbds_xsim.measure.runner import Piece, Running
from mbds_xsim.reference import FirstImpact, cache, kernels
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate import timed
from mbds_xsim.simulate.adapter import Adapter, Settings
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.simulate.timed import Work, checked, forewarnings, simulate
from mbds_xsim.studies.validate import validate_with_evidence

_SCENE = load_scene("1pendulum")
_START = draw_batch(_SCENE, [0])


class _Notes(Silent):
    def __init__(self) -> None:
        self.done: list[str] = []

    def doing(self, work: str) -> None:
        self.done.append(work)

    def notice(self, line: str) -> None:
        self.done.append(line)

    def advance(self, work: str) -> None:
        self.done.append(f"then {work}")


def test_what_takes_minutes_is_announced_and_the_rest_is_not_even_tried() -> None:
    tiny = Settings("RK4", 1e-7)
    work = [
        Work("mujoco (matched)", "mujoco", tiny, 4e7),
        Work("short", "no such engine", tiny, 1e5),
    ]

    (line,) = forewarnings(_SCENE, _START, work, workers=None)

    regex = r"mujoco \(matched\) on 1pendulum: 4e\+07 steps of 1e-07 s, about \d+ (s|min|h) of proc"
    assert re.match(regex, line)


class _Slow:
    """An engine whose first rollout of a model takes long, and every later step as long."""

    EACH, FIRST = 3e-5, 7.0

    def __init__(self) -> None:
        self.clock = 100.0
        self.left = self.FIRST

    @contextlib.contextmanager
    def open(self, scene: Scene, settings: Settings) -> Iterator[_Slow]:
        self.clock += 11.0
        self.steps = scene.clock.frame / settings.step
        yield self

    def rollout(self, start: Batch) -> None:
        self.clock += self.left + start.steps * self.steps * self.EACH
        self.left = 0.0


def test_an_estimate_is_of_the_steps_and_of_nothing_that_is_done_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slow = _Slow()
    monkeypatch.setattr(timed, "load_adapter", lambda _: slow)
    monkeypatch.setattr(time, "process_time", lambda: slow.clock)

    each = timed._seconds_a_step(_SCENE, _START, "slow", Settings("RK4", 1e-4))

    assert each == pytest.approx(_Slow.EACH, rel=1e-9)


def test_what_is_under_way_is_named_the_oldest_first() -> None:
    notes = _Notes()
    running = Running(notes, ["reference", "dart, step 1 s", "dart, step 2 s"])

    for place in range(3):
        running.started(place)
    for place in (1, 0, 2):
        running.finished(place, None)

    assert notes.done == [
        "reference", "reference and 1 more", "reference and 2 more",
        "then reference and 1 more", "then dart, step 2 s", "then dart, step 2 s",
    ]  # fmt: skip


def test_a_validation_announces_its_costs_and_names_its_parts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(timed, "_LONG", 0.0)
    notes = _Notes()

    validate_with_evidence(
        _SCENE, choice=Choice.parse(engines="mujoco"), conduct=Conduct(0, meter=notes)
    )

    parts = [part for part in dict.fromkeys(notes.done) if not part.startswith("then")]
    name = "mujoco (matched)"
    announced = f"{name} on 1pendulum: 4.2e+03 steps of 0.005 s, about 0 s of processor time"
    assert parts[:3] == ["costs of the runs", announced, "reference"]
    assert parts[3:6] == [f"{name}, step {step} s" for step in ("0.01", "0.02", "0.005")]
    assert parts[-1] == f"{name}: checks"


def _sound() -> tuple[Batch, Trajectory]:
    scene = load_scene("2pendulum")
    batch = draw_batch(scene, range(3)).truncated(4)
    whole = Trajectory.empty(0.02 * np.arange(5.0), 3, 2)
    for name in ("position", "orientation", "velocity", "angular_velocity"):
        getattr(whole, name)[:] = 0.5
    return batch, whole


def _given(trajectory: object, batch: Batch) -> Trajectory:
    return checked(cast(Trajectory, trajectory), batch, 0.02)


def test_frames_from_a_failure_on_are_not_numbers() -> None:
    batch, whole = _sound()
    failures = (None, FirstImpact.at(2, 0.03), Failure(99, "no\n  \udcff.xml\n"))

    cut = _given(dataclasses.replace(whole, failures=failures), batch)

    ended = np.isnan(cut.position).all(axis=(2, 3))
    assert ended.tolist() == [[False] * 5, [False] * 2 + [True] * 3, [False] * 4 + [True]]
    for name in ("orientation", "velocity", "angular_velocity"):
        assert np.array_equal(np.isnan(getattr(cut, name)).all(axis=(2, 3)), ended)
    assert cut.failures == (*failures[:2], Failure(99, r"no \udcff.xml"))


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"position": np.zeros((3, 5, 1, 3))}, r"position as float64 \(3, 5, 1, 3\), not"),
        ({"orientation": np.zeros((3, 5, 2, 3))}, "orientation as float64"),
        ({"velocity": np.zeros((3, 5, 2, 3), dtype=np.float32)}, "velocity as float32"),
        ({"angular_velocity": [[0.0]]}, "angular_velocity as <class 'list'>"),
        ({"time": np.zeros(4)}, r"time as float64 \(4,\), not as float64 \(5,\)"),
        ({"time": 20.0 * np.arange(5.0)}, r"frame 1 the time 20 s, not 0\.02 s"),
        ({"time": 0.02 * np.arange(1.0, 6.0)}, r"frame 0 the time 0\.02 s, not 0 s"),
        ({"time": (0.02 + 5e-11) * np.arange(5.0)}, r"1 the time 0\.02000000005 s, not 0\.02 s"),
        ({"time": np.full(5, np.nan)}, "frame 0 the time nan s, not 0 s"),
        ({"failures": (None,)}, "failures .* for each trajectory"),
        ({"failures": ("late", None, None)}, "failures .* for each trajectory"),
        ({"failures": (Failure(2, cast("str", 5)), None, None)}, "failures .* for each trajectory"),
        ({"failures": (Failure(-1, "lost"), None, None)}, "failures .* for each trajectory"),
        ({"failures": (Failure(cast("int", 1.5), ""), None, None)}, "failures .* for each traj"),
    ],
)
def test_what_is_no_trajectory_is_refused(wrong: dict[str, Any], told: str) -> None:
    batch, whole = _sound()
    with pytest.raises(ValueError, match=told):
        _given(dataclasses.replace(whole, **wrong), batch)


def test_nothing_is_no_trajectory() -> None:
    batch, _ = _sound()
    with pytest.raises(ValueError, match="the adapter gave time as <class 'NoneType'>"):
        _given(None, batch)


def test_quaternions_keep_their_sign_in_every_engine(cornered: Adapter) -> None:
    """PyBullet's own change sign 18 times in these frames, where flywheels turn half around."""
    scene = load_scene("simplecubli")
    batch = draw_batch(scene, [2, 5]).truncated(60)

    turn = simulate(scene, batch, cornered.name, cornered.settings(scene, "native")).trajectory

    frames = np.concatenate([batch.orientation[:, None], turn.orientation], axis=1)
    assert not (np.sum(frames[:, 1:] * frames[:, :-1], axis=-1) < 0).any()


def test_the_account_of_the_time_adds_up() -> None:
    """With one process at a time, their times add up to nearly all of the elapsed time."""
    validation, _ = validate_with_evidence(
        _SCENE, choice=Choice.parse(engines="mujoco"), conduct=Conduct(1, cache=False)
    )

    spent = validation.spent_s
    assert {"mujoco", "reference", "processes", "checks"} <= set(spent)
    assert list(spent.values()) == sorted(spent.values(), reverse=True)
    assert 0.5 * validation.wall_s < sum(spent.values()) <= validation.wall_s


def test_engines_run_while_the_reference_is_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    importlib.import_module("mbds_xsim.reference.compiled")  # with the machine code that is there
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache, "kernel_folder", cache.kernel_folder.__wrapped__)
    monkeypatch.setattr(kernels, "_compile", lambda _: None)
    notes = _Notes()
    pieces: list[Piece] = []

    def carried_out(work: list[Piece], *others: Any) -> None:
        pieces.extend(work)
        runner.carry_out(work, *others)

    monkeypatch.setattr(campaign, "carry_out", carried_out)

    validate_with_evidence(
        _SCENE, choice=Choice.parse(engines="mujoco,reference"), conduct=Conduct(0, meter=notes)
    )

    assert any("compiled for this machine" in note for note in notes.done)
    first, *others = pieces
    assert first.name == "compiler"
    waiting = {piece.name.partition(",")[0] for piece in others if piece.task.after == 0}
    at_once = {piece.name.partition(",")[0] for piece in others if piece.task.after is None}
    assert waiting == {"reference", "reference (matched)"}
    assert at_once == {"mujoco (matched)"}


def test_an_engine_is_judged_before_the_next_has_run() -> None:
    notes = _Notes()

    validation, _ = validate_with_evidence(
        _SCENE, choice=Choice.parse(engines="mujoco,pybullet"), conduct=Conduct(0, meter=notes)
    )

    assert validation.verdict == "pass"
    runs = [k for k, note in enumerate(notes.done) if note.startswith("pybullet (matched), ")]
    checks = [k for k, note in enumerate(notes.done) if note.endswith(": checks")]
    assert checks[0] < runs[0] < runs[-1] < checks[1]
