"""The page `docs/contact.md`, with all its figures taken from a study."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from mbds_xsim.base.text import in_markdown
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Cell
from mbds_xsim.report.files import link, table_text
from mbds_xsim.simulate.claims import ContactLaw
from mbds_xsim.studies.contact import ContactFigure
from mbds_xsim.studies.contact.friction import PUSHES
from mbds_xsim.studies.contact.impacts import DEPTH_SPEEDS, SPEEDS
from mbds_xsim.studies.contact.present import (
    JUDGED,
    LINES,
    ContactLine,
    ContactStudy,
    heading,
    impact,
    rows_of,
)
from mbds_xsim.testing.contact_cases import FRICTION, RADIUS, RESTITUTION, RESTITUTIONS

_PAGE = """\
# What contact means in each engine

{off}

{summary}

{made}

## In words

{words}
## Rebound

A ball of radius {radius:.0f} mm falls onto the ground; eight starts spread the moment of touch over
a step. “Takes” is the time from touch to take-off; “depth” is the deepest overlap of all starts.
Figures are medians over the starts; bands in the picture reach from the lowest to the highest.
{rebound_picture}
Speed after the impact over the speed before; {restitution} was asked for:

{rebounds}

Largest deviation from what was asked for over these speeds, and the speed at which it occurs:

{impacts}

## Friction

A ball slides at 5 m/s, and a crate on four points at 2 m/s. The figure is the horizontal impulse
over the vertical one; {friction} was asked for. “Aside” is the angle between friction and slip. The
crate is then pushed by a constant force: at 0.9 μ m g it should stand. The last columns show the
smallest push, in μ m g, of {pushes}, at which it starts. Drag counts as
friction here.
{friction_picture}
{frictions}

## Energy

“Elastic ball” is the mean change of a ball's energy in a bounce with restitution 1, at 1.0 to
1.2 m/s. The other columns are for thrown cubes that land on corners (`simplecubli`, restitution
{restitution}): the rise of energy that the law of impact does not explain and the whole rise, both
over the energy scale, and the restitution of single corners. Newton's law of impact together with
Coulomb's can itself raise the energy there ([passivity](checks.md#passivity)).

{energies}

## Rest

A body is dropped from 5 cm with restitution 0.5. A second later: how deep the lowest sphere is, how
far it moves up and down, and the speed of the centre of mass.

{rests}

## How fast

The fastest of several speeds at which an engine is still within 1 % of the exact motion, and what
happens at the next: *told* means that the trajectory fails with a reason, *silent* that the motion
is wrong without a warning. An impact is held if the ball does not fall through the ground.

{limits}{missing}"""
_ORIGIN = """
`native` settings are those that an ordinary user of the engine gets, `matched` ones those with
which data are published; both run through the same adapter. {judged} A dash stands for what an
engine cannot do or did not reach; reasons are at the end. Measured on {machine}, with
{versions}. [Checks](checks.md#contact) describes how `validate` checks contact.
"""

# Notes that the tables already show.
_NO_FAILURE = ("all up to", "told at", "silent at", "does not come back")


@dataclass(frozen=True)
class _Furthest:
    """Column with the median furthest from `asked` over the speeds."""

    asked: float

    @property
    def label(self) -> str:
        return f"e = {self.asked:g}"

    def cell(self, study: ContactStudy, engine: str, profile: str) -> Cell:
        deviations = [
            (abs(m.value - self.asked), m.at["speed"])
            for m in study.find(engine, profile, "restitution", restitution=self.asked)
            if m.value is not None
        ]
        if not deviations:
            return Cell(quantity.NONE)
        deviation, speed = max(deviations)
        text = f"{deviation:.3f}" if deviation < 5e-4 else f"{deviation:.3f} at {speed:g}"
        return Cell(text, "over" if deviation > 0.01 else "")


def _range(measured: ContactFigure) -> Cell:
    """Write the range over the starts."""
    if measured.low is None or measured.high is None:
        return Cell(quantity.NONE)
    return Cell(f"{measured.low:.2f} … {measured.high:.2f}")


def _limit(measured: ContactFigure) -> Cell:
    """Write the highest correct speed, and what happens beyond it."""
    text = quantity.NONE if measured.value is None else f"{measured.value:g}"
    if measured.note.startswith("all"):
        return Cell(text)
    return Cell(f"{text}; {measured.note}", "over" if "silent" in measured.note else "")


def _by_heading(label: str, name: str, *headings: float) -> Iterator[ContactLine]:
    for angle in headings:
        yield ContactLine(f"{label} {angle:g}°", name, heading(angle))


_TABLES: dict[str, Sequence[ContactLine | _Furthest]] = {
    "rebounds": [ContactLine(f"{at:g} m/s", "restitution", impact(at)) for at in SPEEDS],
    "impacts": [
        *map(_Furthest, RESTITUTIONS),
        *(
            ContactLine(f"takes, {at:g} m/s", "impact duration", impact(at))
            for at in (0.1, 1.0, 10.0)
        ),
        *(ContactLine(f"depth, {at:g} m/s", "impact depth", impact(at)) for at in DEPTH_SPEEDS),
    ],
    "frictions": [
        *_by_heading("ball", "ball: sliding friction", 0.0, 15.0, 45.0),
        *_by_heading("aside", "ball: friction aside of the slip", 15.0),
        *_by_heading("wheel aside", "wheel: friction aside of the slip", 30.0),
        ContactLine("hops by", "ball: hops while it slides"),
        *_by_heading("crate", "crate: sliding friction", 0.0, 45.0),
        *_by_heading("creep", "crate: creep at 0.9 of the limit", 0.0, 45.0),
        *_by_heading("starts", "crate: push that starts it", 0.0, 45.0),
    ],
    "energies": [
        ContactLine("elastic ball", "elastic ball: energy by bounce"),
        ContactLine("unexplained rise", "cubli: energy that no law explains"),
        ContactLine("whole rise", "cubli: largest rise of energy"),
        ContactLine("corners' rebound", "cubli: restitution of corners"),
        ContactLine("from … to", "cubli: restitution of corners", form=_range),
    ],
    "rests": [
        ContactLine(f"{what}: {how.removesuffix(' by')}", f"{what} dropped: {how}")
        for what in ("ball", "crate")
        for how in ("sinks by", "hops by", "moves at")
    ],
    "limits": [
        ContactLine("free spin [rad/s]", "free spin", form=_limit),
        ContactLine("hinge spin [rad/s]", "hinge spin", form=_limit),
        ContactLine("impact speed held [m/s]", "impact speed held", form=_limit),
    ],
}
"""Columns of the page's tables, by the place of the table in `_PAGE`."""


def contact_page(study: ContactStudy, figures: dict[str, Path], folder: Path) -> str:
    """Return the page as Markdown; links to the figures, if any, are relative to `folder`."""
    versions = ", ".join(f"{engine} {version}" for engine, version in study.versions.items())
    made = _ORIGIN.format(machine=study.machine, versions=versions, judged=JUDGED)
    return _PAGE.format(
        command=study.command,
        made=textwrap.fill(made.strip(), 100),
        off=_off(study),
        summary="\n".join(_summary(study)).rstrip(),
        words="\n".join(words_of(engine, law) for engine, law in study.laws.items()),
        radius=1e3 * RADIUS,
        restitution=RESTITUTION,
        friction=FRICTION,
        pushes=", ".join(f"{push:g}" for push in PUSHES),
        rebound_picture=_picture("restitution", figures, folder),
        friction_picture=_picture("friction", figures, folder),
        **{name: _table(study, columns).rstrip() for name, columns in _TABLES.items()},
        missing=_missing(study),
    )


def _off(study: ContactStudy) -> str:
    """Count each engine's figures of the summary that are far from what was asked for."""
    counts = []
    for profile in study.profiles:
        rows = [row.cells[2:] for row in rows_of(study, profile)]
        off = (sum(bool(cell.mark) for cell in cells) for cells in zip(*rows, strict=True))
        each = ", ".join(f"{engine} {n}" for engine, n in zip(study.versions, off, strict=True))
        counts.append(f"{each} at `{profile}` settings")
    return textwrap.fill(
        f"Does an engine do what a scene asks for where bodies touch? Of the {len(LINES)} lines "
        f"below, these are off (bold): {'; '.join(counts)}. Measured from trajectories alone, by "
        f"`{study.command}`.",
        100,
        break_on_hyphens=False,
    )


def _picture(name: str, figures: dict[str, Path], folder: Path) -> str:
    if name not in figures:
        return ""
    address = link(figures[name], folder / "page")
    return f"\n![{name} of each engine, native and matched]({address})\n"


def _summary(study: ContactStudy) -> Iterator[str]:
    for profile in study.profiles:
        rows = (map(_mark, row.cells) for row in rows_of(study, profile))
        yield f"## In short: `{profile}`\n"
        yield table_text(["", ">asked", *(f">{engine}" for engine in study.versions)], rows)


def words_of(engine: str, law: ContactLaw) -> str:
    """List what an adapter states about its engine's contact."""
    return (
        f"**{engine}**\n\n"
        f"- Non-penetration: {law.normal}.\n"
        f"- Restitution: {law.restitution}.\n"
        f"- Friction: {law.friction}.\n"
        f"- Two bodies' coefficients: {law.mixing}.\n"
        f"- What the adapter does: {law.adapter[0].lower()}{law.adapter[1:]}\n"
    )


def _missing(study: ContactStudy) -> str:
    """List the reasons for empty cells and for trajectories that ended early."""
    study = in_markdown(study)
    parts: dict[tuple[str, str], list[str]] = {}
    for m in study.missing:
        parts.setdefault((m.engine, f", all of {m.part}: {m.reason}"), []).append(m.profile)
    early: dict[tuple[str, str], list[ContactFigure]] = {}
    for figure in study.figures:
        if figure.note and not figure.note.startswith(_NO_FAILURE):
            early.setdefault((figure.engine, figure.note), []).append(figure)
    lines = [f"- {engine} {_profiles(names)}{words}" for (engine, words), names in parts.items()]
    for (engine, note), figures in early.items():
        profiles = _profiles([m.profile for m in figures])
        lines.append(f"- {engine} {profiles}: {note} ({_quantities(figures)})")
    return "\n".join(["\n\n## Cells with a reason\n", *lines, ""]) if lines else ""


def _profiles(names: Sequence[str]) -> str:
    return " and ".join(f"`{name}`" for name in dict.fromkeys(names))


def _quantities(figures: Sequence[ContactFigure]) -> str:
    """List quantities once each, after the body or bodies that they share."""
    by_body: dict[str, dict[str, None]] = {}
    for m in figures:
        body, colon, name = m.quantity.rpartition(": ")
        by_body.setdefault(body + colon, {})[name] = None
    bodies: dict[str, list[str]] = {}
    for body, names in by_body.items():
        bodies.setdefault(", ".join(names), []).append(body.removesuffix(": "))
    return "; ".join(
        f"{' and '.join(those)}: {names}".removeprefix(": ") for names, those in bodies.items()
    )


def _table(study: ContactStudy, columns: Sequence[ContactLine | _Furthest]) -> str:
    """Lay out a table with one row per engine and profile that has a figure."""
    rows = []
    for profile in study.profiles:
        for engine in study.versions:
            cells = [column.cell(study, engine, profile) for column in columns]
            if any(cell.text != quantity.NONE for cell in cells):
                rows.append([profile, engine, *map(_mark, cells)])
    return table_text(["", ">", *(f">{column.label}" for column in columns)], rows)


def _mark(cell: Cell) -> str:
    text = in_markdown(cell.text)
    return f"**{text}**" if cell.mark else text
