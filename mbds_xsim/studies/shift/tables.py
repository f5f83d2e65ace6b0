"""Tables of a shift study, ready for Markdown, pages and the terminal alike."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from mbds_xsim.learn.model import TRIVIAL
from mbds_xsim.learn.shift.domains import REFERENCE
from mbds_xsim.learn.shift.evaluation import ENGINE, RESTART
from mbds_xsim.learn.shift.gaps import PAPER, paper_errors
from mbds_xsim.learn.shift.interaction import changed
from mbds_xsim.learn.shift.result import INTERVALS, Gap, Shift
from mbds_xsim.report.blocks import Table
from mbds_xsim.report.quantity import NONE, number, ratio
from mbds_xsim.studies.shift.changes import change_tables, other_engines, titled_table
from mbds_xsim.studies.shift.figures import Pick, at, best_formula, matrix_of, mean, trained_models
from mbds_xsim.studies.shift.worth import worth_table

_NEAR_AT = (10, 20, 50)  # frames at which models and engines are compared


def tables(shift: Shift) -> Iterator[Table]:
    """Yield all tables that have figures."""
    yield from (table for table in _tables(shift) if table.rows)


def _tables(shift: Shift) -> Iterator[Table]:
    frame, models = shift.at, trained_models(shift)
    place = shift.frames.index(frame)
    yield from change_tables(shift, place)
    yield from (_errors(shift, model, place) for model in models)
    yield from (_one_step(shift, model) for model in models)
    yield _transfer(shift, frame)
    yield _gaps(shift, place)
    yield worth_table(shift, place)
    yield nearness(shift)
    yield _effort(shift)
    yield _floors(shift)
    yield _by_interval(shift, frame)
    if any(facts.interval for facts in shift.models):
        yield _across_intervals(shift, frame)
    yield _quality(shift, place)
    if any(agreement.tau is not None for agreement in shift.agreements):
        yield _agreements(shift)
    if paper_errors(shift.scene):
        yield _paper(shift)


def _errors(shift: Shift, model: str, place: int) -> Table:
    frame, lost = shift.frames[place], Counter[tuple[str, str, str]]()
    headings = []
    for domain in shift.domains:
        cells = [c for c in shift.cells if (c.test, c.interval) == (domain.name, INTERVALS[0])]
        known, whole = cells[0].known[place], len(shift.index)
        words = "" if known == whole else f" ({known} of {whole} known)"
        headings.append(f"{domain.name}{words}")
        for cell in cells:
            if cell.model in (model, RESTART):
                lost[cell.model, cell.training, cell.test] += cell.diverged[place]
    rows = list(_rows(shift, at(shift, frame), (model, ENGINE, RESTART, *TRIVIAL), lost))
    for kind in ("noise", "chaos"):  # of the reference: the same for all domains
        floors = [f for f in shift.floors if f.kind == kind and f.interval == INTERVALS[0]]
        text = number(floors[0].mse[place]) if floors else NONE
        rows.append((f"{kind} floor", *(text for _ in headings)))
    return titled_table(
        f"{model}: position error at t = {frame}",
        "Mean squared distance [m²], mean over seeds; predictions that were lost or had been off "
        f"by over {shift.exploded:g} lengths of the scene count as {shift.exploded:g} lengths, "
        "in brackets how many of all seeds. Rows are trainings, columns test domains",
        ("trained on", *headings),
        rows,
    )


def _one_step(shift: Shift, model: str) -> Table:
    return titled_table(
        f"{model}: teacher-forced error",
        f"Squared distance [m²] of predictions by one frame from true windows, every "
        f"{shift.stride} frames: not chaotic",
        ("trained on", *(domain.name for domain in shift.domains)),
        _rows(shift, lambda cell: cell.one_step, (model, RESTART, *TRIVIAL), {}),
    )


def _rows(
    shift: Shift, pick: Pick, models: Sequence[str], lost: Mapping[tuple[str, str, str], int]
) -> Iterator[tuple[str, ...]]:
    """Yield figures of all trainings of models, engines and formulas, with counts of lost ones."""
    for model in models:
        matrix = matrix_of(shift, model, pick)
        for training, values in zip(matrix.rows, matrix.values, strict=True):
            counts = [lost.get((model, training, name), 0) for name in matrix.columns]
            texts = [
                number(x) + (f" ({n})" if n else "") for x, n in zip(values, counts, strict=True)
            ]
            label = f"{model} {training}" if model in (ENGINE, RESTART) else training
            yield (model.replace("_", " ") if model in TRIVIAL else label, *texts)


def _transfer(shift: Shift, frame: int) -> Table:
    """Summarise the rows and columns of the error matrices of single engines."""
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
            spread = _over_seeds(shift, model, name, pick)
            figures = (matrix.at_home(name), spread, mean([*out.values()]))
            most = f"{number(known[worst])} ({worst})" if worst else NONE
            rows.append((f"{model}, {name}", *map(number, figures), most, number(mean(into))))
    return titled_table(
        f"From engine to engine at t = {frame}",
        "Mean squared distance [m²]. Out: a training on the variant's other engines, mean and "
        "worst. In: the other engines' trainings here. Spread: standard deviation over seeds; the "
        "intervals below have it in them, beside that over trajectories",
        ("", "at home", "spread", "out", "worst", "in"),
        rows,
    )


def _over_seeds(shift: Shift, model: str, name: str, pick: Pick) -> float | None:
    """Return the standard deviation over seeds of a training's error at home; None for one seed."""
    key = (model, name, name, INTERVALS[0])
    errors = [pick(c) for c in shift.cells if (c.model, c.training, c.test, c.interval) == key]
    known = [x for x in errors if x is not None]
    return statistics.stdev(known) if len(known) > 1 else None


def _gaps(shift: Shift, place: int) -> Table:
    return titled_table(
        f"Gaps to the target-trained model at t = {shift.frames[place]}",
        "Errors [m²] are means over trajectories and seeds, lost predictions counting as exploded; "
        "ratio and its 95 % interval by paired bootstrap over trajectories and seeds. A shift is "
        "resolved where the model's own error is below the engine floor and the interval of the "
        "difference is without 0. Of two domains that differ in engine and settings, see the JSON",
        (
            "model, trained on → tested on", "kind", "own error", "error", "target-trained",
            "ratio", "95 %", "engine floor", "noise floor", "chaos floor", "shift",
        ),
        (
            _gap_row(gap, place)
            for gap in shift.gaps
            if gap.kind != "single" or changed(gap.training, gap.test)
        ),
    )  # fmt: skip


def _gap_row(gap: Gap, place: int) -> tuple[str, ...]:
    errors = (gap.own, gap.transferred, gap.target)
    ratios = (gap.ratio, gap.ratio_low, gap.ratio_high)
    value, low, high = (ratio(x[place], significant=gap.resolved[place]) for x in ratios)
    floors = (gap.engine_floor, gap.noise_floor, gap.chaos_floor)
    return (
        f"{gap.model}, {gap.training} → {gap.test}",
        gap.kind,
        *(number(error[place]) for error in errors),
        value,
        f"{low} … {high}",
        *(number(floor[place]) for floor in floors),
        "resolved" if gap.resolved[place] else f"not resolvable: {gap.why[place]}",
    )


def nearness(shift: Shift) -> Table:
    """Tabulate whether a model is nearer to its training engine than any other engine is.

    The table has a row for each training on one domain; rows without figures are left out.
    """
    frames = [frame for frame in _NEAR_AT if frame in shift.frames]
    rows = (
        (
            label,
            *(
                _beside(own, _nearest(shift, home, frame))
                for own, frame in zip(errors, frames, strict=True)
            ),
        )
        for label, home, errors in _at_home(shift, [(at(shift, f), INTERVALS[0]) for f in frames])
    )
    return titled_table(
        "Is a model nearer to its engine than any other engine is?",
        "Mean squared distance [m²] of the model from the domain that taught it, below or above "
        "that of the nearest other engine that goes on from the same frame; nothing where that is "
        "below the noise floor, so that no model could tell",
        ("trained on", *(f"t = {frame}" for frame in frames)),
        (row for row in rows if any(text != NONE for text in row[1:])),
    )


def _beside(own: float | None, other: float | None) -> str:
    if own is None or other is None:
        return NONE
    return f"{number(own)} {'<' if own < other else '>'} {number(other)}"


def _nearest(shift: Shift, home: str, frame: int) -> float | None:
    """Return the distance of the nearest other engine [m²]; None if not above the noise floor."""
    place, whole = shift.frames.index(frame), INTERVALS[0]
    noise = [f.mse[place] or 0.0 for f in shift.floors if (f.kind, f.interval) == ("noise", whole)]
    apart = [floor.mse[place] for floor in other_engines(shift, home)]
    nearest = min((x for x in apart if x is not None), default=None)
    return None if nearest is None or nearest <= max(noise, default=0.0) else nearest


def _effort(shift: Shift) -> Table:
    """Tabulate how long models trained until nearer to their engine than any other engine is."""
    single = [facts for facts in shift.models if len(facts.engines) == 1]
    rows = []
    for model, training in dict.fromkeys((facts.model, facts.training) for facts in single):
        own = [f.to_floor_s for f in single if (f.model, f.training) == (model, training)]
        reached = [seconds for seconds in own if seconds is not None]
        if reached:
            seeds = f"{len(reached)} of {len(own)}"
            rows.append((f"{model}, {training}", seeds, *map(number, (min(reached), max(reached)))))
    return titled_table(
        "Processor time to the engine floor",
        "Seconds of training, validations included, until the validation error, a mean over ten "
        "frames, was below the distance of the nearest other engine that goes on from the same "
        "frame",
        ("trained on", "seeds that reached it", "first", "last"),
        rows,
    )


def _floors(shift: Shift) -> Table:
    rows = []
    for floor in shift.floors:
        first, test = floor.first, floor.test
        names = {ENGINE: f"{first} and {test}", RESTART: f"{first} restarted from {test}"}
        # A distance is the same both ways, so it is listed once.
        twice = floor.kind == ENGINE and test != REFERENCE and first > test
        alike = not first or test in (first, REFERENCE) or changed(first, test)
        if floor.interval == INTERVALS[0] and alike and not twice:
            rows.append((names.get(floor.kind, floor.kind), *map(number, floor.mse)))
    return titled_table(
        "Floors",
        "Mean squared distance [m²] of the published motions of two domains, from identical "
        "starts; of an engine that goes on from a domain's last known frame from that domain "
        "(its own: what restarting costs); of the reference without noise from that with it; of "
        "two motions whose last known frame is 0.1 mm apart (chaos, by linear growth). No error "
        "below them says anything of a model. Domains that differ in engine and settings are left "
        "out",
        ("", *(f"t = {frame}" for frame in shift.frames)),
        rows,
    )


def _across_intervals(shift: Shift, frame: int) -> Table:
    """Tabulate trainings on one interval of starts, on their own engine: only speed changes."""
    pick = at(shift, frame)
    rows = []
    for model in trained_models(shift):
        tests = {name: matrix_of(shift, model, pick, name) for name in INTERVALS[1:]}
        own = [facts for facts in shift.models if facts.model == model and facts.interval]
        for facts in {each.training: each for each in own}.values():  # whatever their seeds
            home = f"{facts.engines[0]}-{facts.training.rpartition('-')[2]}"
            errors = [matrix.entry(facts.training, home) for matrix in tests.values()]
            baselines = [
                matrix.entry(facts.training.replace(f"-{facts.interval}-", f"-{name}-"), home)
                for name, matrix in tests.items()
            ]
            figures = [*errors, *map(_over, errors, baselines)]
            rows.append((f"{model}, {facts.training}", *map(number, figures)))
    return titled_table(
        f"The covariate axis: trained on one interval, tested on all, t = {frame}",
        "Mean squared distance [m²] on the training's own engine, of models that were trained on "
        "the starts of one interval alone, a third as many at as many steps; and over the error of "
        "the training on the interval tested: how large a change of speed is, to hold a change of "
        "engine against",
        ("", *INTERVALS[1:], *(f"{name}, ratio" for name in INTERVALS[1:])),
        rows,
    )


def _by_interval(shift: Shift, frame: int) -> Table:
    """Tabulate each training at home by interval, without a change of engine."""
    pick, names = at(shift, frame), INTERVALS[1:]
    formulas = [best_formula(shift, pick, name) for name in names]
    rows = []
    for label, training, errors in _at_home(shift, [(pick, name) for name in names]):
        parts = [_over(e, f.get(training)) for e, f in zip(errors, formulas, strict=True)]
        rows.append((label, *map(number, [*errors, *parts])))
    return titled_table(
        f"Error at home by interval of starts, t = {frame}",
        "Mean squared distance [m²] on the training's own engine: how much the interval of starts "
        "and inputs matters, without any change of engine; and as a part of the least that hold, "
        "constant velocity and constant acceleration reach there",
        ("", *names, *(f"{name}, part" for name in names)),
        rows,
    )


def _over(error: float | None, other: float | None) -> float | None:
    return error / other if error is not None and other else None


def _quality(shift: Shift, place: int) -> Table:
    """Tabulate other figures of each training at home."""
    picks: tuple[Pick, ...] = (
        lambda cell: cell.valid_s,
        lambda cell: cell.energy[place],
        lambda cell: cell.gap[place],
        lambda cell: _over(cell.diverged[-1], cell.known[-1]),
    )
    homes = _at_home(shift, [(pick, INTERVALS[0]) for pick in picks])
    return titled_table(
        "What else rollouts keep, each training at home",
        f"Valid prediction time: until the error first exceeds {shift.lost:g} of the scene's "
        f"length ({shift.length_m:.3g} m), median, at most {shift.horizon * shift.frame_s:.3g} s. "
        f"Energy error and constraint gap: medians at t = {shift.frames[place]}. Diverged: share, "
        f"by t = {shift.frames[-1]}, of the trajectories whose truth is known there",
        ("", "valid [s]", "energy error", "constraint gap [m]", "diverged"),
        ((label, *map(number, figures)) for label, _, figures in homes),
    )


def _at_home(
    shift: Shift, picks: Sequence[tuple[Pick, str]]
) -> Iterator[tuple[str, str, list[float | None]]]:
    """Yield label, training and figures, each over its interval, of all trainings at home."""
    for model in trained_models(shift):
        matrices = [matrix_of(shift, model, pick, interval) for pick, interval in picks]
        for training in matrix_of(shift, model, at(shift, shift.at)).homes:
            yield f"{model}, {training}", training, [each.at_home(training) for each in matrices]


def _agreements(shift: Shift) -> Table:
    pairs = dict.fromkeys((a.first, a.second) for a in shift.agreements)
    taus = {(a.first, a.second, a.frame): a.tau for a in shift.agreements}
    rows = [
        (f"{one}, {two}", *(number(taus.get((one, two, frame))) for frame in shift.frames))
        for one, two in pairs
    ]
    return titled_table(
        "Rank agreement",
        "Kendall's τ-b of the orders that two domains give the models, each trained where it is "
        "tested: 1 the same, −1 reversed; from three models on",
        ("", *(f"t = {frame}" for frame in shift.frames)),
        rows,
    )


def _paper(shift: Shift) -> Table:
    """Tabulate the paper's figures next to ours."""
    paper, sound = paper_errors(shift.scene), paper_errors(shift.scene, flagged=False)
    frames = sorted({frame for _, frame in paper})
    rows = []
    for model in dict.fromkeys(model for model, _ in paper):
        marks = ["" if (model, f) in sound or (model, f) not in paper else " *" for f in frames]
        texts = [number(paper.get((model, f))) for f in frames]
        rows.append((f"{model}, {PAPER}", *map(str.__add__, texts, marks)))
    for model in trained_models(shift):
        homes = dict.fromkeys(frames, NONE)
        for frame in set(frames) & set(shift.frames):
            matrix = matrix_of(shift, model, at(shift, frame))
            homes[frame] = number(mean([matrix.at_home(row) for row in matrix.homes]))
        rows.append((f"{model}, here", *homes.values()))
    return titled_table(
        "The paper's figures beside these",
        "Not comparable in absolute value: the paper's unit, averaging, masses, noise and test "
        "part are not stated, its figures are of the set that steered training, and its values "
        "at t = 1 are far above constant velocity's in metres. What can be compared is the order "
        "of the models (rank agreement) and the growth with t, but for what cannot be right as "
        "printed (*: less than at an earlier t, or copied). Here: mean over single-engine "
        "trainings at home [m²]",
        ("", *(f"t = {frame}" for frame in frames)),
        rows,
    )
