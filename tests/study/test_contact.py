"""The study of contact: the other measures against known answers, and the command."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from mbds_xsim.base.isolate import Conduct
from mbds_xsim.report.themed import ENGINES
from mbds_xsim.scene.state import Failure, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.studies.contact import PULL, ContactBench, ContactFigure, present
from mbds_xsim.studies.contact.friction import friction, sliding
from mbds_xsim.studies.contact.impacts import limits, per_bounce
from mbds_xsim.studies.contact.page import contact_page, words_of
from mbds_xsim.studies.contact.present import LINES
from mbds_xsim.testing.contact_cases import FRICTION
from tests.command_line import CommandLine


def _value(figures: list[ContactFigure], quantity: str, **at: float) -> float:
    (one,) = [m for m in figures if m.quantity == quantity and m.at == at]
    assert one.value is not None
    return one.value


def test_friction_is_told_from_impulses_though_the_body_hops() -> None:
    """The ground pushes for a quarter of the time, three times as hard as the weight and more."""
    time = np.linspace(0.0, 0.4, 21)
    motion = Trajectory.empty(time, 1, 1)
    pushed = np.clip(time, 0.1, 0.2) - 0.1
    aside = np.radians(10.0)
    motion.velocity[0, :, 0] = np.stack(
        [
            5.0 - 0.3 * np.cos(aside) * 3.0 * PULL * pushed,
            -0.3 * np.sin(aside) * 3.0 * PULL * pushed,
            3.0 * PULL * pushed - PULL * time,
        ],
        axis=-1,
    )

    coefficient, angle = sliding(motion, np.array([[1.0, 0.0, 0.0]]), (0.0, 0.4))

    assert coefficient == pytest.approx([0.3 * np.cos(aside)])
    assert angle == pytest.approx([10.0])


@pytest.mark.parametrize("gain", [-0.3, 0.0, 0.02])
def test_energy_by_bounce_is_what_the_heights_show(gain: float) -> None:
    """Five flights, each with its own height."""
    tops = 0.05 * (1.0 + gain) ** np.arange(5.0)
    gaps, climbs = [], []
    for k, top in enumerate(tops):
        speed = np.sqrt(2 * PULL * top)
        time = np.linspace(speed / PULL if k == 0 else 1e-3, 2 * speed / PULL - 1e-3, 9)
        gaps.append(speed * time - 0.5 * PULL * time**2)
        climbs.append(speed - PULL * time)

    gains = per_bounce(np.concatenate(gaps), np.concatenate(climbs), 0.05)

    assert gains == pytest.approx(gain, abs=1e-9)


def test_a_ball_that_never_leaves_the_ground_has_lost_its_energy() -> None:
    climb = np.array([0.0, -1.0, -0.5, 0.0, 0.0])

    assert per_bounce(np.array([0.05, 0.01, -0.01, -0.01, -0.01]), climb, 0.05) == -1.0


def test_known_laws_of_friction_show() -> None:
    """DART's own solver has a friction box: at 45° about √2 times as much, sliding and sticking."""
    pytest.importorskip("dartpy")

    figures = friction("dart", "native")

    assert _value(figures, "ball: sliding friction", heading_deg=0.0) == pytest.approx(FRICTION)
    diagonal = _value(figures, "ball: sliding friction", heading_deg=45.0)
    assert diagonal == pytest.approx(np.sqrt(2) * FRICTION, rel=1e-3)
    assert _value(figures, "crate: push that starts it", heading_deg=0.0) == 1.05
    assert _value(figures, "crate: push that starts it", heading_deg=45.0) == 1.5


def test_friction_under_a_wheel_is_opposite_to_its_slip() -> None:
    """Along its heading a wheel yields three times as much as across."""
    aside = "wheel: friction aside of the slip"
    for engine in ("mujoco", "pybullet"):
        pytest.importorskip(engine)
        assert _value(friction(engine, "matched"), aside, heading_deg=30.0) < 0.3


def test_drag_that_nobody_asked_for_is_told_as_silent() -> None:
    """PyBullet's default drag takes 0.04 (1 + ω) of the spin a second."""
    pytest.importorskip("pybullet")

    native, matched = limits("pybullet", "native"), limits("pybullet", "matched")

    slow = next(m for m in native if m.quantity == "free spin")
    assert slow.value == 1.0
    assert slow.note.startswith("silent at 2 rad/s: 1.97")
    assert _value(matched, "free spin") == 2000.0


def test_a_failure_counts_as_told() -> None:
    """DART cuts rebounds at 100 m/s, and the adapter says so."""
    pytest.importorskip("dartpy")

    fastest = next(m for m in limits("dart", "native") if m.quantity == "impact speed held")

    assert fastest.value == 100.0
    assert fastest.note.startswith("told at 200 m/s: contact sphere 0 hits the ground")


def test_figures_without_a_value_keep_the_reason() -> None:
    bench = ContactBench("dart", "native", "balldrop")

    lost = np.full((1, 1, 1, 3), np.nan)
    motion = Trajectory(np.zeros(1), lost, lost, lost, lost, (Failure(0, "lost"),))
    figure = bench.figure("restitution", "1", np.array([np.nan, np.nan]), motion)

    assert (figure.value, figure.low, figure.note) == (None, None, "lost")
    assert LINES[0].show(figure).text == "–"


@pytest.mark.parametrize(("value", "off"), [(0.9332, False), (0.95, True)])
def test_what_is_far_from_what_was_asked_is_marked(value: float, off: bool) -> None:
    line = LINES[0]
    figure = ContactFigure("dart", "native", line.quantity, "1", value, line.at)

    assert (line.show(figure).mark == "over") is off


def test_the_page_says_what_the_adapters_say() -> None:
    """Figures of the page may be old; its words must be today's."""
    page = (Path(__file__).parents[2] / "docs" / "contact.md").read_text("utf-8")
    laws = {name: registry.load_adapter(name).contact_law for name in registry.installed_engines()}

    stale = [name for name, law in laws.items() if law and words_of(name, law) not in page]

    again = "mbds-xsim contact --markdown docs/contact.md --figures docs/images"
    assert stale == [], f"docs/contact.md is stale; run: {again}"


def test_every_engine_has_a_mark_of_its_own() -> None:
    assert len(set(present._MARKS)) == len(present._MARKS) == len(ENGINES)


@pytest.mark.usefixtures("in_process")
def test_the_command_writes_page_figures_and_json(run: CommandLine, here: Path) -> None:
    """The command runs in this process; the next test covers parts that run apart."""
    pytest.importorskip("mujoco")
    words = ["contact", "--engines", "mujoco", "--settings", "native", "--json", "c.json"]

    ended = run(*words, "--markdown", "docs/c.md", "--figures", "docs/images")

    assert ended.code == 0
    result = json.loads((here / "c.json").read_text())
    assert result["missing"] == []
    assert {m["engine"] for m in result["figures"]} == {"mujoco"}
    page = (here / "docs/c.md").read_text("utf-8")
    assert "(images/contact-restitution.png)" in page
    assert (here / "docs/images/contact-friction.png").read_bytes()[:4] == b"\x89PNG"
    assert "| friction at 45° | 0.430 | **0.304** |" in page
    assert "rebound at 1 m/s" in ended.out
    assert "0.304✗" in ended.out


def test_a_part_that_fails_is_told_and_takes_nothing_with_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.setattr(present, "_PARTS", {"arithmetic": math.sqrt, "limits": limits})

    study = present.study_contact(Choice(("mujoco",), ("native",)), Conduct(1))

    (missing,) = study.missing
    assert (missing.engine, missing.profile, missing.part) == ("mujoco", "native", "arithmetic")
    assert missing.reason.startswith("TypeError: ")
    assert [m.quantity for m in study.figures] == ["free spin", "hinge spin", "impact speed held"]
    page = contact_page(study, {}, Path())
    assert f"- mujoco `native`, all of arithmetic: {missing.reason}" in page


def test_one_start_that_is_seen_is_drawn_and_what_an_engine_raises_stays_on_its_line(
    tmp_path: Path,
) -> None:
    at = {"restitution": 0.5, "speed": 1.0}
    alone = ContactFigure("mujoco", "native", "restitution", "1", 0.5, at)
    lost = present.Missing("mujoco", "native", "rest", "first\n# <b>second</b>")
    study = present.ContactStudy(
        {"mujoco": "1"}, ("native",), {}, (alone,), (lost,), "mbds-xsim contact", "a machine", 1.0
    )
    files = {name: tmp_path / f"{name}.png" for name in ("restitution", "friction")}

    present.draw_study(study, files)

    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in files.values())
    assert "all of rest: first # &lt;b>second&lt;/b>\n" in contact_page(study, {}, Path())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--engines", "bullet"], "no engine is called 'bullet'"),
        (
            ["--engines", "pinocchio"],
            "--engines: got pinocchio: it has no contact: Pinocchio computes",
        ),
        (["--settings", "best"], "no settings profile is called 'best'"),
        (["--markdown", "."], "--markdown: cannot write ."),
    ],
)
def test_bad_input_is_one_line(words: list[str], said: str, run: CommandLine) -> None:
    assert said in run("contact", *words).refusal
