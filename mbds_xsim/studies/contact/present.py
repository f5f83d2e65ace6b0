"""What contact means in each engine, on the terminal: a line a quantity, a column an engine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Block, Cell, Column, Remarks, Row, Table, Text
from mbds_xsim.simulate.adapter import Profile
from mbds_xsim.studies.contact.bench import FRICTION, RADIUS, RESTITUTION, ContactFigure
from mbds_xsim.studies.contact.friction import PUSHES
from mbds_xsim.studies.contact.limits import DROPS, SPINS
from mbds_xsim.studies.contact.study import ContactStudy

JUDGED = (
    "Marked is what is further from the law that was asked for than 0.01 of restitution, 2 % of "
    "friction, 1° of its direction, 1 mm of hops, 1 mm/s of creep or trembling, 2 % of energy in a "
    "bounce, 0.1 % of energy from nowhere, and a limit that an engine keeps silent about."
)


def near(asked: float, within: float) -> Callable[[float], bool]:
    """Judge by the distance from what was asked."""
    return lambda value: abs(value - asked) <= within


_FIRST_ABOVE = min(push for push in PUSHES if push > 1.0)
REBOUND_LAW = near(RESTITUTION, 0.01)
FRICTION_LAW = near(FRICTION, 0.02 * FRICTION)
STRAIGHT = near(0.0, 1.0)
STILL = near(0.0, 1e-3)
NOWHERE = near(0.0, 1e-3)
SPREAD = near(0.0, 0.02)
STARTS = near(_FIRST_ABOVE, 1e-9)
"""The first push over what friction bears should start what stands."""


@dataclass(frozen=True)
class Line:
    """A quantity under one condition."""

    label: str
    quantity: str
    write: Callable[[float], str]
    right: Callable[[float], bool] = lambda _: True
    at: dict[str, float] = field(default_factory=dict)
    asked: str = ""
    most: float | None = None
    """The largest that was tried, of what is a limit."""

    def cell(self, study: ContactStudy, engine: str, profile: str) -> Cell:
        """Show what was measured in an engine."""
        return self.show(figure_of(study, engine, profile, self.quantity, **self.at))

    def show(self, measured: ContactFigure | None) -> Cell:
        """Write a figure; one that is far from what was asked is marked."""
        if measured is None:
            return Cell(quantity.NONE)
        value = measured.value
        text = quantity.NONE if value is None else self.write(value)
        if self.most is None:
            return Cell(text, "" if value is None or self.right(value) else "over")
        how = measured.note.split(" ")[0]  # how it ends: told or silent
        text = f"≥ {self.most:g}" if value == self.most else f"{text} {how}".rstrip()
        return Cell(text, "over" if text.endswith("silent") else "")


def figure_of(
    study: ContactStudy, engine: str, profile: str, name: str, **at: float
) -> ContactFigure | None:
    """Find one figure; None where the engine did not come through."""
    found = (m for m in study.find(name, **at) if (m.engine, m.profile) == (engine, profile))
    return next(found, None)


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


def coefficient(value: float) -> str:
    """Write a coefficient of friction or restitution."""
    return f"{value:.3f}"


def degrees(value: float) -> str:
    """Write an angle [°]."""
    return f"{value:.1f}°"


def _of_radius(depth: float) -> str:
    return f"{100.0 * depth / RADIUS:.2g} %"


def _at(speed: float) -> dict[str, float]:
    return {"restitution": RESTITUTION, "speed": speed}


def _heading(angle: float) -> dict[str, float]:
    return {"heading_deg": angle}


_E, _MU = f"{RESTITUTION:.3f}", f"{FRICTION:.3f}"
_ASIDE, _WHEEL = "ball: friction aside of the slip", "wheel: friction aside of the slip"
_SLIDING = "ball: sliding friction"
LINES = (
    Line("rebound at 1 m/s", "restitution", coefficient, REBOUND_LAW, _at(1.0), _E),
    Line("rebound at 0.1 m/s", "restitution", coefficient, REBOUND_LAW, _at(0.1), _E),
    Line("an impact at 1 m/s takes", "impact duration", quantity.span, at=_at(1.0)),
    Line("depth at 5 m/s, of radius", "impact depth", _of_radius, at=_at(5.0)),
    Line("friction along x", _SLIDING, coefficient, FRICTION_LAW, _heading(0.0), _MU),
    Line("friction at 45°", _SLIDING, coefficient, FRICTION_LAW, _heading(45.0), _MU),
    Line("friction aside at 15°", _ASIDE, degrees, STRAIGHT, _heading(15.0), "0"),
    Line("under a wheel, aside at 30°", _WHEEL, degrees, STRAIGHT, _heading(30.0), "0"),
    Line("sliding ball hops by", "ball: hops while it slides", tiny_length, STILL, asked="0"),
    Line(
        "creep at 0.9 μ m g, 45°", "crate: creep at 0.9 of the limit", speed, STILL,
        _heading(45.0), "0",
    ),
    Line(
        "slides from × μ m g, 45°", "crate: push that starts it", "{:g}".format, STARTS,
        _heading(45.0), f"{_FIRST_ABOVE:g}",
    ),
    Line(
        "elastic ball, energy/bounce", "elastic ball: energy by bounce", percent, SPREAD,
        asked="0",
    ),
    Line(
        "cubli, energy from nowhere", "cubli: energy that no law explains", percent, NOWHERE,
        asked="0",
    ),
    Line("cubli, rebound of corners", "cubli: restitution of corners", coefficient, asked=_E),
    Line("ball at rest sinks by", "ball dropped: sinks by", tiny_length, asked="0"),
    Line("crate at rest trembles at", "crate dropped: moves at", speed, STILL, asked="0"),
    Line("spin up to, rad/s", "free spin", "{:g}".format, most=SPINS[-1]),
    Line("impacts held up to, m/s", "impact speed held", "{:g}".format, most=DROPS[-1]),
    Line("cost of 1 s of balldrop", "cost of a simulated second", quantity.span),
)  # fmt: skip
"""What the summary shows, in this order."""


def rows_of(study: ContactStudy, profile: Profile) -> Iterator[Row]:
    """List the summary's rows at a profile: label, what was asked, a cell an engine."""
    for line in LINES:
        cells = (line.cell(study, engine, profile) for engine in study.versions)
        yield Row((Cell(line.label), Cell(line.asked), *cells))


def present(study: ContactStudy) -> Iterator[Block]:
    """Say in short what each engine makes of contact, one table a profile."""
    columns = (Column("", words=True), *map(Column, ("asked", *study.versions)))
    for profile in study.profiles:
        yield Table(columns, tuple(rows_of(study, profile)), title=f"{profile} settings")
    yield Remarks.of((f"{m.engine} {m.profile}, {m.part}", m.reason) for m in study.missing)
    yield Text(JUDGED.replace("Marked", "Marked ✗"), "muted")
