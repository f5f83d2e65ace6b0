"""Write reports/cheapest.md: is any point of the charts cheaper than what is matched?

python -m benchmarks.cheapest reports/tradeoff > reports/cheapest.md
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec

from benchmarks.harness import print_head, print_made, print_table
from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.measure.campaign import run_references
from mbds_xsim.measure.trial import Trial, failed_trial, joined, part_of, run_trial
from mbds_xsim.report import quantity
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.matched import settings_for
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.studies.tradeoff.rows import CurveResult, Point, Tradeoff
from mbds_xsim.studies.tradeoff.sweep import NATIVE

_STARTS, _SEED = 20, 5  # of each interval; the seed of no search, proof or chart
_MORE, _PROOF = 100, 1  # what the settings of the chains and ladders in MuJoCo were held to
_PARTS = 6
_SAMPLE = 3  # trajectories at other steps too, in the first part
_TIMEOUT = 300.0
_ALIKE = 0.1  # trials of the same settings, minutes apart, differed by up to 0.07 of their cost

_COMMAND = "python -m benchmarks.cheapest reports/tradeoff > reports/cheapest.md"
_TEXT = f"""\
Matched settings are found by search, on the starts of the search. Here every point of a scene's
[chart](README.md) that keeps all budgets on the chart's few starts, and costs less than the
cheapest matched settings that keep them, is tried on {_STARTS} starts of each interval (seed
{_SEED}), judged as `validate` judges, limits of contact included. Times are those of the trial:
processor time per simulated second, the mean of all starts; less is less by more than
{_ALIKE:.0%}, by which two trials of the same settings may differ. Matched settings of all engines
come first, bold. What keeps all budgets and costs less is tried on {_MORE} starts of each interval
(seed {_PROOF}), too."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One setting of one engine."""

    engine: str
    settings: Settings
    label: str


def main() -> None:
    """Print the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    asked = parser.parse_args()
    files = sorted(asked.folder.glob("*.json"))
    studies = (msgspec.json.decode(file.read_bytes(), type=Tradeoff) for file in files)
    found: list[str] = []
    print_head("Is anything cheaper?", _COMMAND, _TEXT)
    rows = (row for study in studies for row in _rows(study, found))
    print_table("scene|engine, method, step|>cost|budgets|what is not kept", rows)
    print("\n" + "\n".join(found))
    print_made()


def _rows(study: Tradeoff, found: list[str]) -> Iterator[list[str]]:
    """Give the rows of a scene, and tell at the end what was cheapest."""
    scene = load_scene(study.scene)
    matched = _matched(study, scene)
    trials = dict(zip(matched, _tried(scene, matched, _STARTS, _SEED), strict=True))
    own = min((trial.cpu_s for trial in trials.values() if trial.passed), default=math.inf)
    less = (1 - _ALIKE) * own
    others = [p for p in _cheaper(study, less) if p.label not in {m.label for m in matched}]
    print(f"{study.scene}: {len(others)} points are cheaper", file=sys.stderr)
    trials |= dict(zip(others, _tried(scene, others, _STARTS, _SEED), strict=True))
    rivals = [p for p in others if trials[p].passed and trials[p].cpu_s < less]
    more = dict(zip(rivals, _tried(scene, rivals, _MORE, _PROOF), strict=True))
    kept = {}
    for place, trial in trials.items():
        last = more.get(place, trial)
        if last.passed and (place in matched or place in more):
            kept[place] = trial.cpu_s
        starts = f" on {len(INTERVALS) * _MORE} starts" if place in more else ""
        told = ("kept" if last.passed else "not kept") + starts
        why = "" if last.passed else last.reasons[0].splitlines()[0].replace("|", "/")
        span = quantity.span(trial.cpu_s)
        label = f"**{place.label}**" if place in matched else place.label
        yield [study.scene, label, span, told, why]
    found.append(f"- {study.scene}: {_cheapest(kept, matched)}.")


def _cheapest(kept: dict[Candidate, float], matched: list[Candidate]) -> str:
    own = [cost for place, cost in kept.items() if place in matched]
    if not own:
        return "none of these matched settings keeps all budgets"
    first = min(kept, key=lambda place: kept[place])
    if first in matched:
        return f"nothing is cheaper than what is matched, **{first.label}**"
    return f"{first.label} costs {kept[first] / min(own):.2f} of what is matched"


def _matched(study: Tradeoff, scene: Scene) -> list[Candidate]:
    """Give the matched settings of all engines on the chart."""
    places = []
    for engine in dict.fromkeys(curve.engine for curve in study.curves):
        settings = settings_for(scene, load_adapter(engine), "matched")
        places.append(Candidate(engine, settings, _label(engine, settings)))
    return places


def _cost(point: Point) -> float:
    return math.inf if point.cpu_s is None else point.cpu_s


def _cheaper(study: Tradeoff, cost: float) -> list[Candidate]:
    cheaper = [
        (curve, point)
        for curve, point in _points(study)
        if curve.own and not point.broken and _cost(point) < cost
    ]
    found = []
    for curve, point in sorted(cheaper, key=lambda pair: _cost(pair[1])):
        settings = Settings(curve.method, point.step_s, curve.options)
        found.append(Candidate(curve.engine, settings, _label(curve.engine, settings)))
    return found


def _points(study: Tradeoff) -> Iterator[tuple[CurveResult, Point]]:
    """All points that came to their end, without what users of the bare engine get."""
    for curve in study.curves:
        if curve.variation != NATIVE:
            yield from ((curve, point) for point in curve.points if point.cpu_s is not None)


def _label(engine: str, settings: Settings) -> str:
    options = ", ".join(f"{key} = {value}" for key, value in settings.options.items())
    method = f"{settings.method} ({options})" if options else settings.method
    return f"{engine}, {method}, {quantity.span(settings.step)}"


def _tried(scene: Scene, places: list[Candidate], starts: int, seed: int) -> list[Trial]:
    if not places:
        return []
    batch = draw_batch(scene, range(len(INTERVALS) * starts), seed=seed)
    reference = run_references(scene, batch, cache=True, workers=None)
    rows = [list(range(len(batch)))[k::_PARTS] for k in range(_PARTS)]
    tasks = [
        Task(
            run_trial,
            (
                scene,
                batch[part],
                place.engine,
                place.settings,
                part_of(reference, part),
                0 if k else _SAMPLE,
            ),
            _TIMEOUT,
        )
        for place in places
        for k, part in enumerate(rows)
    ]
    answers = [failed_trial(a) if isinstance(a, Crash) else a for a in run_tasks(tasks)]
    return [joined(answers[n : n + _PARTS]) for n in range(0, len(answers), _PARTS)]


if __name__ == "__main__":
    main()
