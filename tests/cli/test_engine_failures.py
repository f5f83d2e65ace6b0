"""An engine that crashes, hangs or raises is reported with the reason; the others' results stay."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from mbds_xsim.base import isolate
from mbds_xsim.base.isolate import Task
from mbds_xsim.measure import campaign, refinement
from mbds_xsim.simulate import registry
from tests.command_line import CommandLine, bob
from tests.plugins import faulty

_HANG = 3.0  # [s] until a hanging task is ended

Install = Callable[..., None]

_RUNNING = ("aborting", "raising", "leaving", "hanging", "misshapen", "leaking", "unread")

_BOB = bob("length = 1.0", "clock = { steps = 10 }")


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Install some of the faulty engines, and soon end those that hang."""
    monkeypatch.setattr(campaign, "Task", _impatient)
    # One run of each engine is enough.
    monkeypatch.setattr(refinement, "other_steps", lambda *_: [])
    monkeypatch.setattr(campaign, "other_steps", lambda *_: [])
    monkeypatch.setattr(campaign, "_CHUNKS", 1)
    monkeypatch.setattr(registry, "_TIMEOUT", _HANG)
    with ExitStack() as stack:
        yield lambda *names: stack.enter_context(faulty(tmp_path / "packages", *names))


@functools.wraps(Task)
def _impatient(
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
    timeout: float,
    after: int | None = None,
) -> Task:
    return Task(function, arguments, _HANG if "hanging" in arguments else timeout, after)


@pytest.mark.slow
def test_each_fault_is_told_and_the_sound_engine_keeps_its_result(
    run: CommandLine, here: Path, install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    (here / "bob.toml").write_text(_BOB)
    install(*_RUNNING)
    monkeypatch.setattr(isolate, "memory_bytes", lambda: 2e9)
    chosen = ",".join(["mujoco", *_RUNNING])

    ended = run("validate", "bob.toml", "--engines", chosen, "--json", "out.json", "--workers", "4")

    result = json.loads((here / "out.json").read_text())
    rows = {row["engine"]: row for row in result["engines"]}
    assert ended.code == 1
    assert "Traceback" not in ended.out + ended.err
    assert result["verdict"] == "fail"
    assert rows["mujoco"]["failures"] == []
    assert rows["mujoco"]["error_max_m"] < 1e-6
    expected = {
        "aborting": "crash: the process crashed with SIGABRT",
        "raising": "crash: RuntimeError: the model has too many bodies",
        "leaving": "crash: the process crashed with exit code 3: licence expired",
        "hanging": f"crash: no answer within {_HANG:g} s",
        "misshapen": "crash: ValueError: the adapter gave time as float64 (3,), not as ",
        "leaking": "crash: it had taken ",
        "unread": "crash: ValueError: the adapter read back mass as <class 'NoneType'>, ",
    }
    for name, reason in expected.items():
        assert rows[name]["verdict"] == "fail"
        assert rows[name]["failures"][0].startswith(reason)
        assert rows[name]["reasons"][0].startswith(reason)
        assert name in ended.out


@pytest.mark.slow
def test_a_package_that_breaks_when_it_is_looked_at_is_named_and_left_out(
    run: CommandLine, here: Path, install: Install
) -> None:
    (here / "bob.toml").write_text(_BOB)
    install("ageless", "brokenly", "deadly", "endlessly")
    faults = {
        "ageless": "faulty_engines:Ageless of the package packages: OSError: no version file",
        "brokenly": "broken_import:X of the package packages: RuntimeError: its licence has",
        "deadly": "dead_import:X of the package packages: the process crashed with SIGABRT",
        "endlessly": f"endless_import:X of the package packages: no answer within {_HANG:g} s",
    }

    listed = run("engines", "--json", "engines.json")
    named = {name: run("validate", "bob.toml", "--engines", name) for name in faults}

    rows = {row["engine"]: row for row in json.loads((here / "engines.json").read_text())}
    assert listed.code == 0
    assert rows["mujoco"]["fault"] == ""
    for name, fault in faults.items():
        assert rows[name]["version"] == "cannot be used"
        assert fault in rows[name]["fault"]
        assert named[name].code == 2
        assert f"mbds-xsim: the engine {name} cannot be used: {fault}" in named[name].err
        assert named[name].err.count("\n") == 1


@pytest.mark.slow
def test_data_of_sound_engines_are_made_beside_hopeless_ones(
    run: CommandLine, here: Path, install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    install("raising", "ageless", "pondering")
    usable = ["mujoco", "raising", "pondering"]
    monkeypatch.setattr(registry, "installed_engines", lambda: usable)

    ended = run(
        "generate", "1pendulum", "--trajectories", "6", "--out", "data", "--json", "told.json",
        "--limit", "30",
    )  # fmt: skip

    result = json.loads((here / "told.json").read_text())
    counts = {count["variant"]: count for count in result["variants"]}
    left_out = result["left_out"]
    assert ended.code == 1
    assert counts["mujoco-matched"]["published"] == 6
    assert counts["raising-matched"]["rejected_by"] == {"ended early": 6}
    assert left_out["1pendulum ageless"].startswith("the engine ageless cannot be used")
    assert left_out["1pendulum pondering"].endswith(f"no answer within {_HANG:g} s")
