"""Output that is full, hung up, unread, a device or a link."""

from __future__ import annotations

import os
from pathlib import Path

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
