"""Long work reports its progress, on a terminal and in a log."""

from __future__ import annotations

import io
import re
import time

import pytest
from rich.console import Console

from mbds_xsim.report import progress as progress_module
from mbds_xsim.report.progress import GeneratingBar, ProgressBar, StudyBar


def test_a_log_gets_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress_module, "_EVERY", 0.02)
    with ProgressBar(Console(file=io.StringIO())) as progress:
        progress.begin(4)
        progress.advance("dart [/x] \x1b[31m matched")
        time.sleep(0.2)
    time.sleep(0.05)
    lines = capsys.readouterr().err.splitlines()

    assert len(lines) > 1
    assert lines[-1].startswith("mbds-xsim: dart [/x] �[31m matched 1/4 0:00:00 left")


def test_short_work_is_silent_in_a_log(capsys: pytest.CaptureFixture[str]) -> None:
    with ProgressBar(Console(file=io.StringIO())) as progress:
        progress.begin(1)

    assert capsys.readouterr().err == ""


def test_a_terminal_shows_what_is_done_as_it_is_called() -> None:
    shown = io.StringIO()
    with ProgressBar(Console(file=shown, force_terminal=True, width=120)) as progress:
        progress.begin(2)
        progress.advance("[/x] matched")

    assert "[/x] matched" in shown.getvalue()


def test_the_rate_of_a_data_set_counts_trajectories_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress_module, "_EVERY", 0.01)
    monkeypatch.setattr(GeneratingBar, "_spent", lambda _: 10.0)
    with GeneratingBar(Console(file=io.StringIO())) as progress:
        progress.begin(100, 10)
        progress.advance("a search for settings")
        progress.made(50, 3)
        time.sleep(0.1)

    assert " a search for settings 61/100 5/s " in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(("forecast_s", "left"), [(7200.0, "(1:00:00|0:59:)"), (0.1, "-:--:--")])
def test_time_left_is_unknown_once_it_has_passed(
    forecast_s: float,
    left: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(progress_module, "_EVERY", 0.01)
    with StudyBar(Console(file=io.StringIO()), 2, "3ladder") as progress:
        progress.forecast(forecast_s)
        time.sleep(0.2)

    assert re.search(f" left {left}", capsys.readouterr().err.splitlines()[-1])


@pytest.mark.parametrize("terminal", [True, False])
def test_a_notice_stays_to_be_read(terminal: bool, capsys: pytest.CaptureFixture[str]) -> None:
    shown = io.StringIO()
    with ProgressBar(Console(file=shown, force_terminal=terminal, width=120)) as progress:
        progress.begin(2)
        progress.notice("dart on [m]: 3 min")

    text = shown.getvalue() if terminal else capsys.readouterr().err
    assert "dart on [m]: 3 min\n" in text
