"""Tables of a shift study, ready for Markdown, pages and the terminal alike."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterator, Sequence

from mbds_xsim.learn.shift.domains import REFERENCE
from mbds_xsim.learn.shift.evaluation import ENGINE, RESTART
from mbds_xsim.learn.shift.gaps import PAPER, paper_errors
from mbds_xsim.learn.shift.models import TRIVIAL
from mbds_xsim.learn.shift.result import INTERVALS, ErrorCell, Gap, ModelFacts, Shift
from mbds_xsim.report.blocks import Column, Table, table_of
from mbds_xsim.report.quantity import NONE, number
from mbds_xsim.studies.shift.matrix import (
    Matrix,
    Pick,
    at,
    best_formula,
    matrix_of,
    mean,
    trained_models,
)


def tables(shift: Shift) -> Iterator[Table]:
    """Give all tables that there are figures for."""
    yield from (table for table in _tables(shift) if table.rows)


def _tables(shift: Shift) -> Iterator[Table]:
    frame = shift.at
    place = shift.frames.index(frame)
    for model in trained_models(shift):
        yield _errors(shift, model, frame)
    for model in trained_models(shift):
        yield _one_step(shift, model)
    yield _transfer(shift, frame)
    yield _gaps(shift, place)
    yield _floors(shift)
    yield _by_interval(shift, frame)
    if any(facts.interval for facts in shift.models):
        yield _across_intervals(shift, frame)
    yield _quality(shift, place)
    if any(agreement.tau is not None for agreement in shift.agreements):
        yield _agreements(shift)
    if paper_errors(shift.scene):
        yield _paper(shift)


def _table(
    title: str, note: str, heading: tuple[str, ...], rows: tuple[tuple[str, ...], ...]
) -> Table:
    columns = [Column(text, words=not place) for place, text in enumerate(heading)]
    return table_of(columns, rows, title=title, note=note)


def _errors(shift: Shift, model: str, frame: int) -> Table:
    pick = at(shift, frame)
    rows = [*_rows(matrix_of(shift, model, pick)), *_comparison(shift, pick)]
    rows += [_floor_row(shift, kind, frame) for kind in ("noise", "chaos")]
    return _table(
        f"{model}: position error at t = {frame}",
        "Mean squared distance [m²], mean over seeds; predictions that were lost or had been off "
        f"by over {shift.exploded:g} lengths of the scene count as {shift.exploded:g} lengths, "
        "in brackets how many of all seeds. Rows are trainings, columns test domains",
        ("trained on", *_headings(shift, shift.frames.index(frame))),
        tuple(_with_lost(shift, model, rows, shift.frames.index(frame))),
    )


def _with_lost(
    shift: Shift, model: str, rows: Sequence[tuple[str, ...]], place: int
) -> Iterator[tuple[str, ...]]:
    """Add the number of diverged predictions to the figures of trainings and engines."""
    lost: Counter[tuple[str, str]] = Counter()
    for cell in shift.cells:
        if cell.model in (model, RESTART) and cell.interval == INTERVALS[0]:
            label = cell.training if cell.model == model else f"{RESTART} {cell.training}"
            lost[label, cell.test] += cell.diverged[place]
    names = [domain.name for domain in shift.domains]
    for label, *texts in rows:
        counts = [lost[label, name] for name in names]
        marked = [f"{t} ({n})" if n else t for t, n in zip(texts, counts, strict=True)]
        yield (label, *marked)


def _headings(shift: Shift, place: int) -> Iterator[str]:
    """Names of the domains, with the number of trajectories where not all are known."""
    for domain in shift.domains:
        known = next(
            c.known[place] for c in shift.cells if (c.test, c.interval) == (domain.name, "all")
        )
        whole = len(shift.index)
        yield domain.name if known == whole else f"{domain.name} ({known} of {whole} known)"


def _one_step(shift: Shift, model: str) -> Table:
    def pick(cell: ErrorCell) -> float | None:
        return cell.one_step

    rows = list(_rows(matrix_of(shift, model, pick)))
    for row in _rows(matrix_of(shift, RESTART, pick)):
        rows.append((f"{RESTART} {row[0]}", *row[1:]))
    for name in TRIVIAL:
        rows += _rows(matrix_of(shift, name, pick), name)
    return _table(
        f"{model}: teacher-forced error",
        f"Squared distance [m²] of predictions by one frame from true windows, every "
        f"{shift.stride} frames: not chaotic. Restarted engines: of the first window only",
        ("trained on", *(domain.name for domain in shift.domains)),
        tuple(rows),
    )


def _comparison(shift: Shift, pick: Pick) -> Iterator[tuple[str, ...]]:
    """Engines as models, and trivial models."""
    for kind in (ENGINE, RESTART):
        for row in _rows(matrix_of(shift, kind, pick)):
            yield (f"{kind} {row[0]}", *row[1:])
    for name in TRIVIAL:
        yield from _rows(matrix_of(shift, name, pick), name)


def _rows(matrix: Matrix, label: str = "") -> Iterator[tuple[str, ...]]:
    for name, values in zip(matrix.rows, matrix.values, strict=True):
        yield (label.replace("_", " ") or name, *map(number, values))


def _floor_row(shift: Shift, kind: str, frame: int) -> tuple[str, ...]:
    """A floor of the reference: the same for all domains."""
    place = shift.frames.index(frame)
    found = [f for f in shift.floors if f.kind == kind and f.interval == INTERVALS[0]]
    text = number(found[0].mse[place]) if found else NONE
    return (f"{kind} floor", *(text for _ in shift.domains))


def _transfer(shift: Shift, frame: int) -> Table:
    """Rows and columns of the matrices of single engines in short."""
    pick = at(shift, frame)
    rows = []
    for model in trained_models(shift):
        matrix = matrix_of(shift, model, pick)
        for name in matrix.homes:
            ends = f"-{name.rpartition('-')[2]}"
            others = [n for n in matrix.columns if n != name and n.endswith(ends)]
            out = {n: matrix.entry(name, n) for n in others}
            into = [matrix.entry(n, name) for n in others if n in matrix.rows]
            known = {n: error for n, error in out.items() if error is not None}
            worst = max(known, key=lambda n: known[n], default="")
            rows.append(
                (
                    f"{model}, {name}",
                    number(matrix.entry(name, name)),
                    number(_over_seeds(shift, model, name, pick)),
                    number(mean([*out.values()])),
                    f"{number(known[worst])} ({worst})" if worst else NONE,
                    number(mean(into)),
                )
            )
    return _table(
        f"From engine to engine at t = {frame}",
        "Mean squared distance [m²]. Out: a training on the variant's other engines, mean and "
        "worst. In: the other engines' trainings here. Spread: standard deviation over seeds; the "
        "intervals below have it in them, beside that over trajectories",
        ("", "at home", "spread", "out", "worst", "in"),
        tuple(rows),
    )


def _over_seeds(shift: Shift, model: str, name: str, pick: Pick) -> float | None:
    """Standard deviation of a training's errors at home; None of one seed."""
    key = (model, name, name, INTERVALS[0])
    found = [pick(c) for c in shift.cells if (c.model, c.training, c.test, c.interval) == key]
    known = [x for x in found if x is not None]
    return statistics.stdev(known) if len(known) > 1 else None


def _gaps(shift: Shift, place: int) -> Table:
    frame = shift.frames[place]
    rows = [_gap_row(gap, place) for gap in shift.gaps]
    return _table(
        f"Gaps to the target-trained model at t = {frame}",
        "Errors [m²] are means over trajectories and seeds, lost predictions counting as exploded; "
        "ratio and its 95 % interval by paired bootstrap over trajectories and seeds. A shift is "
        "resolved where the model's own error is below the engine floor and the interval of the "
        "difference is without 0",
        (
            "model, trained on → tested on", "kind", "own error", "error", "target-trained",
            "ratio", "95 %", "engine floor", "noise floor", "chaos floor", "shift",
        ),
        tuple(rows),
    )  # fmt: skip


def _gap_row(gap: Gap, place: int) -> tuple[str, ...]:
    interval = f"{number(gap.ratio_low[place])} … {number(gap.ratio_high[place])}"
    figures = (gap.own, gap.transferred, gap.target, gap.ratio)
    floors = (gap.engine_floor, gap.noise_floor, gap.chaos_floor)
    return (
        f"{gap.model}, {gap.training} → {gap.test}",
        gap.kind,
        *(number(figure[place]) for figure in figures),
        interval,
        *(number(floor[place]) for floor in floors),
        "resolved" if gap.resolved[place] else f"not resolvable: {gap.why[place]}",
    )


def _floors(shift: Shift) -> Table:
    rows = [
        (_floor_name(f.kind, f.first, f.test), *map(number, f.mse))
        for f in shift.floors
        if f.interval == INTERVALS[0]
        # A distance is told once: it is the same both ways.
        and (f.kind != ENGINE or f.test == REFERENCE or f.first < f.test)
    ]
    return _table(
        "Floors",
        "Mean squared distance [m²] of the published motions of two domains, from identical "
        "starts; of an engine that goes on from a domain's last known frame from that domain "
        "(its own: what restarting costs); of the reference without noise from that with it; of "
        "two motions whose last known frame is 0.1 mm apart (chaos, by linear growth). No error "
        "below them says anything of a model",
        ("", *(f"t = {frame}" for frame in shift.frames)),
        tuple(rows),
    )


def _floor_name(kind: str, first: str, test: str) -> str:
    names = {ENGINE: f"{first} and {test}", RESTART: f"{first} gone on from {test}"}
    return names.get(kind, kind)


def _across_intervals(shift: Shift, frame: int) -> Table:
    """Trainings on an interval of starts, on their own engine: a change of speed alone."""
    pick = at(shift, frame)
    rows = []
    for model in trained_models(shift):
        tests = {name: matrix_of(shift, model, pick, name) for name in INTERVALS[1:]}
        for facts in _with_intervals(shift, model):
            home = f"{facts.engines[0]}-{facts.training.rpartition('-')[2]}"
            errors = [matrix.entry(facts.training, home) for matrix in tests.values()]
            own = [
                matrix.entry(facts.training.replace(f"-{facts.interval}-", f"-{name}-"), home)
                for name, matrix in tests.items()
            ]
            parts = [_over(e, o) for e, o in zip(errors, own, strict=True)]
            rows.append((f"{model}, {facts.training}", *map(number, [*errors, *parts])))
    return _table(
        f"The covariate axis: trained on one interval, tested on all, t = {frame}",
        "Mean squared distance [m²] on the training's own engine, of models that were trained on "
        "the starts of one interval alone, a third as many at as many steps; and over the error of "
        "the training on the interval tested: how large a change of speed is, to hold a change of "
        "engine against",
        ("", *INTERVALS[1:], *(f"{name}, ratio" for name in INTERVALS[1:])),
        tuple(rows),
    )


def _with_intervals(shift: Shift, model: str) -> Iterator[ModelFacts]:
    """Of each training on an interval one, whatever its seed."""
    found = [facts for facts in shift.models if facts.model == model and facts.interval]
    yield from {facts.training: facts for facts in found}.values()


def _by_interval(shift: Shift, frame: int) -> Table:
    """Each training at home, by interval: no change of engine."""
    pick = at(shift, frame)
    formulas = [best_formula(shift, pick, name) for name in INTERVALS[1:]]
    rows = []
    for model in trained_models(shift):
        by_interval = [matrix_of(shift, model, pick, name) for name in INTERVALS[1:]]
        for training in matrix_of(shift, model, pick).homes:
            errors = [matrix.at_home(training) for matrix in by_interval]
            parts = [_over(e, f.get(training)) for e, f in zip(errors, formulas, strict=True)]
            rows.append((f"{model}, {training}", *map(number, [*errors, *parts])))
    return _table(
        f"Error at home by interval of starts, t = {frame}",
        "Mean squared distance [m²] on the training's own engine: how much the interval of starts "
        "and inputs matters, without any change of engine; and as a part of the least that hold, "
        "constant velocity and constant acceleration reach there",
        ("", *INTERVALS[1:], *(f"{name}, part" for name in INTERVALS[1:])),
        tuple(rows),
    )


def _over(error: float | None, other: float | None) -> float | None:
    return error / other if error is not None and other else None


def _quality(shift: Shift, place: int) -> Table:
    """Other figures of each training at home."""
    rows = []
    for model in trained_models(shift):
        picks: tuple[Pick, ...] = (
            lambda cell: cell.valid_s,
            lambda cell: cell.energy[place],
            lambda cell: cell.gap[place],
            lambda cell: cell.diverged[-1] / max(cell.known[-1], 1),
        )
        found = [matrix_of(shift, model, pick) for pick in picks]
        for training in found[0].homes:
            texts = [number(matrix.at_home(training)) for matrix in found]
            rows.append((f"{model}, {training}", *texts))
    return _table(
        "What else rollouts keep, each training at home",
        f"Valid prediction time: until the error first exceeds {shift.lost:g} of the scene's "
        f"length ({shift.length_m:.3g} m), median, at most {shift.horizon * shift.frame_s:.3g} s. "
        f"Energy error and constraint gap: medians at t = {shift.frames[place]}. Diverged: share "
        "of trajectories over the whole horizon",
        ("", "valid [s]", "energy error", "constraint gap [m]", "diverged"),
        tuple(rows),
    )


def _agreements(shift: Shift) -> Table:
    pairs = dict.fromkeys((a.first, a.second) for a in shift.agreements)
    found = {(a.first, a.second, a.frame): a.tau for a in shift.agreements}
    rows = [
        (f"{one}, {two}", *(number(found.get((one, two, frame))) for frame in shift.frames))
        for one, two in pairs
    ]
    return _table(
        "Rank agreement",
        "Kendall's τ-b of the orders that two domains give the models, each trained where it is "
        "tested: 1 the same, −1 reversed; from three models on",
        ("", *(f"t = {frame}" for frame in shift.frames)),
        tuple(rows),
    )


def _paper(shift: Shift) -> Table:
    """The paper's figures beside ours, as data."""
    paper, sound = paper_errors(shift.scene), paper_errors(shift.scene, flagged=False)
    frames = sorted({frame for _, frame in paper})
    rows = []
    for model in dict.fromkeys(model for model, _ in paper):
        marks = ["" if (model, f) in sound or (model, f) not in paper else " *" for f in frames]
        texts = [number(paper.get((model, f))) for f in frames]
        rows.append((f"{model}, {PAPER}", *map(str.__add__, texts, marks)))
    for model in trained_models(shift):
        homes = {f: _home_mean(shift, model, f) for f in frames if f in shift.frames}
        rows.append((f"{model}, here", *(number(homes.get(frame)) for frame in frames)))
    return _table(
        "The paper's figures beside these",
        "Not comparable in absolute value: the paper's unit, averaging, masses, noise and test "
        "part are not stated, its figures are of the set that steered training, and its values "
        "at t = 1 are far above constant velocity's in metres. What can be compared is the order "
        "of the models (rank agreement) and the growth with t, but for what cannot be right as "
        "printed (*: less than at an earlier t, or copied). Here: mean over single-engine "
        "trainings at home [m²]",
        ("", *(f"t = {frame}" for frame in frames)),
        tuple(rows),
    )


def _home_mean(shift: Shift, model: str, frame: int) -> float | None:
    matrix = matrix_of(shift, model, at(shift, frame))
    homes = [matrix.at_home(row) for row in matrix.homes]
    return mean(homes)
