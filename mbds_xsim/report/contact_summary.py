"""The study of contact in a table for reading in ten seconds, one column an engine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mbds_xsim.engine import Profile
from mbds_xsim.report import quantity
from mbds_xsim.studies.contact.bench import FRICTION, RADIUS, RESTITUTION, Measured
from mbds_xsim.studies.contact.friction import PUSHES
from mbds_xsim.studies.contact.limits import DROPS, SPINS
from mbds_xsim.studies.contact.study import ContactStudy

__all__ = [
    "FIRST_ABOVE",
    "JUDGED",
    "LINES",
    "Line",
    "Shown",
    "close_to",
    "figure_of",
    "limit",
    "percent",
    "print_study",
    "rows_of",
    "shown",
    "speed",
    "tiny_length",
]

JUDGED = (
    "Marked is what is further from the law that was asked for than 0.01 of restitution, 2 % of "
    "friction, 1° of its direction, 1 mm of hops, 1 mm/s of creep or trembling, 2 % of energy in a "
    "bounce, 0.1 % of energy from nowhere, and a limit that an engine keeps silent about."
)


@dataclass(frozen=True)
class Shown:
    """A cell."""

    text: str
    off: bool = False


@dataclass(frozen=True)
class Line:
    """A quantity under one condition."""

    label: str
    quantity: str
    tell: Callable[[Measured], str]
    right: Callable[[float], bool] = lambda _: True
    at: dict[str, float] = field(default_factory=dict)
    asked: str = ""


def speed(value: float) -> str:
    """Write a speed [m/s]: `9.0 mm/s`; less than 1 nm/s is 0."""
    return "0" if abs(value) < 1e-9 else f"{quantity.length(value)}/s"


def tiny_length(value: float) -> str:
    """Write a length [m]; less than 0.1 nm is 0, of either sign."""
    return "0" if abs(value) < 1e-10 else quantity.length(value)


def percent(value: float) -> str:
    """Write a share: `+1.7 %`; less than 0.001 % is 0."""
    if abs(value) < 1e-4:
        return "<0.01 %" if abs(value) >= 1e-5 else "0"
    return f"{100.0 * value:+.0f} %" if abs(value) >= 0.1 else f"{100.0 * value:+.2g} %"


def limit(measured: Measured, most: float) -> str:
    """Write up to where an engine delivers, and whether it tells."""
    if measured.value == most:
        return f"≥ {most:g}"
    reached = "–" if measured.value is None else f"{measured.value:g}"
    return f"{reached} {measured.note.split(' ')[0]}" if measured.note else reached


def close_to(asked: float, within: float) -> Callable[[float], bool]:
    """Judge by the distance from what was asked."""
    return lambda value: abs(value - asked) <= within


def _as(tell: Callable[[float], str]) -> Callable[[Measured], str]:
    return lambda measured: quantity.NONE if measured.value is None else tell(measured.value)


_COEFFICIENT = _as(lambda value: f"{value:.3f}")
_SLOW = close_to(0.0, 1e-3)
_IMPACT = {"restitution": RESTITUTION}
_DIAGONAL = {"heading_deg": 45.0}
FIRST_ABOVE = min(push for push in PUSHES if push > 1.0)
"""The push, over what friction bears, that should start what stands."""
_FRICTION_RIGHT = close_to(FRICTION, 0.02 * FRICTION)

LINES = (
    Line(
        "rebound at 1 m/s",
        "restitution",
        _COEFFICIENT,
        close_to(RESTITUTION, 0.01),
        {**_IMPACT, "speed": 1.0},
        f"{RESTITUTION:.3f}",
    ),
    Line(
        "rebound at 0.1 m/s",
        "restitution",
        _COEFFICIENT,
        close_to(RESTITUTION, 0.01),
        {**_IMPACT, "speed": 0.1},
        f"{RESTITUTION:.3f}",
    ),
    Line(
        "an impact at 1 m/s takes",
        "impact duration",
        _as(quantity.span),
        at={**_IMPACT, "speed": 1.0},
    ),
    Line(
        "depth at 5 m/s, of radius",
        "impact depth",
        _as(lambda value: f"{100.0 * value / RADIUS:.2g} %"),
        at={**_IMPACT, "speed": 5.0},
    ),
    Line(
        "friction along x",
        "ball: sliding friction",
        _COEFFICIENT,
        _FRICTION_RIGHT,
        {"heading_deg": 0.0},
        f"{FRICTION:.3f}",
    ),
    Line(
        "friction at 45°",
        "ball: sliding friction",
        _COEFFICIENT,
        _FRICTION_RIGHT,
        _DIAGONAL,
        f"{FRICTION:.3f}",
    ),
    Line(
        "friction aside at 15°",
        "ball: friction aside of the slip",
        _as(lambda value: f"{value:.1f}°"),
        close_to(0.0, 1.0),
        {"heading_deg": 15.0},
        "0",
    ),
    Line(
        "under a wheel, aside at 30°",
        "wheel: friction aside of the slip",
        _as(lambda value: f"{value:.1f}°"),
        close_to(0.0, 1.0),
        {"heading_deg": 30.0},
        "0",
    ),
    Line(
        "sliding ball hops by",
        "ball: hops while it slides",
        _as(tiny_length),
        close_to(0.0, 1e-3),
        asked="0",
    ),
    Line(
        "creep at 0.9 μ m g, 45°",
        "crate: creep at 0.9 of the limit",
        _as(speed),
        _SLOW,
        _DIAGONAL,
        "0",
    ),
    Line(
        "slides from × μ m g, 45°",
        "crate: push that starts it",
        _as(lambda value: f"{value:g}"),
        close_to(FIRST_ABOVE, 1e-9),
        _DIAGONAL,
        f"{FIRST_ABOVE:g}",
    ),
    Line(
        "elastic ball, energy/bounce",
        "elastic ball: energy by bounce",
        _as(percent),
        close_to(0.0, 0.02),
        asked="0",
    ),
    Line(
        "cubli, energy from nowhere",
        "cubli: energy that no law explains",
        _as(percent),
        close_to(0.0, 1e-3),
        asked="0",
    ),
    Line(
        "cubli, rebound of corners",
        "cubli: restitution of corners",
        _COEFFICIENT,
        asked=f"{RESTITUTION:.3f}",
    ),
    Line("ball at rest sinks by", "ball dropped: sinks by", _as(tiny_length), asked="0"),
    Line("crate at rest trembles at", "crate dropped: moves at", _as(speed), _SLOW, asked="0"),
    Line("spin up to, rad/s", "free spin", lambda m: limit(m, SPINS[-1])),
    Line("impacts held up to, m/s", "impact speed held", lambda m: limit(m, DROPS[-1])),
    Line("cost of 1 s of balldrop", "cost of a simulated second", _as(quantity.span)),
)
"""What the summary shows, in this order."""


def figure_of(
    study: ContactStudy, engine: str, profile: str, name: str, **at: float
) -> Measured | None:
    """Find one figure; None where the engine did not come through."""
    found = (m for m in study.find(name, **at) if (m.engine, m.profile) == (engine, profile))
    return next(found, None)


def shown(line: Line, measured: Measured | None) -> Shown:
    """Give the cell of a line."""
    if measured is None:
        return Shown(quantity.NONE)
    text = line.tell(measured)
    off = measured.value is not None and not line.right(measured.value)
    return Shown(text, off or text.endswith("silent"))


def rows_of(study: ContactStudy, profile: Profile) -> Iterator[tuple[Line, list[Shown]]]:
    """List the summary's rows at a profile, with a cell an engine."""
    for line in LINES:
        found = [figure_of(study, e, profile, line.quantity, **line.at) for e in study.versions]
        yield line, [shown(line, measured) for measured in found]


def _signed(cell: Shown) -> Text:
    return Text(f"{cell.text} ✗", "bold red") if cell.off else Text(cell.text)


def print_study(study: ContactStudy, console: Console) -> None:
    """Print the summary, one table a profile."""
    for profile in study.profiles:
        table = Table(
            title=f"{profile} settings",
            title_justify="left",
            box=box.SIMPLE_HEAD,
            padding=(0, 1, 0, 0),
            collapse_padding=True,
        )
        table.add_column("", no_wrap=True)
        table.add_column("asked", justify="right", no_wrap=True)
        for engine in study.versions:
            table.add_column(engine, justify="right", no_wrap=True)
        for line, cells in rows_of(study, profile):
            table.add_row(line.label, line.asked, *map(_signed, cells))
        console.print(table)
    for missing in study.missing:
        where = f"{missing.engine} {missing.profile}, {missing.part}"
        console.print(f"{where}: {missing.reason}")
    console.print(JUDGED.replace("Marked", "Marked ✗"), style="dim")
