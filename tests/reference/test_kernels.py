"""The reference is compiled once, and whoever waits for it is told so."""

from __future__ import annotations

from pathlib import Path

import pytest

from mbds_xsim.reference import kernels


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(kernels, "kernel_folder", kernels.kernel_folder.__wrapped__)
    return kernels.kernel_folder()


def test_it_is_compiled_once_and_told_before(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    happened: list[str] = []

    def compiled() -> None:
        happened.append("compiled")
        folder.mkdir(parents=True)
        (folder / "ready").touch()

    monkeypatch.setattr(kernels, "_compile", compiled)
    for _ in range(2):
        kernels.compile_once(happened.append, workers=0)

    told, done = happened
    assert "compiled for this machine, once" in told
    assert done == "compiled"


def test_a_compiler_that_crashes_is_told_and_stops_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr(kernels, "_compile", int.bit_count)  # wants an argument

    kernels.compile_once(told.append, workers=1)

    assert "could not be compiled: TypeError" in told[1]
    assert not folder.exists()
