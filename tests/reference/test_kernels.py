"""The reference is compiled once, and whoever waits for it is told so."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from mbds_xsim.reference import cache, kernels


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache, "kernel_folder", cache.kernel_folder.__wrapped__)
    return cache.kernel_folder()


def test_it_is_compiled_once_and_told_before(folder: Path) -> None:
    happened: list[str] = []

    def compiled() -> None:
        happened.append("compiled")
        folder.mkdir(parents=True)

    for _ in range(2):
        some = [kernels.Kernels("reference", compiled, 15)]
        kernels.compile_once(happened.append, workers=0, kernels=some)

    message, event = happened
    assert message.endswith("compiled for this machine, once: about 15 s on one core")
    assert event == "compiled"


def test_a_compiler_that_crashes_is_told_and_stops_nothing(folder: Path) -> None:
    messages: list[str] = []
    wrong = kernels.Kernels("reference", int.bit_count, 15)  # type: ignore[arg-type]

    kernels.compile_once(messages.append, workers=1, kernels=[wrong])

    assert "could not be compiled: TypeError" in messages[1]
    assert not folder.exists()


def test_machine_code_of_other_versions_goes_a_month_after_its_last_use(folder: Path) -> None:
    others = {days: folder.with_name(f"{days} days") for days in (29, 31)}
    for days, other in others.items():
        (other / "numba").mkdir(parents=True)
        os.utime(other, (time.time() - days * 86400.0,) * 2)
    folder.mkdir()
    os.utime(folder, (0.0, 0.0))

    kernels._remove_unused(cache.kernel_folder())

    assert [other.exists() for other in others.values()] == [True, False]
    assert time.time() - folder.stat().st_mtime < 60.0
