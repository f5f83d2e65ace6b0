"""Report of a shift study: the answers, then errors by training and test domain, and rollouts.

Rollouts over the truth are packed for the viewer in the page, or drawn as a picture.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.base.text import counted, in_figure
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.learn.shift.study import SampleRollout, Samples
from mbds_xsim.report import blocks, themed
from mbds_xsim.report.blocks import PAGE, Figure, FigureGroup, Section, Text, chart, plots
from mbds_xsim.report.motion import packed
from mbds_xsim.report.themed import LIGHT, Style, model_style
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.studies.shift import figures
from mbds_xsim.studies.shift.tables import tables
from mbds_xsim.studies.shift.worth import SIZE, draw_worth, has_costs, worth_section

_ENOUGH = 3  # seeds
_ABREAST = 2  # heat maps: more would be too small to read on a page
_CURVES = (6.6, 3.4)


def present(shift: Shift, samples: Samples | None = None, *, played: bool = False) -> blocks.Report:
    """Report which models survive a change of engine.

    Args:
        shift: The study.
        samples: Rollouts to show; without them the page has neither maps nor curves.
        played: Whether the page's only viewer plays this scene's motions.
    """
    before = f", {shift.kept} of {len(shift.models)} models tested before" if shift.kept else ""
    answer = shift.answers[0].answer if shift.answers else "nothing can be told"
    return blocks.Report(
        title=shift.scene,
        what="learned models under a change of engine",
        description=shift.description,
        conclusion=answer,
        blocks=tuple(_blocks(shift, samples, played=played)),
        command=shift.command,
        made=f"{shift.machine}, in {shift.wall_s:.0f} s{before}",
    )


def _blocks(shift: Shift, samples: Samples | None, *, played: bool) -> Iterator[blocks.Block]:
    yield Text(protocol(shift))
    change = _change(shift) if shift.interactions else ()
    models = figures.trained_models(shift)
    worth = worth_section(shift) if has_costs(shift) else ()
    yield from (*worth, *change) if shift.harms else (*change, *worth)
    yield blocks.Remarks.of(answers(shift))
    if samples is not None:
        yield from _figures(shift, samples, played=played)
    few = len(models) + 2 * (bool(shift.interactions) + bool(shift.after_contact))
    for place, table in enumerate(tables(shift)):
        shown = replace(table, folded=place > 0)
        yield shown if place < few else Section("", (shown,), on=blocks.WRITTEN)


def answers(shift: Shift) -> Iterator[tuple[str, str]]:
    """Yield the questions with their answers, then what was left out and why."""
    yield from ((answer.question, f"{answer.answer}.") for answer in shift.answers)
    names: dict[str, list[str]] = {}
    for name, reason in shift.left_out.items():
        names.setdefault(reason, []).append(name)
    yield from ((f"{', '.join(those)} left out", f"{why}.") for why, those in names.items())


def protocol(shift: Shift) -> str:
    """Describe the protocol of the study."""
    profiles = ", ".join(sorted({m.profile for m in shift.models if m.profile})) or "not stated"
    steps = sorted({m.steps for m in shift.models if m.steps})
    ends = sorted({*steps[:1], *steps[-1:]})
    budget = f", {' to '.join(map(str, ends))} steps" if ends else ""
    budget += _training_sizes(shift)
    with_bodies = sorted({m.model for m in shift.models if m.bodies})
    bodies = f" ({', '.join(with_bodies)}: the bodies' states, too)" if with_bodies else ""
    tested = counted(len(shift.index), "trajectory")
    starts = {k % len(INTERVALS) for k in shift.index}
    if len(starts) < len(INTERVALS):
        tested += f" of {' and '.join(INTERVALS[k] for k in sorted(starts))} starts alone"
    return (
        f"Tested on {tested} that all {len(shift.domains)} domains (engines "
        f"at given settings) share, from the same starts and inputs. A model is shown the first "
        f"{shift.history} frames of the test domain{bodies} and predicts the next {shift.horizon}, "
        f"of {shift.frame_s:g} s each. "
        f"{_seeds(shift)}; "
        f"profile {profiles}{budget}; random forces {'act' if shift.noise else 'do not act'} and "
        "are never told to a model"
    )


def _seeds(shift: Shift) -> str:
    """Name the seeds, the models that have fewer of them, and whether the fewest are too few."""
    trained = [facts for facts in shift.models if facts.engines]
    every = sorted({facts.seed for facts in trained})
    each = {
        model: sorted({facts.seed for facts in trained if facts.model == model})
        for model in dict.fromkeys(facts.model for facts in trained)
    }
    fewer = [
        f"of {model} {', '.join(map(str, own))} alone"
        for model, own in each.items()
        if own != every
    ]
    named = f" ({'; '.join(fewer)})" if fewer else ""
    enough = min(map(len, each.values()), default=0) >= _ENOUGH
    few = "" if enough else ", too few to tell of other runs of the same trainings"
    return f"Seeds {', '.join(map(str, every))}{named}{few}"


def _training_sizes(shift: Shift) -> str:
    """State how many trajectories trainings on one engine learned from, as data sets differ."""
    variants = dict[int, list[str]]()
    for facts in shift.models:
        variant = facts.training.rpartition("-")[2]
        if len(facts.engines) == 1 and not facts.interval and facts.trajectories:
            variants.setdefault(facts.trajectories, []).append(variant)
    each = [f"{n} ({', '.join(sorted({*variants[n]}))})" for n in sorted(variants, reverse=True)]
    return f", trained on {' and '.join(each)} trajectories" if each else ""


def _change(shift: Shift) -> Iterator[Section]:
    """Yield the section with the picture to look at first: the costs of changes."""
    text = (
        "How many times the squared error grows where a model was trained on one's data and is "
        "tested on the other's, both ways together; the luck of single trainings and how hard data "
        "are cancel. Framed: significant."
    )
    title = f"What a change of engine, or of its settings, costs, t = {shift.at}"
    draw = partial(figures.draw_interactions, shift=shift)
    return plots(title, [chart(title, draw, figures.interactions_size(shift))], text)


def _figures(shift: Shift, samples: Samples, *, played: bool) -> Iterator[Section]:
    maps = [
        Section(f"t = {frame}", (_maps(shift, frame),), folded=True, opened=frame == shift.at)
        for frame in shift.frames
    ]
    text = (
        "Mean squared position error [m²], mean over seeds; rows: trained on, columns: tested on; "
        "bold: at home. Colours are logarithmic, the same for all models."
    )
    yield Section("Error by training and test domain", (Text(text), *maps), on=PAGE)
    rollouts = tuple(_rollouts(shift, samples, played=played))
    yield Section("Rollouts over the truth", rollouts, on=PAGE)
    curves = [
        Section(model, (_curves(shift, model),), folded=True, opened=not k)
        for k, model in enumerate(figures.trained_models(shift))
    ]
    text = (
        "Medians over trajectories; a line a seed, thick at home. The band is the other engines, "
        "going on from the same frame."
    )
    yield Section("Error over time", (Text(text), *curves), on=PAGE)


def _rollouts(shift: Shift, samples: Samples, *, played: bool) -> Iterator[blocks.Block]:
    yield Text(
        f"On {samples.domain.name}, a trajectory of each interval, from the last known frame on; "
        "first seeds. A colour a model, dashed where it was trained on the engine furthest from "
        "this one."
    )
    draw = partial(draw_samples, samples=samples)
    yield FigureGroup((Figure("rollouts over the truth", draw, picture_size(samples), wide=True),))
    if played:
        entries = zip(map(name_of, samples.models), styles_of(samples), strict=True)
        yield blocks.Motion(pack(samples), "truth", tuple(entries))
    else:
        yield Text(f"A page of this scene alone (--scene {shift.scene}) has the motions to play.")


def _maps(shift: Shift, frame: int) -> FigureGroup:
    """Draw a heat map for each model, on one scale of colours."""
    matrices = figures.maps_at(shift, frame)
    spread, drawn = figures.spread_of(matrices), []
    for matrix in matrices:
        title = f"{matrix.model}, t = {frame}"
        draw = partial(figures.draw_matrix, matrix=matrix, spread=spread, title=title)
        drawn.append(chart(title, draw, figures.map_size(matrix)))
    return FigureGroup(tuple(drawn), least=560)


def _curves(shift: Shift, model: str) -> FigureGroup:
    """Draw a model's errors over time, a figure for each domain."""

    def draw(axes: Any, test: str) -> None:
        figures.draw_curves(axes, shift, model, test)
        axes.figure.legend(loc="outside right upper", fontsize=7, frameon=False)

    tests = [d.name for d in shift.domains if figures.curves_of(shift, model, d.name)]
    drawn = (
        chart(f"{model} on {test}: error over time", partial(draw, test=test), _CURVES)
        for test in tests
    )
    return FigureGroup(tuple(drawn), least=560)


def to_png(studies: Sequence[Shift], stored: bytes = b"") -> bytes:
    """Return a PNG with a block for each study: harms if all can be drawn, else costs, else errors.

    `stored` is the JSON behind it.
    """
    if all(shift.harms and has_costs(shift) for shift in studies):
        worths = [(partial(_draw_worth, shift=shift), SIZE) for shift in studies]
        return themed.stacked(worths, stored)
    if all(shift.interactions for shift in studies):
        sizes = map(figures.interactions_size, studies)
        costs = [
            (partial(_draw_costs, shift=shift), (max(width, 6.0), height))
            for shift, (width, height) in zip(studies, sizes, strict=True)
        ]
        return themed.stacked(costs, stored)
    columns, parts = min(_ABREAST, max(len(figures.trained_models(shift)) for shift in studies)), []
    for shift in studies:
        models = figures.trained_models(shift)
        rows = math.ceil(len(models) / columns)
        matrix = figures.matrix_of(shift, models[0], figures.at(shift, shift.at))
        width, height = figures.map_size(matrix)
        draw = partial(_draw_block, shift=shift, shape=(rows, columns))
        parts.append((draw, (columns * width, rows * height)))
    return themed.stacked(parts, stored)


def _draw_worth(figure: Any, shift: Shift) -> None:
    draw_worth(figure, shift)
    subject = "what data cost, how good they are, and what is learned from them (full: they harm)"
    _put_title(figure, shift, subject)


def _draw_costs(figure: Any, shift: Shift) -> None:
    figures.draw_interactions(figure.subplots(), shift)
    _put_title(figure, shift, f"what a change of engine or settings costs at t = {shift.at}")


def _draw_block(figure: Any, shift: Shift, shape: tuple[int, int]) -> None:
    maps = figures.maps_at(shift, shift.at)
    charts = figure.subplots(*shape, squeeze=False).ravel()
    for axes, matrix in zip(charts, maps, strict=False):
        figures.draw_matrix(axes, matrix, figures.spread_of(maps), matrix.model)
    for axes in charts[len(maps) :]:
        axes.set_axis_off()
    subject = f"mean squared position error at t = {shift.at} [m²]"
    _put_title(figure, shift, f"{subject}; rows: trained on, columns: tested on")


def _put_title(figure: Any, shift: Shift, subject: str) -> None:
    figure.suptitle(f"{in_figure(shift.scene)}: {subject}", fontsize=11, x=0.01, ha="left")


_ROOM = 0.6  # half the side of a chart over the truth's extent
_SHOTS = 5  # frames shown in a picture
_PICTURE = (11.0, 2.1, 0.4)  # width, height per trajectory, height of titles [in]
_LEGEND = 0.2, 3  # height of a row of the legend [in], number of columns


def name_of(sample: SampleRollout) -> str:
    """Name a rollout by its model and training."""
    return f"{sample.model}, trained on {sample.training}"


def styles_of(samples: Samples) -> tuple[Style, ...]:
    """Return the rollouts' styles: the model's colour, dashed if trained on another domain."""
    home = samples.domain.name
    return tuple(model_style(s.model, dashed=s.training != home) for s in samples.models)


def pack(samples: Samples) -> dict[str, Any]:
    """Return the viewer's data, ready for JSON."""
    graph, truth = samples.evaluation.test.graph, samples.truth
    motions = [("truth", truth), *((name_of(s), s.position) for s in samples.models)]
    entries = (
        # Root mean square distance of the particles, frame by frame.
        (name, style, motion, np.sqrt(((motion - truth) ** 2).sum(-1).mean(-1)))
        for (name, motion), style in zip(motions, (None, *styles_of(samples)), strict=True)
    )
    return packed(entries, truth, graph.length, graph.frame_s) | {
        "trajectories": [
            {"index": int(k), "label": f"{k} ({INTERVALS[int(k) % len(INTERVALS)]})"}
            for k in samples.index
        ],
        "left_out": 0,
        "points": graph.particle_count,
        "radius": [0.0] * graph.particle_count,
        "fixed": graph.anchor_positions.tolist(),
        "edges": _edges(graph).tolist(),
        "ground": graph.ground,
        "dimension": samples.evaluation.test.scene.dimension,
    }


def picture_size(samples: Samples) -> tuple[float, float]:
    """Return width and height of a picture [in]."""
    (width, each, titles), (height, columns) = _PICTURE, _LEGEND
    rows = math.ceil((1 + len(samples.models)) / columns)
    return width, each * len(samples.index) + titles + height * rows


def samples_png(studies: Sequence[Samples]) -> bytes:
    """Return a PNG of the rollouts of all studies, one below the other."""

    def draw(figure: Any, samples: Samples) -> None:
        draw_samples(figure, samples)
        if len(studies) > 1:
            name = in_figure(samples.evaluation.test.scene.name)
            figure.suptitle(name, fontsize=10, x=0.01, ha="left")

    return themed.stacked([(partial(draw, samples=each), picture_size(each)) for each in studies])


def draw_samples(figure: Any, samples: Samples) -> None:
    """Draw x and z of the particles: one row per trajectory, a few frames from left to right."""
    graph = samples.evaluation.test.graph
    shots = np.linspace(0, samples.truth.shape[1] - 1, _SHOTS).round().astype(int)
    charts = figure.subplots(len(samples.index), _SHOTS, squeeze=False)
    motions = [(samples.truth, themed.INK, "-", "truth", 3.0)]
    for sample, style in zip(samples.models, styles_of(samples), strict=True):
        line = "--" if style.dashed else "-"
        motions.append((sample.position, LIGHT[style.colour], line, name_of(sample), 1.3))
    fixed, edges = graph.anchor_positions.numpy(), _edges(graph)
    for row, number in enumerate(samples.index.tolist()):
        # The truth's whole motion is in view, however far a rollout goes.
        points = np.concatenate([samples.truth[row].reshape(-1, 3), fixed])
        low, high = points.min(axis=0), points.max(axis=0)
        middle, half = 0.5 * (low + high), _ROOM * max(float((high - low).max()), 1e-3)
        for axes, shot in zip(charts[row], shots, strict=True):
            for position, colour, line, label, width in motions:
                nodes = np.concatenate([position[row, shot], fixed])
                look = {"color": colour, "ls": line, "lw": width, "alpha": 0.85}
                _draw_nodes(axes, edges, nodes, look)
                axes.plot([], [], label=label, **look)
            across, upwards = ((x - half, x + half) for x in middle[[0, 2]])
            axes.set(xlim=across, ylim=upwards, aspect="equal")
            axes.tick_params(labelsize=7)
            if not row:
                axes.set_title(f"t = {shot}", fontsize=9)
        charts[row, 0].set_ylabel(f"trajectory {number}: z [m]")
    figure.legend(
        *charts[0, 0].get_legend_handles_labels(),
        loc="outside lower center", ncols=_LEGEND[1], fontsize=8, frameon=False,
    )  # fmt: skip


def _draw_nodes(axes: Any, edges: Index, nodes: Array, look: dict[str, Any]) -> None:
    for one, two in edges:
        axes.plot(nodes[[one, two], 0], nodes[[one, two], 2], **look)
    loose = np.setdiff1d(np.arange(len(nodes)), edges)
    hollow = {} if look["ls"] == "-" else {"mfc": "none"}  # for dashed lines
    axes.plot(nodes[loose, 0], nodes[loose, 2], "o", ms=4, **{**look, "lw": 0.0}, **hollow)


def _edges(graph: Graph) -> Index:
    """Return the pairs of connected nodes, each once, shape (edge, 2)."""
    edges = np.stack([graph.senders.numpy(), graph.receivers.numpy()], axis=1)
    return edges[edges[:, 0] < edges[:, 1]]
