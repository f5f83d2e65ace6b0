"""README's table of engines, steps and costs, from the stored trade-offs of its scenes.

python -m benchmarks.choose_table reports/tradeoff                    prints it
python -m benchmarks.choose_table reports/tradeoff --into README.md   puts it in its place
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence

from benchmarks.harness import folder_and_file, placed, stored
from mbds_xsim.base.files import write_whole
from mbds_xsim.report import quantity
from mbds_xsim.report.files import table_lines
from mbds_xsim.simulate.registry import REFERENCE
from mbds_xsim.simulate.simulator import NATIVE
from mbds_xsim.studies.tradeoff import CurveResult, Point, Tradeoff
from mbds_xsim.studies.tradeoff.words import BUSY

_BREAK = "<br>"
_OPTION = "°"
"""Mark of a method with an option that is not the usual one."""
_NONE_STORED = "*None is stored yet: `make reports-tradeoff readme` makes the table.*"


def choose_table(studies: Sequence[Tradeoff]) -> str:
    """Return a row for each scene and a column for each engine, as Markdown.

    A cell shows an engine's cheapest point that keeps all budgets: method and step, error, and wall
    time per simulated second. The engine's own stepping comes before the toolkit's. The cheapest
    cell of a scene is bold. The reasons for empty cells follow the table.
    """
    if not studies:
        return _NONE_STORED
    engines = sorted({engine for study in studies for engine in _engines(study)})
    headings = ["scene and budget of its error", *engines]
    lines = [
        *table_lines(headings, (_row(study, engines) for study in studies)),
        "",
        *(f"- {line}" for line in _reasons(studies, engines)),
        f"- Made on {_machines(studies)}, with {_versions(studies)}",
    ]
    return "\n".join(lines)


def _engines(study: Tradeoff) -> list[str]:
    """Return all engines that were asked for, including those that cannot simulate the scene."""
    names = [curve.engine for curve in study.curves] + [key.split()[0] for key in study.left_out]
    return [name for name in dict.fromkeys(names) if name != REFERENCE]


def _row(study: Tradeoff, engines: Sequence[str]) -> list[str]:
    cheapest = [_cheapest(study, engine) for engine in engines]
    least = min((_cost(place) for place in cheapest if place), default=0.0)
    cells = [
        _cell(place, best=_cost(place) == least) if place else quantity.NONE for place in cheapest
    ]
    return [f"{study.scene}{_BREAK}{_asked(study)}", *cells]


def _asked(study: Tradeoff) -> str:
    """Describe the error measure and its budget."""
    if study.own_limit is not None:
        allowed = quantity.length(study.error_budget_m)
        return f"≤ {allowed} from its own small-step limit at {study.horizon_s:g} s"
    when = f"{study.horizon_s:g} s"
    if study.reference_ends_s is not None and study.horizon_s < 1.0:
        return f"error at {when}, before the first impact"
    return f"≤ {quantity.length(study.error_budget_m)} at {when}"


def _cheapest(study: Tradeoff, engine: str) -> tuple[CurveResult, Point] | None:
    places = [place for place in _places(study, engine) if not place[1].broken]
    return min(places, key=_cost, default=None)


def _curves(study: Tradeoff, engine: str) -> list[CurveResult]:
    """Return an engine's curves of its own stepping, else the toolkit's; no native settings."""
    curves = [c for c in study.curves if c.engine == engine and c.variation != NATIVE]
    return [curve for curve in curves if curve.own] or curves


def _places(study: Tradeoff, engine: str) -> Iterator[tuple[CurveResult, Point]]:
    """Yield all points that ran to the end.

    A point at no distance from its method's own limit is that limit itself: if an adapter splits
    steps in contact, fewer and longer steps with more parts are the same motion.
    """
    for curve in _curves(study, engine):
        for point in curve.points:
            is_limit = study.own_limit is not None and point.error_m == 0.0
            if point.wall_s is not None and not is_limit:
                yield curve, point


def _cost(place: tuple[CurveResult, Point]) -> float:
    wall = place[1].wall_s
    return math.inf if wall is None else wall


def _cell(place: tuple[CurveResult, Point], *, best: bool) -> str:
    curve, point = place
    mark = "**" if best else ""
    name = f"{curve.method}{_OPTION}" if curve.variation else curve.method
    error = quantity.length(point.error_m).replace("<", "&lt;")
    step, wall = quantity.span(point.step_s), quantity.span(point.wall_s)
    return _BREAK.join((f"{mark}{name}, {step}{mark}", error, f"{mark}{wall}{mark}"))


def _reasons(studies: Sequence[Tradeoff], engines: Sequence[str]) -> Iterator[str]:
    """Yield why an engine has no point that keeps all budgets; scenes are grouped by reason."""
    scenes: dict[tuple[str, str], list[str]] = {}
    for engine, study in itertools.product(engines, studies):
        if _cheapest(study, engine) is None:
            scenes.setdefault((engine, _reason(study, engine)), []).append(study.scene)
    for (engine, reason), alike in scenes.items():
        yield f"{engine} on {', '.join(alike)}: {reason}"


def _reason(study: Tradeoff, engine: str) -> str:
    places = list(_places(study, engine))
    if places:
        curve, point = min(places, key=_off)
        broken = ", ".join(point.broken)
        return f"nearest is {curve.method} at {quantity.span(point.step_s)}, over budget: {broken}"
    points = [point for curve in _curves(study, engine) for point in curve.points]
    if points:
        return f"{points[0].kind}: {points[0].reason}"
    left_out = [reason for key, reason in study.left_out.items() if key.split()[0] == engine]
    return "; ".join(left_out) or "not measured"


def _off(place: tuple[CurveResult, Point]) -> tuple[int, float]:
    """Return a sort key: number of exceeded budgets, then error."""
    point = place[1]
    return len(point.broken), math.inf if point.error_m is None else point.error_m


def _machines(studies: Sequence[Tradeoff]) -> str:
    """Name the machines that times were measured on, and report whether they were busy."""
    scenes: dict[str, list[str]] = {}
    for study in studies:
        scenes.setdefault(study.machine, []).append(study.scene)
    several = len(scenes) > 1
    text = "; ".join(f"{m} ({', '.join(names)})" if several else m for m, names in scenes.items())
    busy = max(study.busy for study in studies)
    if busy < BUSY:
        return text
    return f"{text}, which was busy: times are up to {quantity.number(busy)} × the processor's"


def _versions(studies: Sequence[Tradeoff]) -> str:
    texts = (f"{name} {version}" for study in studies for name, version in study.versions.items())
    return ", ".join(dict.fromkeys(texts))


def main() -> None:
    folder, page = folder_and_file(__doc__, "--into")
    table = choose_table([stored(file, Tradeoff) for file in sorted(folder.glob("*.json"))])
    if page is None:
        print(table)
    else:
        text = page.read_text("utf-8")
        write_whole(page, placed(text, "choose-table", table).encode())


if __name__ == "__main__":
    main()
