"""Figures of the study of contact: rebound over speed, friction over heading."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from mbds_xsim.base.write import write_whole
from mbds_xsim.report.palette import ENGINES, engine_style
from mbds_xsim.report.themed import INK, png
from mbds_xsim.simulate.adapter import Profile
from mbds_xsim.studies.contact.bench import FRICTION, ContactFigure
from mbds_xsim.studies.contact.impacts import RESTITUTIONS
from mbds_xsim.studies.contact.study import ContactStudy

_MARKS = "12x+34"
_BOUNCING = [e for e in RESTITUTIONS if e > 0.0]
_ASKED: dict[str, Any] = {
    "color": INK, "linewidth": 0.9, "linestyle": (0, (1, 2)), "label": "asked",
}  # fmt: skip


def draw_study(study: ContactStudy, files: dict[str, Path]) -> None:
    """Draw the figures into PNG files, each with panels for the profiles.

    Args:
        study: What was measured.
        files: Where `restitution` and `friction` go.
    """
    count = len(study.profiles)
    rebound, friction = (8.8, 0.9 + 2.1 * count), (1.0 + 3.9 * count, 3.7)
    title = "rebound over impact speed"
    _draw(study, files["restitution"], _restitution, rebound, title)
    title = "friction of a sliding ball over its heading"
    _draw(study, files["friction"], _friction, friction, title)


def _draw(
    study: ContactStudy,
    path: Path,
    panels: Callable[[Any, ContactStudy], Any],
    size: tuple[float, float],
    title: str,
) -> None:
    def draw(figure: Any) -> None:
        first = panels(figure, study)
        figure.suptitle(f"{title}   ({study.command})", fontsize=10, x=0.01, ha="left")
        handles, labels = first.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)

    write_whole(path, png(draw, size))


def _restitution(figure: Any, study: ContactStudy) -> Any:
    """Lay out a row a profile, a column a restitution; returns a panel with all the names."""
    panels = figure.subplots(
        len(study.profiles), len(_BOUNCING), sharex=True, sharey="col", squeeze=False
    )
    for row, profile in zip(panels, study.profiles, strict=True):
        for axes, asked in zip(row, _BOUNCING, strict=True):
            _rebounds(axes, study, profile, asked)
            axes.set_title(f"{profile}, asked {asked:g}", fontsize=9, loc="left")
        row[0].set_ylabel("speed after over before")
    for axes in panels[-1]:
        axes.set_xlabel("impact speed [m/s]")
    return panels[0][0]


def _rebounds(axes: Any, study: ContactStudy, profile: Profile, asked: float) -> None:
    """Draw the medians, and the spread over the starts."""
    axes.axhline(asked, **_ASKED)
    for found, look in _curves(study, profile, "restitution", restitution=asked):
        speeds = [m.at["speed"] for m in found]
        lows, highs = [m.low for m in found], [m.high for m in found]
        axes.fill_between(speeds, lows, highs, color=look["color"], alpha=0.15, linewidth=0)
        axes.plot(speeds, [m.value for m in found], linewidth=1.2, **look)
    axes.set_xscale("log")
    axes.set_ylim(-0.05 * asked, 1.22 * asked)


def _friction(figure: Any, study: ContactStudy) -> Any:
    """Lay out a panel a profile; returns the first."""
    panels = figure.subplots(1, len(study.profiles), sharey=True, squeeze=False)[0]
    for axes, profile in zip(panels, study.profiles, strict=True):
        _headings(axes, study, profile)
        axes.set_title(f"{profile} settings", fontsize=9, loc="left")
        axes.set_xlabel("heading of the slip [° from x]")
    panels[0].set_ylabel("horizontal over vertical impulse")
    return panels[0]


def _headings(axes: Any, study: ContactStudy, profile: Profile) -> None:
    axes.axhline(FRICTION, **_ASKED)
    for found, look in _curves(study, profile, "ball: sliding friction"):
        axes.plot([m.at["heading_deg"] for m in found], [m.value for m in found], **look)
    axes.set_ylim(0.0, 0.7)
    axes.set_xticks(range(0, 91, 15))


def _curves(
    study: ContactStudy, profile: Profile, quantity: str, **at: float
) -> Iterator[tuple[list[ContactFigure], dict[str, Any]]]:
    """Give each engine's figures and its look, with thin marks: engines that agree stay visible."""
    for engine in study.versions:
        found = [m for m in study.find(engine, profile, quantity, **at) if m.value is not None]
        place = engine_style(engine, study.versions).colour
        look = {"color": ENGINES[place], "marker": _MARKS[place], "label": engine}
        yield found, look | {"markersize": 8, "markeredgewidth": 1.3}
