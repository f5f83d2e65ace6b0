"""Output that is full, hung up, unread, a device or a link."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

from mbds_xsim.base.text import encoded
from mbds_xsim.commands.shared import Outputs
from mbds_xsim.scene.file import save_scene
from mbds_xsim.scene.scene import Body, Particle, Scene
from tests.cli.conftest import PROGRAM
from tests.command_line import CommandLine


def test_a_full_disk_and_an_output_that_hangs_up(program: CommandLine, here: Path) -> None:
    for words in ((), ("--json", "scenes.json")):
        with open("/dev/full", "w") as full:
            ended = program("scenes", *words, stdout=full)
        assert (ended.code, ended.err) == (2, "mbds-xsim: [Errno 28] No space left on device\n")
    assert (here / "scenes.json").read_bytes().startswith(b"[")

    reading, writing = os.pipe()
    os.close(reading)
    ended = program("scenes", "--json", "-", stdout=writing)
    os.close(writing)
    assert "Traceback" not in ended.err


def test_what_nobody_reads_is_written_all_the_same(program: CommandLine, here: Path) -> None:
    """`validate … --markdown page.md | head -1`: the reader is gone before files are written."""
    reading, writing = os.pipe()
    os.close(reading)
    words = ("validate", "1pendulum", "--engines", "mujoco", "--trajectories", "1")
    ended = program(*words, "--markdown", "page.md", stdout=writing)
    os.close(writing)
    assert (ended.code, ended.err) == (0, "")
    assert "1pendulum" in (here / "page.md").read_text("utf-8")


def test_devices_and_links_are_written_through(run: CommandLine, here: Path) -> None:
    """Renaming a finished file onto /dev/null would put a file in its place."""
    (here / "link.json").symlink_to("target.json")
    (here / "loop.json").symlink_to("loop.json")

    assert run("scenes", "--json", "/dev/null").code == 0
    assert run("scenes", "--json", "link.json").code == 0
    assert run("scenes", "--json", "loop.json").code == 0

    assert not Path("/dev/null").is_file()
    assert (here / "link.json").is_symlink()
    assert (here / "target.json").read_bytes().startswith(b"[")


def test_a_full_stream_of_errors_leaves_the_exit_code() -> None:
    with open("/dev/full", "w") as full:
        assert subprocess.run([PROGRAM, "nonsense"], stderr=full, timeout=600).returncode == 2


def test_a_line_with_a_path_is_printed_whole(capsys: pytest.CaptureFixture[str]) -> None:
    path = "a folder/" * 30
    Outputs().say(f"written: {path}")

    assert capsys.readouterr().out == f"written: {path}\n"


def test_json_of_a_tuple_of_odd_file_names_is_written() -> None:
    odd = os.fsdecode(b"d\xff")

    assert b"d\\\\udcff" in encoded({"files": (odd,)}, "verify")


def test_json_on_a_stream_that_is_not_utf_8_can_be_read(
    program: CommandLine, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ball = Body("ball", particles=(Particle((0.0, 0.0, 0.0)),))
    save_scene(Scene("Büro 🎈", (ball,), length=1.0), here / "office.toml")
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")

    assert json.loads(program("show", "office.toml", "--json", "-").out)["scene"] == "Büro 🎈"


def test_two_names_may_lead_to_one_stream(here: Path) -> None:
    """As /dev/stdout and /dev/stderr do in a terminal."""
    for name in ("one", "other"):
        (here / name).symlink_to(os.devnull)

    Outputs(json=Path("one"), markdown=Path("other")).check()
