"""The main command, `validate`, from words to table, JSON and page."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from mbds_xsim.measure.result import (
    SCHEMA,
    EngineResult,
    EnsembleResult,
    FindingResult,
    ReferenceResult,
    Validation,
)
from mbds_xsim.simulate import registry
from tests.command_line import bob, wait

CommandLine = Callable[..., Any]


@pytest.mark.slow
def test_the_program_validates_in_all_engines(program: CommandLine, here: Path) -> None:
    ended = program("validate", "2pendulum", "--json", "new/v.json", "--html", "new/v.html")

    validation = _decoded((here / "new/v.json").read_text())
    page = (here / "new/v.html").read_text()
    assert ended.code == (1 if validation.verdict == "fail" else 0), ended.err
    # On a slow machine progress is reported once a minute, and nothing else.
    assert all(" left " in line for line in ended.err.splitlines())
    assert [row.engine for row in validation.engines] == registry.engine_names()
    assert validation.command == "mbds-xsim validate 2pendulum"
    for row in validation.engines:
        assert row.failures == ()
        assert row.error_1s_m is not None
        assert row.error_1s_m < 1e-3
        (early,) = (finding for finding in row.findings if finding.check == "error at 1 s")
        fast = [index % 3 == 2 for index in validation.trajectories]  # chaotic, so not judged by it
        assert [figure is None for figure in early.figures] == fast
        assert row.version in page
        assert row.engine in ended.out
    assert validation.verdict.upper() in ended.out
    assert sorted(os.listdir(here / "new")) == ["v.html", "v.json"]


_BOB = bob("length = 0.5", "noise = 0.1", "clock = { steps = 60 }")


def test_a_short_scene_says_when_engines_are_furthest_apart(
    run: CommandLine, in_process: None, here: Path
) -> None:
    del in_process
    (here / "short.toml").write_text(bob("length = 0.5", "clock = { frame = 0.03, steps = 5 }"))
    how = ("--engines", "mujoco", "--settings", "native", "--trajectories", "1")
    ended = run("validate", "short.toml", "--json", "-", *how)

    validation = _decoded(ended.out)
    assert validation.matrix_s == pytest.approx(0.15)
    assert "furthest apart at 0.15 s are" in " ".join(ended.err.split())


@pytest.fixture
def validate(run: CommandLine, in_process: None, here: Path) -> Callable[..., Validation]:
    """Return a function that validates a bob on a string, with more words, from the JSON."""
    del in_process
    (here / "bob.toml").write_text(_BOB)

    def call(*words: str) -> Validation:
        ended = run("validate", "bob.toml", "--json", "-", *words)
        validation = _decoded(ended.out)
        assert ended.code == (1 if validation.verdict == "fail" else 0)
        assert f"{validation.verdict.upper()} " in ended.err
        return validation

    return call


def test_both_profiles_stand_side_by_side(validate: Callable[..., Validation]) -> None:
    validation = validate("--engines", "mujoco, dart", "--settings", "matched,native")

    rows = [(row.engine, row.profile) for row in validation.engines]
    assert sorted(rows) == [(e, p) for e in ("dart", "mujoco") for p in ("matched", "native")]
    assert len({row.engine: 0 for row in validation.engines}) == 2
    assert validation.names == (*(f"{e} {p}" for e, p in rows), "reference")
    assert len(validation.matrix_m) == 5


def test_what_a_check_saw_besides_is_told(validate: Callable[..., Validation]) -> None:
    (row,) = validate("--engines", "mujoco").engines

    notes = {finding.check: finding.note for finding in row.findings}
    assert notes["kinematics"].startswith("frames resolve ")
    assert notes["consistency of positions"] == f"order {row.order} declared"
    assert notes["gap"] == ""


def test_method_and_step_are_those_asked_for(validate: Callable[..., Validation]) -> None:
    (row,) = validate("--engines", "mujoco", "--method", "Euler", "--step", "0.0005").engines

    assert (row.method, row.order, row.step_s) == ("Euler", 1, 0.0005)


def test_seed_noise_and_trajectories_change_what_is_drawn(
    validate: Callable[..., Validation],
) -> None:
    def error(*words: str) -> float | None:
        return validate("--engines", "mujoco", *words).engines[0].error_max_m

    plain = error()
    assert error() == plain
    assert error("--no-noise") != plain
    assert error("--seed", "1") != plain
    assert error("--no-inputs") == plain  # a bob has no drawn inputs
    validation = validate("--engines", "mujoco", "--trajectories", "2", "--seed", str(10**30))
    assert validation.trajectories == (0, 1, 2, 3, 4, 5)
    assert validation.seed == 10**30


def test_a_stored_reference_is_used_unless_told_otherwise(
    validate: Callable[..., Validation],
) -> None:
    def cached(*words: str) -> int:
        reference = validate("--engines", "mujoco", "--settings", "native", *words).reference
        assert reference is not None
        return reference.cached

    assert cached("--no-cache") == 0
    assert cached() == 0
    assert cached() == 3
    assert cached("--no-cache") == 0


def test_an_engine_that_misses_a_budget_is_exit_code_1(
    validate: Callable[..., Validation], here: Path
) -> None:
    (here / "bob.toml").write_text(f"{_BOB}\n[budget]\nerror_1s = 1e-15\n")

    validation = validate("--engines", "mujoco")

    assert validation.verdict == "fail"
    assert any(reason.startswith("error at 1 s: ") for reason in validation.engines[0].reasons)


@pytest.mark.parametrize(
    "by", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda by: by.name
)
def test_an_interrupted_run_leaves_nothing_behind(
    by: signal.Signals, here: Path, tmp_path: Path
) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    words = ["validate", "3ladder", "--no-cache", "--json", "v.json", "--html", "v.html"]
    running = subprocess.Popen(
        [sys.executable, "-m", "mbds_xsim", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"TMPDIR": str(scratch)},
        start_new_session=True,
        # Background jobs ignore Ctrl-C and those of nohup SIGHUP, and so would what they start.
        preexec_fn=lambda: signal.signal(by, signal.SIG_DFL),
    )
    wait(lambda: any(scratch.glob("mbds-xsim-*/*.log")))

    running.send_signal(by)
    out, err = running.communicate(timeout=300)

    assert (running.returncode, out, err) == (130, "", "mbds-xsim: interrupted\n")
    assert list(here.iterdir()) == []
    assert list(scratch.iterdir()) == []
    wait(lambda: not _living(running.pid))


def _living(session: int) -> list[Path]:
    """Return live processes of a session; a dead one may wait for its parent to notice."""
    processes = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, _, own_session = status.read_text().rpartition(")")[2].split()[:4]
            if own_session == str(session) and state != "Z":
                processes.append(status)
    return processes


@pytest.mark.parametrize(
    "kind", [Validation, EngineResult, FindingResult, ReferenceResult, EnsembleResult]
)
def test_the_page_of_the_json_names_every_key_and_no_other(kind: type[msgspec.Struct]) -> None:
    page = (Path(__file__).parents[2] / "docs/validate-json.md").read_text("utf-8")
    (section,) = re.findall(rf"^## {kind.__name__}\n(.*?)(?=^## |\Z)", page, re.M | re.S)

    keys = [key for cell in re.findall(r"^\| (`.*?) \|", section, re.M) for key in cell.split(", ")]

    assert keys == [f"`{key}`" for key in kind.__struct_fields__]


def _decoded(text: str) -> Validation:
    """Decode the JSON by its types; all of their keys are there, and no other."""
    validation = msgspec.json.decode(text, type=Validation)
    assert validation.schema == SCHEMA
    assert list(json.loads(text)) == list(Validation.__struct_fields__)
    assert json.loads(msgspec.json.encode(validation)) == json.loads(text)
    return validation


def test_what_is_written_on_a_model_says_what_of_it_is_simulated(
    run: CommandLine, in_process: None, here: Path
) -> None:
    del in_process
    (here / "arm.xml").write_text(
        '<mujoco><option density="1.2"/><worldbody><body><joint name="pin" axis="0 1 0"/>'
        '<geom type="box" size=".1 .1 .3" pos="0 0 -.5"/></body></worldbody></mujoco>'
    )
    how = ("--engines", "mujoco", "--method", "RK4", "--step", "0.01")
    run("validate", "arm.xml", *how, "--markdown", "v.md")

    page = (here / "v.md").read_text()
    assert "What of the model is simulated" in page
    assert "arm.xml, read by MuJoCo" in page
    assert "there is no fluid" in page
