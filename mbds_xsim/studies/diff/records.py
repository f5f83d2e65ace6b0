"""Views of results of `ablate`, `contact` and `releases`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec

from mbds_xsim.studies.ablate.analyse import SCHEMA, Ablation
from mbds_xsim.studies.contact.present import ContactStudy, is_as_asked
from mbds_xsim.studies.diff import FAILING, Entry, PhysicalFigure, View
from mbds_xsim.studies.releases import steps
from mbds_xsim.studies.releases.steps import UNITS, History

ABLATION, CONTACT, RELEASES = SCHEMA, "mbds-xsim/contact/1", steps.SCHEMA
_LOST = FAILING + 1
_ASKED = {True: ("as asked", 0), False: ("not as asked", FAILING), None: ("not seen", _LOST)}
_COST = "cost of a simulated second"
_RANKS = {"done": 0, "timed out": None}


def is_late(reason: str) -> bool:
    """Return whether something ran into its time limit: the machine decides that."""
    return reason.removeprefix("crash: ").startswith("no answer within")


def _by_reason(reason: str, good: str, bad: str) -> Entry:
    """Return an entry that is good unless a reason says why not."""
    if not reason:
        return Entry(verdict=good, rank=0)
    return Entry(verdict=bad, rank=None if is_late(reason) else FAILING, reasons=(reason,))


def ablation_view(part: object) -> View:
    """Make a view of an ablation: engines may pass or fail, and effects are what they are."""
    stored = msgspec.convert(part, Ablation)
    return View(
        scene=stored.scene,
        command=stored.command,
        identity={"length [m]": stored.length_m, "duration [s]": stored.duration_s},
        sample={"seed": stored.seed, "starts": len(stored.trajectories), "judge": stored.judge},
        circumstances={**stored.versions, "machine": stored.machine},
        entries=dict(_ablation_entries(stored)),
        left_out=stored.left_out,
    )


def _ablation_entries(stored: Ablation) -> Iterator[tuple[str, Entry]]:
    for engine in dict.fromkeys((*stored.floor_engines, *stored.failed)):
        reason = stored.failed.get(engine, "")
        yield engine, _by_reason(reason, "pass", "fail")
    for size in stored.sizes:
        counts: dict[str, Any] = msgspec.structs.asdict(size)
        yield f"model of {counts.pop('engine')}", Entry(verdict="", rank=None, settings=counts)
    floor = msgspec.structs.asdict(stored.floor).items()
    yield "floor", Entry(verdict="", rank=None, figures=_lengths(dict(floor)))
    for row in stored.rows:
        figures = {name: getattr(row, name) for name in row.__struct_fields__ if "change" in name}
        reasons = (row.sentence,) if row.sentence else ()
        entry = Entry(verdict=row.verdict, rank=None, reasons=reasons, figures=_lengths(figures))
        yield f"{row.effect} × {row.factor:g}", entry


def _lengths(figures: dict[str, float | None]) -> dict[str, PhysicalFigure]:
    return {name.removesuffix("_m"): PhysicalFigure(value, "m") for name, value in figures.items()}


def contact_view(part: object) -> View:
    """Make a view of a study of contact: figures are as asked or not, as in its tables."""
    study = msgspec.convert(part, ContactStudy)
    entries = dict(_contact_entries(study))
    lacking = ((f"{m.engine} {m.profile}", f"{m.part}: {m.reason}") for m in study.missing)
    return View(
        scene="contact",
        command=study.command,
        circumstances={**study.versions, "machine": study.machine},
        entries=entries,
        left_out={name: why for name, why in lacking if name not in entries},
    )


def _contact_entries(study: ContactStudy) -> Iterator[tuple[str, Entry]]:
    for m in study.missing:
        if is_late(m.reason):
            yield f"{m.engine} {m.profile}", _completed(study, m.engine, m.profile)
    for figure in study.figures:
        parent = f"{figure.engine} {figure.profile}"
        yield parent, _completed(study, figure.engine, figure.profile)
        at = "".join(f", {name} {value:g}" for name, value in figure.at.items())
        verdict, rank = _ASKED[is_as_asked(figure)]
        values = {"median": figure.value, "smallest": figure.low, "largest": figure.high}
        figures = {name: PhysicalFigure(value, figure.unit) for name, value in values.items()}
        is_cost = figure.quantity == _COST
        yield (
            f"{parent} {figure.quantity}{at}",
            Entry(
                verdict=verdict,
                rank=rank,
                parent=parent,
                reasons=(figure.note,) if figure.note else (),
                figures={} if is_cost else figures,
                timings={"median": figure.value} if is_cost else {},
            ),
        )


def _completed(study: ContactStudy, engine: str, profile: str) -> Entry:
    """Return the entry of an engine: it is the worse the more parts it did not complete.

    Parts without an answer in time make it neither better nor worse.
    """
    own = (m for m in study.missing if (m.engine, m.profile) == (engine, profile))
    reasons = {m.part: m.reason for m in own}
    lost = sum(not is_late(reason) for reason in reasons.values())
    return Entry(
        verdict=f"lacks {', '.join(reasons)}" if reasons else "complete",
        rank=FAILING + lost if lost else None if reasons else 0,
        reasons=tuple(f"{part}: {reason}" for part, reason in reasons.items()),
    )


def history_view(part: object) -> View:
    """Make a view of an engine's releases: the verdict on the newest, and all their rows."""
    history = msgspec.convert(part, History)
    return View(
        scene=history.engine,
        command=history.command,
        identity={"package": history.package},
        circumstances={**history.versions, "machine": history.machine},
        entries=dict(_history_entries(history)),
    )


def _history_entries(history: History) -> Iterator[tuple[str, Entry]]:
    worse = tuple(f"{step.release}, {step.name}: {step.what}" for step in history.regressions)
    late = is_late(history.releases[-1].reason)
    rank = None if late else FAILING if history.verdict == "fail" else 0
    yield "newest release", Entry(verdict=history.verdict, rank=rank, reasons=worse)
    for release in history.releases:
        yield f"release {release.version}", _by_reason(release.reason, "driven", "not driven")
    for row in history.rows:
        parent, figures = f"release {row.release}", dict(row.figures)
        timings = {"processor time per simulated second": figures.pop("time")}
        entry = Entry(
            verdict=row.kind,
            rank=_RANKS.get(row.kind, _LOST),
            parent=parent,
            reasons=(row.reason,) if row.reason else (),
            figures={what: PhysicalFigure(figures[what], UNITS[what]) for what in figures},
            timings=timings,
        )
        yield f"{parent}, {row.name}", entry
