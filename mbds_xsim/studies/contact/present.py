"""Contact as measured in each engine: tables of one row per quantity, and two figures.

The figures show rebound over speed and friction over heading.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import write_whole
from mbds_xsim.base.isolate import Conduct, Crash, Task, run_tasks
from mbds_xsim.measure.runner import machine
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Block, Cell, Remarks, Row, Text, row_of, table_of
from mbds_xsim.report.themed import DOTTED, ENGINES, engine_style, png
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Profile
from mbds_xsim.simulate.choice import Choice, as_profile
from mbds_xsim.simulate.claims import ContactLaw, Feature
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.simulate.timed import simulate
from mbds_xsim.studies.contact import ContactBench, ContactFigure
from mbds_xsim.studies.contact.friction import PUSHES, friction
from mbds_xsim.studies.contact.impacts import DROPS, SPINS, energy, impacts, limits, rest
from mbds_xsim.testing.contact_cases import FRICTION, RADIUS, RESTITUTION, RESTITUTIONS

_SCENE = "balldrop"
_REPEATS = 3


def cost(engine: str, profile: Profile) -> list[ContactFigure]:
    """Time one trajectory without its set-up, on a core that may have other work."""
    bench, scene = ContactBench(engine, profile, _SCENE), load_scene(_SCENE)
    batch = draw_batch(scene, [1], noise=False)
    runs = [simulate(scene, batch, engine, bench.settings) for _ in range(_REPEATS)]
    costs = np.array([run.rollout_s for run in runs]) / scene.clock.duration
    return [bench.figure("cost of a simulated second", "s", costs, runs[0].trajectory)]


# The longest first, so that no core is idle at the end.
_PARTS: dict[str, Callable[[str, Profile], list[ContactFigure]]] = {
    "impacts": impacts,
    "rest": rest,
    "friction": friction,
    "energy": energy,
    "limits": limits,
    "cost": cost,
}


class Missing(msgspec.Struct, frozen=True):
    """A part of the study that an engine did not complete."""

    engine: str
    profile: Profile
    part: str
    reason: str


class ContactStudy(msgspec.Struct, frozen=True):
    """Result of the study: all figures of all engines."""

    versions: dict[str, str]
    """Versions of the engines, in the order of the tables."""
    profiles: tuple[Profile, ...]
    laws: dict[str, ContactLaw]
    """Each adapter's description of its engine's contact."""
    figures: tuple[ContactFigure, ...]
    missing: tuple[Missing, ...]
    command: str
    machine: str
    wall_s: float

    def find(
        self, engine: str, profile: str, quantity: str, **at: float
    ) -> Iterator[ContactFigure]:
        """Yield the figures of a quantity under given conditions."""
        for m in self.figures:
            wanted = (m.engine, m.profile, m.quantity) == (engine, profile, quantity)
            if wanted and at.items() <= m.at.items():
                yield m


def study_contact(choice: Choice, conduct: Conduct, command: str = "") -> ContactStudy:
    """Measure every engine at every profile, each part in its own process.

    Methods and steps are those of the profiles.

    Raises:
        InputError: None of the engines has contact.
    """
    begin = time.perf_counter()
    profiles = tuple(map(as_profile, choice.profiles))
    adapters = {engine: registry.load_adapter(engine) for engine in choice.engines}
    without = {
        engine: f"it has no contact: {adapter.limits[Feature.CONTACT]}"
        for engine, adapter in adapters.items()
        if Feature.CONTACT in adapter.limits
    }
    adapters = {engine: each for engine, each in adapters.items() if engine not in without}
    if not adapters:
        msg = "; ".join(f"--engines: got {engine}: {reason}" for engine, reason in without.items())
        raise InputError(msg)
    work = [
        (engine, profile, part) for part in _PARTS for profile in profiles for engine in adapters
    ]
    conduct.meter.begin(len(work))
    answers = run_tasks(
        [Task(_PARTS[part], (engine, profile), choice.limit) for engine, profile, part in work],
        workers=conduct.workers,
        finished=lambda place, _: conduct.meter.advance(f"{work[place][0]}: {work[place][2]}"),
    )
    laws = ((engine, adapter.contact_law) for engine, adapter in adapters.items())
    results = list(zip(work, answers, strict=True))
    return ContactStudy(
        versions={engine: adapter.version() for engine, adapter in adapters.items()},
        profiles=profiles,
        laws={engine: law for engine, law in laws if law is not None},
        figures=tuple(m for _, part in results if not isinstance(part, Crash) for m in part),
        missing=(
            *(Missing(*w, part.reason) for w, part in results if isinstance(part, Crash)),
            *(
                Missing(engine, profile, "the study", reason)
                for engine, reason in (without | dict(choice.faulty)).items()
                for profile in profiles
            ),
        ),
        command=command,
        machine=machine(),
        wall_s=time.perf_counter() - begin,
    )


JUDGED = (
    "Figures are in bold if they deviate from what was asked for by more than 0.01 in a ball's "
    "restitution, 2 % in friction, 1° in its direction, 1 mm of hops, 1 mm/s of creep or "
    "trembling, 2 % of energy in a bounce or 0.1 % of energy without a cause; if a crate starts at "
    "another push than 1.05; or if an engine is wrong beyond a limit without saying so."
)


def _near(asked: float, tolerance: float) -> Callable[[float], bool]:
    """Return a function that judges whether a value is close to `asked`."""
    return lambda value: abs(value - asked) <= tolerance


def _any(_: float) -> bool:
    return True


def _speed(value: float) -> str:
    """Write a speed [m/s]: `9.0 mm/s`; less than 1 nm/s is 0."""
    return "0" if abs(value) < 1e-9 else f"{quantity.length(value)}/s"


def _tiny_length(value: float) -> str:
    """Write a length [m]; less than 0.1 nm is 0, of either sign."""
    return "0" if abs(value) < 1e-10 else quantity.length(value)


def _percent(value: float) -> str:
    """Write a share: `+1.7 %`; less than 0.001 % is 0."""
    if abs(value) < 1e-4:
        return "<0.01 %" if abs(value) >= 1e-5 else "0"
    return f"{100.0 * value:+.0f} %" if abs(value) >= 0.1 else f"{100.0 * value:+.2g} %"


_FIRST_ABOVE = min(push for push in PUSHES if push > 1.0)
"""Smallest push above the limit of friction, which should start a standing body."""
_STILL = _near(0.0, 1e-3)
_WAYS: dict[str, tuple[Callable[[float], str], Callable[[float], bool]]] = {
    "restitution": ("{:.3f}".format, _near(RESTITUTION, 0.01)),
    "impact duration": (quantity.span, _any),
    "impact depth": (quantity.length, _any),
    "sliding friction": ("{:.3f}".format, _near(FRICTION, 0.02 * FRICTION)),
    "friction aside of the slip": ("{:.1f}°".format, _near(0.0, 1.0)),
    "hops while it slides": (_tiny_length, _STILL),
    "creep at 0.9 of the limit": (_speed, _STILL),
    "push that starts it": ("{:g}".format, _near(_FIRST_ABOVE, 1e-9)),
    "energy by bounce": (_percent, _near(0.0, 0.02)),
    "energy that no law explains": (_percent, _near(0.0, 1e-3)),
    "largest rise of energy": (_percent, _any),
    "restitution of corners": ("{:.3f}".format, _any),
    "sinks by": (_tiny_length, _any),
    "hops by": (_tiny_length, _STILL),
    "moves at": (_speed, _STILL),
    "cost of a simulated second": (quantity.span, _any),
}
"""Functions that format and judge a figure, keyed by quantity without the body."""


def is_as_asked(measured: ContactFigure) -> bool | None:
    """Return whether a figure is close to what was asked for; None if there is none.

    A limit is, unless the engine is wrong beyond it without saying so.
    """
    way = _WAYS.get(measured.quantity.rpartition(": ")[2])
    if way is None:
        return not measured.note.startswith("silent")
    if measured.value is None:
        return None
    bounced = measured.quantity == "restitution"
    other = measured.at["restitution"] - RESTITUTION if bounced else 0.0
    return way[1](measured.value - other)


@dataclass(frozen=True)
class ContactLine:
    """A line of a table: one quantity under one condition."""

    label: str
    quantity: str
    at: dict[str, float] = field(default_factory=dict)
    nominal: str = ""
    form: Callable[[ContactFigure], Cell] | None = None
    """Function that makes the cell of a figure; without it, the quantity is in `_WAYS`."""

    def cell(self, study: ContactStudy, engine: str, profile: str) -> Cell:
        """Return the cell of an engine at a profile."""
        measured = next(study.find(engine, profile, self.quantity, **self.at), None)
        return Cell(quantity.NONE) if measured is None else (self.form or self.show)(measured)

    def show(self, measured: ContactFigure) -> Cell:
        """Format a figure; one that is far from the requested value is marked."""
        write, right = _WAYS[self.quantity.rpartition(": ")[2]]
        if measured.value is None:
            return Cell(quantity.NONE)
        return Cell(write(measured.value), "" if right(measured.value) else "over")


def _depth(measured: ContactFigure) -> Cell:
    """Write a depth as a share of the radius."""
    value = measured.value
    return Cell(quantity.NONE if value is None else f"{100.0 * value / RADIUS:.2g} %")


def _highest(measured: ContactFigure, most: float) -> Cell:
    """Write the highest correct speed, of `most` at most, and whether its end is told or silent."""
    if measured.value == most:
        return Cell(f"≥ {most:g}")
    text = quantity.NONE if measured.value is None else f"{measured.value:g}"
    ending = measured.note.split(" ")[0]
    return Cell(f"{text} {ending}".rstrip(), "over" if ending == "silent" else "")


def impact(at: float) -> dict[str, float]:
    """Return the conditions of an impact at a speed [m/s]."""
    return {"restitution": RESTITUTION, "speed": at}


def heading(angle: float) -> dict[str, float]:
    """Return the condition of a slip at an angle from x [°]."""
    return {"heading_deg": angle}


_E, _MU = f"{RESTITUTION:.3f}", f"{FRICTION:.3f}"
_START = "crate: push that starts it"
LINES = (
    ContactLine("rebound at 1 m/s", "restitution", impact(1.0), _E),
    ContactLine("rebound at 0.1 m/s", "restitution", impact(0.1), _E),
    ContactLine("an impact at 1 m/s takes", "impact duration", impact(1.0)),
    ContactLine("depth at 5 m/s, of radius", "impact depth", impact(5.0), form=_depth),
    ContactLine("friction along x", "ball: sliding friction", heading(0.0), _MU),
    ContactLine("friction at 45°", "ball: sliding friction", heading(45.0), _MU),
    ContactLine("friction aside at 15°", "ball: friction aside of the slip", heading(15.0), "0"),
    ContactLine(
        "under a wheel, aside at 30°", "wheel: friction aside of the slip", heading(30.0), "0"
    ),
    ContactLine("sliding ball hops by", "ball: hops while it slides", nominal="0"),
    ContactLine("creep at 0.9 μ m g, 45°", "crate: creep at 0.9 of the limit", heading(45.0), "0"),
    ContactLine("slides from × μ m g, 45°", _START, heading(45.0), f"{_FIRST_ABOVE:g}"),
    ContactLine("elastic ball, energy/bounce", "elastic ball: energy by bounce", nominal="0"),
    ContactLine("cubli, energy from nowhere", "cubli: energy that no law explains", nominal="0"),
    ContactLine("cubli, rebound of corners", "cubli: restitution of corners", nominal=_E),
    ContactLine("ball at rest sinks by", "ball dropped: sinks by", nominal="0"),
    ContactLine("crate at rest trembles at", "crate dropped: moves at", nominal="0"),
    ContactLine("spin up to, rad/s", "free spin", form=partial(_highest, most=SPINS[-1])),
    ContactLine(
        "impacts held up to, m/s", "impact speed held", form=partial(_highest, most=DROPS[-1])
    ),
    ContactLine("cost of 1 s of balldrop", "cost of a simulated second"),
)
"""Rows of the summary, in this order."""


def rows_of(study: ContactStudy, profile: Profile) -> Iterator[Row]:
    """Yield the summary's rows at a profile: label, requested value, one cell per engine."""
    for line in LINES:
        cells = (line.cell(study, engine, profile) for engine in study.versions)
        yield row_of((line.label, line.nominal, *cells))


def present(study: ContactStudy) -> Iterator[Block]:
    """Summarise contact in each engine, with one table per profile."""
    columns = ("", ">asked", *(f">{engine}" for engine in study.versions))
    for profile in study.profiles:
        yield table_of(columns, rows_of(study, profile), title=f"{profile} settings")
    yield Remarks.of((f"{m.engine} {m.profile}, {m.part}", m.reason) for m in study.missing)
    yield Text(JUDGED.replace("in bold", "marked ✗"), "muted")


_MARKS = "12x+34|_"
"""Markers, one per engine colour."""
_BOUNCING = [e for e in RESTITUTIONS if e > 0.0]
_NOMINAL_LINE = DOTTED | {"label": "asked"}


def draw_study(study: ContactStudy, files: dict[str, Path]) -> None:
    """Draw `restitution` and `friction` into PNG files, each with panels for the profiles."""
    count = len(study.profiles)
    rebound, friction = (8.8, 0.9 + 2.1 * count), (1.0 + 3.9 * count, 3.7)
    for name, panels, size, title in (
        ("restitution", _restitution, rebound, "rebound over impact speed"),
        ("friction", _friction, friction, "friction of a sliding ball over its heading"),
    ):
        draw = partial(_draw, study=study, panels=panels, title=title)
        write_whole(files[name], png(draw, size))


def _draw(
    figure: Any, study: ContactStudy, panels: Callable[[Any, ContactStudy], None], title: str
) -> None:
    panels(figure, study)
    figure.suptitle(f"{title}   ({study.command})", fontsize=10, x=0.01, ha="left")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)


def _restitution(figure: Any, study: ContactStudy) -> None:
    """Draw a row per profile and a column per restitution."""
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


def _rebounds(axes: Any, study: ContactStudy, profile: Profile, asked: float) -> None:
    """Draw the medians, and the spread over the starts."""
    axes.axhline(asked, **_NOMINAL_LINE)
    for figures, style in _curves(study, profile, "restitution", restitution=asked):
        speeds = [m.at["speed"] for m in figures]
        lows = [m.value if m.low is None else m.low for m in figures]
        highs = [m.value if m.high is None else m.high for m in figures]
        axes.fill_between(speeds, lows, highs, color=style["color"], alpha=0.15, linewidth=0)
        axes.plot(speeds, [m.value for m in figures], linewidth=1.2, **style)
    axes.set_xscale("log")
    axes.set_ylim(-0.05 * asked, 1.22 * asked)


def _friction(figure: Any, study: ContactStudy) -> None:
    """Draw a panel per profile."""
    panels = figure.subplots(1, len(study.profiles), sharey=True, squeeze=False)[0]
    for axes, profile in zip(panels, study.profiles, strict=True):
        axes.axhline(FRICTION, **_NOMINAL_LINE)
        for figures, style in _curves(study, profile, "ball: sliding friction"):
            axes.plot([m.at["heading_deg"] for m in figures], [m.value for m in figures], **style)
        axes.set_ylim(0.0, 0.7)
        axes.set_xticks(range(0, 91, 15))
        axes.set_title(f"{profile} settings", fontsize=9, loc="left")
        axes.set_xlabel("heading of the slip [° from x]")
    panels[0].set_ylabel("horizontal over vertical impulse")


def _curves(
    study: ContactStudy, profile: Profile, quantity: str, **at: float
) -> Iterator[tuple[list[ContactFigure], dict[str, Any]]]:
    """Yield each engine's figures and style; thin markers keep engines that agree visible."""
    for engine in study.versions:
        figures = [m for m in study.find(engine, profile, quantity, **at) if m.value is not None]
        place = engine_style(engine, study.versions).colour
        style = {"color": ENGINES[place], "marker": _MARKS[place], "label": engine}
        yield figures, style | {"markersize": 8, "markeredgewidth": 1.3}
