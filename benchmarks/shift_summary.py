"""Write reports/shift/README.md: a summary of the study of models under a change of engine.

python -m benchmarks.shift_summary reports/shift > reports/shift/README.md

`--png reports/shift/factors.png` draws its picture.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from benchmarks.harness import folder_and_file, stored
from mbds_xsim.base.files import write_whole
from mbds_xsim.learn.shift.answers import MATCHED, ROBUST
from mbds_xsim.learn.shift.gaps import ALL, LEAVE_ONE_OUT, SINGLE
from mbds_xsim.learn.shift.interaction import changed
from mbds_xsim.learn.shift.result import Gap, Interaction, Shift
from mbds_xsim.report import themed
from mbds_xsim.report.files import table_lines
from mbds_xsim.report.quantity import NONE, number, ratio
from mbds_xsim.studies.shift.changes import texts_of
from mbds_xsim.studies.shift.figures import at, best_formula, draw_costs, matrix_of, trained_models

_HEAD = """\
# Learned models under a change of engine, in short

<!-- Written by: python -m benchmarks.shift_summary reports/shift > reports/shift/README.md -->

**What do learned models inherit from the engine whose data taught them? Its settings; at equal
settings there is next to nothing to inherit.** At one step, without damping and with hard contact
data of MuJoCo, PyBullet and DART differ by less than any model errs. What costs is a coarser step,
PyBullet's damping and MuJoCo's soft contact.

![What a change of engine or settings costs, by scene and model](factors.png)

Each figure says how many times the squared error ten predicted frames ahead (t = 10, 0.2 s) grows
when the test data differ from the training data in one respect; 1 is no loss, brackets are 95 %
intervals, and what is bold, or framed, is significant among all pairs of a study. It is
√(R_ij R_ji / (R_ii R_jj)), R_ij the error of the model trained on i and tested on j. Where several
pairs of engines fall under a heading it is the largest bold one, or else the largest. A scene's
page has every pair, and what a model *survives*; where matched data have a page of their own, that
page has theirs, and what is bold is significant among its pairs.

*Equal*: MuJoCo, DART and PyBullet at a step of 1 ms, PyBullet without damping, contact hard.
*Native*: each engine as its users have it. *Matched*: settings that keep all budgets of the scene.
"""
Ends = tuple[str, str] | str
"""Two named domains, or the engines of one variant."""
_FACTORS: dict[str, tuple[str, Ends]] = {
    "engine alone, equal settings": ("engine\nalone", "equal"),
    "step alone, 4 or 1 ms": ("step", ("mujoco-coarse", "mujoco-equal")),
    "PyBullet's damping alone": ("damping", ("pybullet-native", "pybullet-undamped")),
    "MuJoCo's own contact and step": ("contact\nand step", ("mujoco-equal", "mujoco-native")),
    "engine, native settings": ("native\nengines", "native"),
    "engine, matched settings": ("matched\nengines", "matched"),
}
"""Short label, for the picture, and domains that differ in this factor alone."""
_PANEL = (5.6, 3.4)  # width and height [in]
_ALL = """
## All studies

Models trained on one engine's trajectories, on all but one engine's or on all, at equal budget,
and tested on every engine's. Each study's page has all figures.

- *beside a formula*: the error of a model where it was trained, over that of the best of hold,
  constant velocity and constant acceleration there; geometric mean over the engines.
- *resolved*: of the shifts from one engine to another, how many can be told from the model's own
  error and from chance.
- *worst gap*: error on another engine over that of the model trained there, the worst resolved
  pair; of all pairs where none is resolved, which says how well trainings went, not what a
  change of engine does.
- *without the target*: error of a training on all engines but the tested one, over that of single
  other engines. *all engines*: the worst engine's error of a training on all, over the worst of
  single ones.
- *change of engine*: √(R_ij R_ji / (R_ii R_jj)), R_ij the error of the training on i, tested on j:
  the geometric mean over pairs of engines, and the largest. The luck of trainings and how hard
  engines' data are cancel; 1 is no loss by the change.
- *native over matched*: mean gap on native data over that on matched data.

Brackets are 95 % intervals; below 1 several engines help, above 1 matched data lessen the shift.
[How this is measured](../../docs/shift.md).
"""
_PICTURES = {"-rollouts": "rollouts over the truth", "-curves": "learning curves"}
"""Words for pictures beside a page's own, by the ending of their file names."""
_NATIVE = "native"
_HEADINGS = (
    "study, frame|data|model|>beside a formula|>change of engine|>resolved|>worst gap"
    "|>without the target|>all engines|>native over matched"
)


def main() -> None:
    folder, picture = folder_and_file(__doc__, "--png")
    files = sorted(folder.glob("*.json.gz"))
    studies = {file.name.removesuffix(".json.gz"): stored(file, Shift) for file in files}
    several = {
        name: _with_matched(shift, studies.get(name.replace("-factors", "-matched")))
        for name, shift in studies.items()
        if _pairs(shift, "equal")  # else it has no factor alone
    }
    page = "".join(f"{line}\n" for line in _page(folder, studies, several))
    print(page, end="")
    if picture is not None:
        write_whole(picture, _picture(list(several.values()), page.encode()))


def _page(
    folder: Path, studies: Mapping[str, Shift], several: Mapping[str, Shift]
) -> Iterator[str]:
    yield _HEAD
    costs = [line for name, shift in several.items() for line in _costs(name, shift)]
    yield from table_lines(["scene", "model", *(f">{factor}" for factor in _FACTORS)], costs)
    yield "\n## What each study says\n"
    for name, shift in studies.items():
        pictures = {f"{name}{ending}.png": words for ending, words in _PICTURES.items()}
        links = [f"[{w}]({file})" for file, w in pictures.items() if (folder / file).is_file()]
        yield f"- [{name}]({name}.md) ({', '.join(links)}): {shift.answers[0].answer}."
    yield _ALL
    rows = [row for name, shift in studies.items() for row in rows_of(shift, name)]
    yield from table_lines(_HEADINGS.split("|"), [*rows, *_over_scenes(studies.values())])


def _costs(name: str, shift: Shift) -> Iterator[tuple[str, ...]]:
    """Yield a table row for each model of a study: the cost of each factor alone."""
    place = shift.frames.index(shift.at)
    for model in trained_models(shift):
        costs = [_cost(_dearest(shift, model, ends), place) for _, ends in _FACTORS.values()]
        yield f"[{shift.scene}]({name}.md)", model, *costs


def _pairs(shift: Shift, ends: Ends) -> list[Interaction]:
    """Return the pairs of these two domains, or of engines of this variant."""
    if isinstance(ends, str):
        change = ("engine", f"on {ends} data")
        return [p for p in shift.interactions if changed(p.first, p.second) == change]
    return [pair for pair in shift.interactions if {pair.first, pair.second} == {*ends}]


def _with_matched(shift: Shift, matched: Shift | None) -> Shift:
    """Add the pairs of engines on matched data from their own study, if this one has none."""
    if matched is None or matched.frames != shift.frames or _pairs(shift, "matched"):
        return shift
    pairs = (*shift.interactions, *matched.interactions)
    return msgspec.structs.replace(shift, interactions=pairs)


def _dearest(shift: Shift, model: str, ends: Ends) -> Interaction | None:
    """Return the most costly pair, preferring significant ones; None if none is known."""
    place = shift.frames.index(shift.at)
    own = [pair for pair in _pairs(shift, ends) if pair.model == model]
    known = [pair for pair in own if pair.value[place] is not None]
    return max(known, key=lambda pair: (pair.resolved[place], pair.value[place]), default=None)


def _cost(pair: Interaction | None, place: int) -> str:
    if pair is None:
        return NONE
    (value, low, high), mark = texts_of(pair, place), "**" if pair.resolved[place] else ""
    return f"{mark}{value}{mark} [{low}, {high}]"


def _picture(studies: Sequence[Shift], page: bytes) -> bytes:
    """Draw a table for each model, on one colour scale, for the page with the same figures."""
    models = list(dict.fromkeys(model for shift in studies for model in trained_models(shift)))
    tables: dict[str, dict[tuple[int, int], tuple[float | None, bool]]] = {m: {} for m in models}
    factors = list(_FACTORS.values())
    for row, shift in enumerate(studies):
        place = shift.frames.index(shift.at)
        for model, (column, (_, ends)) in itertools.product(models, enumerate(factors)):
            if pair := _dearest(shift, model, ends):
                tables[model][row, column] = pair.value[place], pair.resolved[place]
    most = max(value or 1.0 for costs in tables.values() for value, _ in costs.values())
    scenes, labels = [shift.scene for shift in studies], [label for label, _ in factors]
    rows = math.ceil(len(models) / 2)

    def draw(figure: Any) -> None:
        parts = figure.subplots(rows, 2, squeeze=False).ravel()
        for axes, model in itertools.zip_longest(parts, models):
            if model is None:
                axes.remove()
                continue
            draw_costs(axes, tables[model], scenes, labels, most)
            axes.set_title(model)
        words = "How many times the squared error grows by which change"
        figure.suptitle(f"{words}, t = {studies[0].at} (framed: significant)")

    return themed.png(draw, (2 * _PANEL[0], rows * _PANEL[1]), page)


def rows_of(shift: Shift, name: str) -> Iterator[tuple[str, ...]]:
    """Yield a table row for each model on each variant of the data, with links by name."""
    place = shift.frames.index(shift.at)
    for variant in _variants(shift):
        for model in trained_models(shift):
            own = [gap for gap in shift.gaps if _within(gap, model, variant)]
            yield (
                f"[{name}]({name}.md), t = {shift.at}",
                variant,
                model,
                number(_beside_formula(shift, model, variant)),
                _change(shift, model, variant),
                f"{sum(gap.resolved[place] for gap in own)} of {len(own)}",
                *(
                    _ratio(shift, kind, model, "" if kind == MATCHED else variant, place)
                    for kind in (ROBUST, LEAVE_ONE_OUT, ALL, MATCHED)
                ),
            )


def _over_scenes(studies: Iterable[Shift]) -> Iterator[tuple[str, ...]]:
    """Yield a row for each model: its geometric mean over scenes, as errors cannot be added."""
    native = {shift.scene: shift for shift in studies if _variants(shift) == [_NATIVE]}
    for model in dict.fromkeys(m for shift in native.values() for m in trained_models(shift)):
        own = [shift for shift in native.values() if model in trained_models(shift)]
        parts = [part for shift in own if (part := _beside_formula(shift, model, _NATIVE))]
        if len(own) > 1 and len(parts) == len(own):
            mean = number(statistics.geometric_mean(parts))
            scenes = f"geometric mean of {len(own)} scenes"
            yield scenes, _NATIVE, model, mean, *[NONE] * 6


def _variants(shift: Shift) -> list[str]:
    """Return the variants of settings that several engines share."""
    engines = Counter(domain.variant for domain in shift.domains if domain.variant)
    return [variant for variant, count in engines.items() if count > 1]


def _within(gap: Gap, model: str, variant: str) -> bool:
    """Return whether a gap is one of the model's, between two engines of a variant."""
    variants = {domain.rpartition("-")[2] for domain in (gap.training, gap.test)}
    return (gap.model, gap.kind, variants) == (model, SINGLE, {variant})


def _beside_formula(shift: Shift, model: str, variant: str) -> float | None:
    """Return the geometric mean over engines of a model's error over the best formula's."""
    pick = at(shift, shift.at)
    learned, formulas = matrix_of(shift, model, pick), best_formula(shift, pick)
    parts = []
    for name in (home for home in learned.homes if home.endswith(f"-{variant}")):
        error = learned.at_home(name)
        if error is None or not formulas.get(name):
            return None
        parts.append(error / formulas[name])
    return statistics.geometric_mean(parts) if parts else None


def _change(shift: Shift, model: str, variant: str) -> str:
    """Format mean and largest interaction of engine pairs, from the errors over all seeds."""
    matrix = matrix_of(shift, model, at(shift, shift.at))
    homes = [name for name in matrix.homes if name.endswith(f"-{variant}")]
    interactions = []
    for one, two in itertools.combinations(homes, 2):
        errors = [matrix.entry(i, j) for i, j in ((one, two), (two, one), (one, one), (two, two))]
        if not all(errors):
            return NONE
        there, back, first, second = (x or 1.0 for x in errors)
        interactions.append(math.sqrt(there * back / (first * second)))
    if not interactions:
        return NONE
    return f"{statistics.geometric_mean(interactions):.3g}, {max(interactions):.3g}"


def _ratio(shift: Shift, kind: str, model: str, variant: str, place: int) -> str:
    for answer in shift.answers:
        if (answer.kind, answer.variant) == (kind, variant) and model in answer.ratios:
            bounded = answer.ratios[model]
            figures = (bounded.value[place], bounded.low[place], bounded.high[place])
            return "{} [{}, {}]".format(*map(ratio, figures))
    return NONE


if __name__ == "__main__":
    main()
