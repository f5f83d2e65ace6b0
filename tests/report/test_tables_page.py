"""Pages of audits and of matched settings, and how a page is opened."""

from __future__ import annotations

import re
import tempfile
import webbrowser
from pathlib import Path

import pytest
import typer
from rich.console import Console

from mbds_xsim.commands import app, shared
from mbds_xsim.commands.shared import Outputs, command_line
from mbds_xsim.dataset.audit import Audited
from mbds_xsim.measure.result import FindingResult
from mbds_xsim.report.files import to_html
from mbds_xsim.studies import audit, match
from mbds_xsim.studies.match import Match, MatchedSettings
from tests.results import found, matched

_LEAD = re.compile(r'<p class="lead">(.*?)</p>')


def _finding(check: str, figure: float, budget: float | None) -> FindingResult:
    return FindingResult(
        check=check,
        unit="m",
        figure=figure,
        budget=budget,
        passed=budget is None or figure <= budget,
        trajectory=0,
        frame=7,
        where="rod<1>",
        figures=(figure,),
        note="",
    )


def _audited(*findings: FindingResult) -> Audited:
    broken = tuple(f"{f.check}: {f.figure:g} m" for f in findings if not f.passed)
    return Audited(
        file="lab.csv",
        scene="2pendulum",
        verdict="fail" if broken else "pass",
        trajectories=1,
        steps=10,
        frame_s=0.02,
        given=("time", "position"),
        taken=("start: frame 0 of the file",),
        findings=findings,
        reasons=broken,
        not_checked={"energy": "no velocities", "momentum": "no velocities"},
    )


def _found(engine: str, cost: float, *, met: bool = True) -> MatchedSettings:
    reasons = () if met else ("gap: 3 mm, allowed 1 mm",)
    times = {"wall_per_simulated_s": cost, "cpu_per_simulated_s": cost}
    return found(engine=engine, meets_budget=met, reasons=reasons, **times)


def _match(*engines: MatchedSettings) -> Match:
    left_out = {"dart": "dart cannot do distance link"}
    return matched(*engines, scene="my <b>bold</b> scene", left_out=left_out)


def test_an_audit_says_first_whether_the_trajectories_hold() -> None:
    sound = _audited(_finding("gap", 1e-6, 1e-4))
    broken = _audited(_finding("gap", 3e-3, 1e-4), _finding("finite", 0.0, None))
    good, bad = (
        to_html([audit.present(audited, "mbds-xsim audit lab.csv")], "lab.csv")
        for audited in (sound, broken)
    )

    assert _LEAD.findall(good) == ["Every check that ran holds (1, on 1 trajectory of 2pendulum). "]
    assert _LEAD.findall(bad) == ["1 check out of budget on 1 trajectory of 2pendulum: gap. "]
    assert "✗ fail" in bad
    assert "✗" not in good.partition("</header>")[0]
    assert "not checked: energy, momentum" in bad
    assert "rod&lt;1&gt;" in bad
    assert "shares of the budgets: gap 30" in bad


def test_a_match_says_first_who_keeps_the_budgets_at_what_cost() -> None:
    page, mixed = (
        to_html([match.present(_match(_found("exudyn", 0.2), other))], "")
        for other in (_found("mujoco", 0.002), _found("mujoco", 0.1, met=False))
    )

    (lead,) = _LEAD.findall(page)
    assert "2 of 2 engines within all budgets; cheapest is mujoco RK4 at 10 ms, 2.0 ms" in lead
    (lead,) = _LEAD.findall(mixed)
    assert "1 of 2 engines within all budgets; not mujoco; cheapest is exudyn" in lead
    assert "gap: 3 mm, allowed 1 mm" in mixed
    assert "dart cannot do distance link" in page
    assert "<b>" not in page


def test_every_command_that_writes_a_page_opens_it() -> None:
    group = typer.main.get_command(app)
    options = {
        name: {opt for parameter in command.params for opt in parameter.opts}
        for name, command in group.commands.items()  # type: ignore[attr-defined]
    }
    writing = {name for name, known in options.items() if "--html" in known}

    studies = {"match", "releases", "shift", "stability", "tradeoff", "validate"}
    assert writing == studies | {"audit", "import", "readers"}
    assert all("--open" in options[name] for name in writing)


def test_a_page_is_opened_where_it_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    console = Console(record=True, width=200)
    addresses: list[str] = []

    def no_browser(address: str) -> bool:
        addresses.append(address)
        return False

    monkeypatch.setattr(webbrowser, "open", no_browser)

    monkeypatch.setattr("sys.argv", ["mbds-xsim", "audit", "lab.csv"])
    monkeypatch.setattr(tempfile, "mkdtemp", lambda **_: str(tmp_path))
    report = audit.present(_audited(_finding("gap", 1e-6, 1e-4)), "")

    monkeypatch.setattr(shared, "console_for", lambda _: console)
    Outputs().give([report], "")
    assert not list(tmp_path.iterdir())
    Outputs(html=tmp_path / "a.html", opened=True).give([report], "")
    Outputs(opened=True).give([report], "")

    pages = [tmp_path / "a.html", tmp_path / "page.html"]
    assert addresses == [page.as_uri() for page in pages]
    text = console.export_text()
    assert all(page.is_file() and str(page) in text for page in pages)
    assert "there is no browser" in text


def test_that_a_page_was_opened_says_nothing_about_results(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["mbds-xsim", "match", "my.toml", "--open", "--html=a.html"])

    assert command_line() == "mbds-xsim match my.toml"
