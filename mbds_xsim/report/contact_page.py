"""The page `docs/contact.md`, every figure of it written from a study."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from mbds_xsim.engine import ContactLaw
from mbds_xsim.report import quantity
from mbds_xsim.report.contact_summary import (
    FIRST_ABOVE,
    JUDGED,
    Shown,
    close_to,
    figure_of,
    percent,
    rows_of,
    speed,
    tiny_length,
)
from mbds_xsim.studies.contact.bench import FRICTION, RADIUS, RESTITUTION
from mbds_xsim.studies.contact.friction import PUSHES
from mbds_xsim.studies.contact.impacts import DEPTH_SPEEDS, RESTITUTIONS, SPEEDS
from mbds_xsim.studies.contact.study import ContactStudy

__all__ = ["contact_page", "words_of"]

_PUSHES = ", ".join(f"{push:g}" for push in PUSHES)
_HEAD = """\
# What contact means in each engine

Each engine has its own idea of what happens where bodies touch. This page is what comes of it,
measured from trajectories alone: written, with its figures, by

```sh
{command}
```

{made}
"""
_MADE = """
on {machine}, with {versions}. `native` is what an ordinary user of the engine gets, `matched`
what data are published with; both run through the same adapter. {judged} What the checks of
`validate` make of contact stands in [checks.md](checks.md), what an engine can represent at all
in [engines.md](engines.md).
"""
_WORDS = """
## In words
"""
_REBOUND = f"""
## Rebound

A ball of radius {1e3 * RADIUS:.0f} mm falls onto the ground at a known speed, from eight phases of
a step. Both flights are parabolas, so speeds before and after are known without looking into the
impact. “Takes” is the time from touch to take-off, negative where an engine acts ahead of the
touch; “depth” the deepest overlap at any phase. Figures are medians over the starts, bands in the
picture go from the least to the most.
"""
_SHARES = """
Largest distance from what was asked, over these speeds, and the speed at which it is:
"""
_FRICTION = f"""
## Friction

A ball that slides at 5 m/s, and a crate on four points at 2 m/s, asked {FRICTION}: the horizontal
impulse over the vertical one. “Aside” is the angle between friction and slip. The crate is then
pushed by a held force F, at 0.9 μ m g, where it should stand, and above; the last columns are the
push at which it starts, of {_PUSHES}. Drag that a profile has
counts as friction here.
"""
_ENERGY = f"""
## Energy

“Elastic ball”: mean change of its energy in a bounce, e = 1, at 1 m/s. The others are of thrown
cubes that land on corners (`simplecubli`, asked {RESTITUTION}): the rise of energy that the law of
impact does not explain, the whole rise, both over the energy scale, and the rebound of single
corners. Newton's law together with Coulomb's may itself raise the energy there
([passivity](checks.md#passivity)), and is one law among several.
"""
_REST = """
## Rest

A second after it was dropped from 5 cm with e = 0.5: how deep the lowest sphere is, how far it
moves up and down, and the speed of the centre of mass.
"""
_LIMITS = """
## How fast

The fastest of some speeds at which an engine still delivers what was asked within 1 %, and what
happens at the next: *told* is a failure of the trajectory with its reason, *silent* a wrong motion
without a word, if only for a drag that is on by default. An impact counts as held if the ground
does not lose the ball.
"""

# Notes that a table shows itself.
_NO_FAILURE = ("all up to", "told at", "silent at", "does not come back")

Column = tuple[str, Callable[[str, str], Shown]]
Tell = Callable[[float], str]
Right = Callable[[float], bool]


def _degrees(value: float) -> str:
    return f"{value:.1f}°"


def _three(value: float) -> str:
    return f"{value:.3f}"


def _any(_: float) -> bool:
    return True


def contact_page(study: ContactStudy, figures: dict[str, Path], folder: Path) -> str:
    """Write the page.

    Args:
        study: What was measured.
        figures: Files of `restitution` and `friction`; none: the page goes without.
        folder: Where the page will lie, which decides its links to the figures.
    """
    versions = ", ".join(f"{engine} {version}" for engine, version in study.versions.items())
    judged = JUDGED.replace("Marked", "Bold")
    made = _MADE.format(machine=study.machine, versions=versions, judged=judged)
    head = _HEAD.format(command=study.command, made=textwrap.fill(made.strip(), 100))
    picture = {name: _picture(name, path, folder) for name, path in figures.items()}
    return "\n".join(
        [
            head,
            *_summary(study),
            _WORDS,
            *(words_of(engine, law) for engine, law in study.laws.items()),
            _REBOUND + picture.get("restitution", ""),
            *_rebound(study),
            _FRICTION + picture.get("friction", ""),
            _table(study, _friction_columns(study)),
            _ENERGY,
            _table(study, _energy_columns(study)),
            _REST,
            _table(study, _rest_columns(study)),
            _LIMITS,
            _table(study, _limit_columns(study)),
            *_missing(study),
        ]
    )


def _picture(name: str, path: Path, folder: Path) -> str:
    link = Path(os.path.relpath(path.absolute(), folder.absolute())).as_posix()
    return f"\n![{name} of each engine, native and matched]({link})\n"


def _summary(study: ContactStudy) -> Iterator[str]:
    for profile in study.profiles:
        yield f"## In short: `{profile}`\n"
        lines = (
            [line.label, line.asked, *map(_marked, cells)]
            for line, cells in rows_of(study, profile)
        )
        yield _markdown(["", "asked", *study.versions], lines)


def words_of(engine: str, law: ContactLaw) -> str:
    """Lay out what an adapter says of its engine's contact."""
    return (
        f"**{engine}**\n\n"
        f"- Non-penetration: {law.normal}.\n"
        f"- Restitution: {law.restitution}.\n"
        f"- Friction: {law.friction}.\n"
        f"- Two bodies' coefficients: {law.mixing}.\n"
        f"- What the adapter does: {law.adapter[0].lower()}{law.adapter[1:]}\n"
    )


def _rebound(study: ContactStudy) -> Iterator[str]:
    yield f"Speed after over speed before, asked {RESTITUTION}:\n"
    right = close_to(RESTITUTION, 0.01)

    def column(title: str, name: str, tell: Tell, right: Right, speed: float) -> Column:
        at = {"restitution": RESTITUTION, "speed": speed}
        return _column(study, f"{title}{speed:g} m/s", name, tell, right, at)

    yield _table(study, [column("", "restitution", _three, right, v) for v in SPEEDS])
    yield _SHARES
    depth = "impact depth"
    yield _table(
        study,
        [
            *((f"e = {e:g}", _furthest(study, e)) for e in RESTITUTIONS),
            *(
                column("takes, ", "impact duration", quantity.span, _any, v)
                for v in (0.1, 1.0, 10.0)
            ),
            *(column("depth, ", depth, quantity.length, _any, v) for v in DEPTH_SPEEDS),
        ],
    )


def _furthest(study: ContactStudy, asked: float) -> Callable[[str, str], Shown]:
    """Worst median over the speeds."""

    def cell(engine: str, profile: str) -> Shown:
        found = [
            (abs(m.value - asked), m.at["speed"])
            for m in study.find("restitution", restitution=asked)
            if (m.engine, m.profile) == (engine, profile) and m.value is not None
        ]
        if not found:
            return Shown(quantity.NONE)
        off, where = max(found)
        text = f"{off:.3f}" if off < 5e-4 else f"{off:.3f} at {where:g}"
        return Shown(text, off > 0.01)

    return cell


def _friction_columns(study: ContactStudy) -> list[Column]:
    right, starts = close_to(FRICTION, 0.02 * FRICTION), close_to(FIRST_ABOVE, 1e-9)
    still, aside = close_to(0.0, 1e-3), "ball: friction aside of the slip"
    ball, crate = "ball: sliding friction", "crate: sliding friction"
    creep, push = "crate: creep at 0.9 of the limit", "crate: push that starts it"

    def column(title: str, name: str, heading: float, tell: Tell, right: Right) -> Column:
        at = {"heading_deg": heading}
        return _column(study, f"{title} {heading:g}°", name, tell, right, at)

    return [
        *(column("ball", ball, h, _three, right) for h in (0.0, 15.0, 45.0)),
        column("aside", aside, 15.0, _degrees, close_to(0.0, 1.0)),
        column(
            "wheel aside", "wheel: friction aside of the slip", 30.0, _degrees, close_to(0.0, 1.0)
        ),
        _column(study, "hops by", "ball: hops while it slides", tiny_length, still),
        *(column("crate", crate, h, _three, right) for h in (0.0, 45.0)),
        *(column("creep", creep, h, speed, still) for h in (0.0, 45.0)),
        *(column("starts", push, h, lambda x: f"{x:g}", starts) for h in (0.0, 45.0)),
    ]


def _energy_columns(study: ContactStudy) -> list[Column]:
    elastic, corners = "elastic ball: energy by bounce", "cubli: restitution of corners"
    unexplained = "cubli: energy that no law explains"
    return [
        _column(study, "elastic ball", elastic, percent, close_to(0.0, 0.02)),
        _column(study, "unexplained rise", unexplained, percent, close_to(0.0, 1e-3)),
        _column(study, "whole rise", "cubli: largest rise of energy", percent),
        _column(study, "corners' rebound", corners, _three),
        ("from … to", lambda engine, profile: _spread(study, corners, engine, profile)),
    ]


def _rest_columns(study: ContactStudy) -> list[Column]:
    still = close_to(0.0, 1e-3)
    columns = []
    for what in ("ball", "crate"):
        columns += [
            _column(study, f"{what}: sinks", f"{what} dropped: sinks by", tiny_length),
            _column(study, f"{what}: hops", f"{what} dropped: hops by", tiny_length, still),
            _column(study, f"{what}: moves at", f"{what} dropped: moves at", speed, still),
        ]
    return columns


def _limit_columns(study: ContactStudy) -> list[Column]:
    def told(name: str) -> Callable[[str, str], Shown]:
        def cell(engine: str, profile: str) -> Shown:
            found = figure_of(study, engine, profile, name)
            if found is None:
                return Shown(quantity.NONE)
            reached = quantity.NONE if found.value is None else f"{found.value:g}"
            whole = found.note.startswith("all")
            return Shown(reached if whole else f"{reached}; {found.note}", "silent" in found.note)

        return cell

    names = {"free spin": "rad/s", "hinge spin": "rad/s", "impact speed held": "m/s"}
    return [(f"{name} [{unit}]", told(name)) for name, unit in names.items()]


def _missing(study: ContactStudy) -> Iterator[str]:
    """Say why cells are empty, and where trajectories ended early."""
    lines = [f"- {m.engine} `{m.profile}`, all of {m.part}: {m.reason}" for m in study.missing]
    early: dict[str, list[str]] = {}
    for m in study.figures:
        if m.note and not m.note.startswith(_NO_FAILURE):
            early.setdefault(f"{m.engine} `{m.profile}`: {m.note}", []).append(m.quantity)
    lines += [f"- {why} ({'; '.join(dict.fromkeys(what))})" for why, what in early.items()]
    if lines:
        yield "\n## Cells with a reason\n"
        yield "\n".join(lines) + "\n"


def _spread(study: ContactStudy, name: str, engine: str, profile: str) -> Shown:
    found = figure_of(study, engine, profile, name)
    if found is None or found.low is None or found.high is None:
        return Shown(quantity.NONE)
    return Shown(f"{found.low:.2f} … {found.high:.2f}")


def _column(
    study: ContactStudy,
    title: str,
    name: str,
    tell: Tell,
    right: Right = _any,
    at: dict[str, float] | None = None,
) -> Column:
    def cell(engine: str, profile: str) -> Shown:
        found = figure_of(study, engine, profile, name, **(at or {}))
        if found is None or found.value is None:
            return Shown(quantity.NONE)
        return Shown(tell(found.value), not right(found.value))

    return title, cell


def _table(study: ContactStudy, columns: list[Column]) -> str:
    """One row an engine and profile."""
    rows = ((profile, engine) for profile in study.profiles for engine in study.versions)
    return _markdown(
        ["", "", *(title for title, _ in columns)],
        (
            [profile, engine, *(_marked(cell(engine, profile)) for _, cell in columns)]
            for profile, engine in rows
        ),
    )


def _markdown(head: list[str], lines: Iterable[list[str]]) -> str:
    rule = [":--", *["--:"] * (len(head) - 1)]
    return "".join(f"| {' | '.join(line)} |\n" for line in (head, rule, *lines))


def _marked(cell: Shown) -> str:
    text = cell.text.replace("|", "\\|").replace("<", "&lt;")
    return f"**{text}**" if cell.off else text
