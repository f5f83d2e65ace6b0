"""Slow packages are imported only by the commands that need them, when they run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from mbds_xsim import __main__ as cli
from mbds_xsim.base.errors import Notice
from mbds_xsim.simulate.adapter import Adapter
from tests.command_line import CommandLine

_ENGINES = {"mujoco", "pybullet", "dartpy", "exudyn"}
_TOOLS = {"torch", "numba", "matplotlib", "scipy", "h5py", "numpy", "jinja2", "rich.table"}
_HEAVY = _ENGINES | _TOOLS


@pytest.mark.parametrize("module", ["mbds_xsim", "mbds_xsim.__main__"])
def test_importing_loads_nothing_heavy(module: str) -> None:
    assert not _loaded(f"import {module}") & _HEAVY


@pytest.mark.parametrize("words", [["--help"], ["validate", "--help"], ["show", "--help"]])
def test_help_loads_nothing_heavy(words: list[str]) -> None:
    assert not _loaded(_RUN.format(words=words)) & _HEAVY


def test_version_is_that_of_the_package(run: CommandLine) -> None:
    ended = run("--version")

    assert (ended.code, ended.out) == (0, f"mbds-xsim {version('mbds-xsim')}\n")


def test_showing_a_scene_loads_no_engine_and_no_plots() -> None:
    loaded = _loaded(_RUN.format(words=["show", "2pendulum"]))

    assert "numpy" in loaded
    assert not loaded & (_ENGINES | {"torch", "matplotlib"})


def test_studies_of_engines_begin_without_torch_and_optimisers() -> None:
    studies = ("studies.tradeoff.study", "studies.stability.survey", "studies.validate")
    reports = ("studies.tradeoff.present", "studies.stability.present")
    modules = ", ".join(f"mbds_xsim.{name}" for name in (*studies, *reports))

    assert not _loaded(f"import {modules}") & {"torch", "scipy"}


def test_the_process_of_an_engine_does_without_scipy(adapter: Adapter) -> None:
    """A validation starts dozens of processes, and scipy takes longer to import than an engine."""
    load = f"registry.load_adapter({adapter.name!r})"

    assert "scipy" not in _loaded(f"from mbds_xsim.simulate import registry, timed; {load}")


@pytest.mark.parametrize("name", ["exudyn", "mujoco"])
def test_loops_that_are_closed_as_written_are_drawn_and_loaded_without_scipy(name: str) -> None:
    assert "scipy" not in _loaded(_SIMULATE.format(name=name))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_of_the_imports_is_told_in_a_line(
    number: signal.Signals, tmp_path: Path
) -> None:
    halt = f"import os, time\nos.kill(os.getpid(), {int(number)})\ntime.sleep(10)"
    (tmp_path / "typer.py").write_text(halt)
    program = [sys.executable, "-m", "mbds_xsim", "engines"]

    ended = subprocess.run(
        program,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )

    outcome = (ended.returncode, ended.stdout, ended.stderr)
    assert outcome == (130, "", "mbds-xsim: interrupted\n")


@pytest.mark.parametrize(
    ("category", "written"), [(Notice, "mbds-xsim: it\n"), (UserWarning, "x.py:3: UserWarning: it")]
)
def test_only_warnings_of_this_program_bear_its_name(
    category: type[UserWarning], written: str
) -> None:
    assert cli._format("it", category, "x.py", 3).startswith(written)


def test_an_interruption_while_an_object_is_freed_is_not_lost() -> None:
    ended = subprocess.run(
        [sys.executable, "-c", _FREED], capture_output=True, text=True, check=False, timeout=60
    )

    assert (ended.returncode, ended.stderr) == (130, "mbds-xsim: interrupted\n")


_FREED = """
import os, signal, sys, time
from mbds_xsim.__main__ import main
from mbds_xsim.commands import app

class Freed:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)

@app.command()
def work():
    Freed()
    time.sleep(10)

sys.argv = ["mbds-xsim", "work"]
main()
"""

_SIMULATE = """
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate import choice, registry, timed

scene, adapter = registry.load_scene("2ladder"), registry.load_adapter("{name}")
settings = choice.settings_for(scene, adapter, "matched")
timed.simulate(scene, draw_batch(scene, [0]).truncated(1), adapter.name, settings)
"""

_RUN = """
import contextlib, sys
from mbds_xsim.__main__ import main
sys.argv = ["mbds-xsim", *{words!r}]
with contextlib.suppress(SystemExit):
    main()
"""


def _loaded(program: str) -> set[str]:
    code = f"{program}\nimport sys\nprint(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stderr.split())
