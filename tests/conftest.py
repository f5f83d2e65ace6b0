"""Engines as a parameter: every test that asks for `adapter` runs on all of them."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from mbds_xsim import __main__ as cli
from mbds_xsim.base import isolate
from mbds_xsim.base.errors import EngineMissing
from mbds_xsim.checks.kernels import CHECKS
from mbds_xsim.measure import quick
from mbds_xsim.reference.kernels import REFERENCE, compile_once
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Adapter
from mbds_xsim.simulate.claims import Feature
from tests.command_line import CommandLine, Ended
from tests.farm import Farm

_WITHOUT = quick._without


def pytest_configure(config: pytest.Config) -> None:
    """Make interruptions work, and compile machine code before many processes need it.

    Programs that a shell starts in the background ignore SIGINT, which tests send.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if not hasattr(config, "workerinput"):
        compile_once(print, workers=None, kernels=[REFERENCE, CHECKS])


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--engines", help="comma-separated; all known ones when left out")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "engine" in metafunc.fixturenames:
        chosen = metafunc.config.getoption("--engines")
        names = chosen.split(",") if chosen else registry.engine_names()
        metafunc.parametrize("engine", names, scope="session")


@pytest.fixture(scope="session")
def adapter(engine: str) -> Adapter:
    """Skip a missing engine on a laptop; fail where it must run (CI names them all)."""
    try:
        return registry.load_adapter(engine)
    except EngineMissing as error:
        if engine in os.environ.get("MBDS_XSIM_MUST_RUN", "").split(","):
            raise
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def grounded(adapter: Adapter) -> Adapter:
    """Skip an engine that has no contact."""
    if adapter.contact_law is None:
        pytest.skip(f"{adapter.name} has no contact")
    return adapter


@pytest.fixture(scope="session")
def cornered(grounded: Adapter) -> Adapter:
    """Skip an engine that has contact of balls only."""
    if Feature.LINKED_CONTACT in grounded.limits:
        pytest.skip(f"{grounded.name} has contact of balls only")
    return grounded


@pytest.fixture(scope="session", autouse=True)
def _presets() -> Iterator[None]:
    """Skip the search for settings (seconds per engine) unless a test asks for it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quick, "_without", lambda *_: [])
        yield


@pytest.fixture
def search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Search settings where none are stored; nothing is known beforehand."""
    monkeypatch.setattr(quick, "_without", _WITHOUT)
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Carry out all tasks in this process, which spares their start where nothing may crash."""
    real = isolate.run_tasks

    def run_here(tasks: Sequence[isolate.Task], **options: Any) -> list[Any]:
        return real(tasks, **(options | {"workers": 0}))

    for module in list(sys.modules.values()):
        if vars(module).get("run_tasks") is real:
            monkeypatch.setattr(module, "run_tasks", run_here)


@pytest.fixture
def farm(tmp_path: Path) -> Iterator[Farm]:
    """A scheduler; tests start workers."""
    farm = Farm(tmp_path)
    try:
        yield farm
    finally:
        farm.close()


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Change into an empty folder, with stored references in a cache of its own."""
    kept = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path / "cache"))
    yield folder
    for number, action in kept.items():
        signal.signal(number, action)


@pytest.fixture
def run(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> CommandLine:
    """Call the entry point of the program in this process."""
    del here

    def call(*words: str) -> Ended:
        monkeypatch.setattr(sys, "argv", ["mbds-xsim", *words])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capsys.readouterr()
        return Ended(int(ended.value.code or 0), out, err)

    return call
