"""The page `docs/engines.md`: what each engine can do, written from its adapter's claims."""

from __future__ import annotations

from collections.abc import Iterable

from mbds_xsim.report.files import table_text
from mbds_xsim.simulate.catalogue import EngineRow, MethodRow, by_reason
from mbds_xsim.simulate.claims import Feature

_HEAD = """\
# Engines

This page is written from the adapters by `mbds-xsim engines --markdown > docs/engines.md`; a
test compares the two. `mbds-xsim engines` prints the same for what is installed. Every claim is
measured: the contract suite (`mbds_xsim.testing.AdapterContract`) runs each method on cases with
exact answers, fits its order of convergence, and checks that what is refused is refused with
the reason before the engine sees it.

Which to use for what: [choose-an-engine.md](choose-an-engine.md). A fifth one:
[add-an-engine.md](add-an-engine.md).

## What each can represent

“yes” means with all its methods, “some” not with all of them, “no” with none. The notes give the
reasons.
"""
_SMALLEST = """
## How small a body may be

What is smaller is refused before the engine sees it, and what is not moves rightly, as a test tells
of each engine; a scene file may name masses down to 1e-30 kg.
"""
_CONTACT = """
## What contact is

What an adapter makes of it, and what it delivers, measured: [contact.md](contact.md).
"""
_METHODS = """
## Methods and options

Methods of one family are one vote when engines are compared: their agreement is no evidence.
“Order” is the order of convergence, “with loops” the same where constraints are solved beside the
coordinates. Recorded velocities belong to the frame's time plus “velocity lag” times the step.
"""
_ASPECTS = {
    "non-penetration": "normal",
    "restitution": "restitution",
    "friction": "friction",
    "two bodies' coefficients": "mixing",
}
# What makes constraints beside the coordinates of a tree.
_CONSTRAINED = (
    Feature.LOOP_BALL,
    Feature.LOOP_HINGE,
    Feature.LOOP_SLIDER,
    Feature.LOOP_FIXED,
    Feature.DISTANCE_LINK,
)


def engines_page(rows: list[EngineRow]) -> str:
    """Write the page in Markdown."""
    notes: list[str] = []
    cells = [[_cell(row, feature.value, notes) for row in rows] for feature in Feature]
    features = ([feature.value, *line] for feature, line in zip(Feature, cells, strict=True))
    parts = [
        _HEAD,
        _table(["", *(row.engine for row in rows)], features),
        "".join(f"[^{k}]: {note}\n" for k, note in enumerate(notes, 1)).rstrip("\n"),
        _SMALLEST,
        "\n".join(f"- **{row.engine}**: {row.smallest}." for row in rows if row.smallest),
        _CONTACT,
        _contact(rows),
        _METHODS,
        *(_engine(row) for row in rows),
    ]
    return "\n".join(parts)


def _cell(row: EngineRow, feature: str, notes: list[str]) -> str:
    """Say whether an engine has a feature, with a note where it has not or not always."""
    if feature in row.limits:
        return f"no{_mark(f'{row.engine}: {row.limits[feature]}.', notes)}"
    refusing = {m.name: m.refuses[feature] for m in row.methods if feature in m.refuses}
    if not refusing:
        return "yes"
    said = "; ".join(
        f"not with {_code(names)}: {reason}" for reason, names in by_reason(refusing).items()
    )
    return f"some{_mark(f'{row.engine}, {said}.', notes)}"


def _mark(note: str, notes: list[str]) -> str:
    if note not in notes:
        notes.append(note)
    return f"[^{notes.index(note) + 1}]"


def _contact(rows: list[EngineRow]) -> str:
    """Lay out what the engines say of their contacts; an engine without any has no column."""
    laws = {row.engine: row.contact_law for row in rows if row.contact_law is not None}
    return _table(
        ["", *laws],
        ([what, *(getattr(law, key) for law in laws.values())] for what, key in _ASPECTS.items()),
    ).rstrip("\n")


def _engine(row: EngineRow) -> str:
    methods = _table(
        ["method", "family", "order", "with loops", "velocity lag [steps]"],
        (_method(method, row) for method in row.methods),
    )
    options = _table(
        ["option", "default", "meaning"],
        ([f"`{k}`", f"`{o.default}`", o.meaning] for k, o in row.options.items()),
    )
    own = row.package == "mbds-xsim"
    there = "always there" if own else f"`pip install 'mbds-xsim[{row.engine}]'`"
    return (
        f"### {row.engine}\n\n{row.coordinates.capitalize()} coordinates; {there}.\n\n{methods}"
        + (f"\n{options}" if row.options else "")
    )


def _method(method: MethodRow, row: EngineRow) -> list[str]:
    closes = any(f.value not in {**row.limits, **method.refuses} for f in _CONSTRAINED)
    return [
        f"`{method.name}`",
        method.family,
        str(method.order),
        str(method.loop_order) if closes else "–",
        f"{method.velocity_lag:g}",
    ]


def _table(head: list[str], lines: Iterable[list[str]]) -> str:
    rows = ([cell.replace("|", "\\|") for cell in line] for line in lines)
    return table_text(head, rows)


def _code(names: list[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)
