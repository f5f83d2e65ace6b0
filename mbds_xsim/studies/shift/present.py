"""A shift study as a report: the answers, then errors by training and test domain."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.learn.shift.study import Samples
from mbds_xsim.report.blocks import (
    EVERYWHERE,
    Block,
    Figure,
    Figures,
    Motion,
    Place,
    Remarks,
    Report,
    Section,
    Text,
)
from mbds_xsim.studies.shift.figures import curves_of, draw_curves, draw_matrix, map_size, spread_of
from mbds_xsim.studies.shift.matrix import maps_at, trained_models
from mbds_xsim.studies.shift.motion import draw_samples, name_of, pack, picture_size, styles_of
from mbds_xsim.studies.shift.tables import tables

_ENOUGH = 3  # seeds
_CURVES = (6.6, 3.4)
_PAGE: frozenset[Place] = frozenset({"page"})
_BESIDE = EVERYWHERE - {"terminal"}


def present(
    shift: Shift, samples: Samples | None = None, *, played: bool = False, picture: str = ""
) -> Report:
    """Say which models survive a change of engine.

    Args:
        shift: The study.
        samples: Rollouts to show; without them the page has neither maps nor curves.
        played: Whether the page has this scene's motions: it has one viewer.
        picture: Link to the heat maps, for Markdown.
    """
    before = f", {shift.kept} of {len(shift.models)} models tested before" if shift.kept else ""
    answer = shift.answers[0].answer if shift.answers else "nothing can be told"
    return Report(
        title=shift.scene,
        what="learned models under a change of engine",
        description=shift.description,
        conclusion=answer,
        blocks=tuple(_blocks(shift, samples, played=played)),
        command=shift.command,
        made=f"{shift.machine}, in {shift.wall_s:.0f} s{before}",
        picture=picture,
    )


def _blocks(shift: Shift, samples: Samples | None, *, played: bool) -> Iterator[Block]:
    yield Text(protocol(shift))
    yield Remarks.of(answers(shift))
    if samples is not None:
        yield from _figures(shift, samples, played=played)
    few = len(trained_models(shift))
    for place, table in enumerate(tables(shift)):
        shown = replace(table, folded=place > 0)
        yield shown if place < few else Section("", (shown,), on=_BESIDE)


def answers(shift: Shift) -> Iterator[tuple[str, str]]:
    """Give the questions with their answers, and what was left out."""
    yield from ((answer.question, f"{answer.answer}.") for answer in shift.answers)
    yield from ((f"{name} left out", f"{reason}.") for name, reason in shift.left_out.items())


def protocol(shift: Shift) -> str:
    """Say what was done, in a line."""
    seeds = sorted({m.seed for m in shift.models if m.engines})
    profiles = ", ".join(sorted({m.profile for m in shift.models if m.profile})) or "not stated"
    steps = sorted({m.steps for m in shift.models if m.steps})
    ends = sorted({*steps[:1], *steps[-1:]})
    budget = f", {' to '.join(map(str, ends))} steps" if ends else ""
    few = "" if len(seeds) >= _ENOUGH else ", too few to tell of other runs of the same trainings"
    told = sorted({m.model for m in shift.models if m.bodies})
    bodies = f", to {' and '.join(told)} with the bodies' states" if told else ""
    return (
        f"{len(shift.index)} test trajectories that all {len(shift.domains)} domains share, from "
        f"the same starts and inputs; the first {shift.history} frames are the test domain's own"
        f"{bodies}, then {shift.horizon} frames of {shift.frame_s:g} s are predicted. "
        f"Seeds {', '.join(map(str, seeds))}{few}; "
        f"profile {profiles}{budget}; random forces {'act' if shift.noise else 'do not act'} and "
        "are never told to a model"
    )


def _figures(shift: Shift, samples: Samples, *, played: bool) -> Iterator[Section]:
    maps = [
        Section(f"t = {frame}", (_maps(shift, frame),), folded=True, opened=frame == shift.at)
        for frame in shift.frames
    ]
    told = (
        "Mean squared position error [m²], mean over seeds; rows: trained on, columns: tested on; "
        "bold: at home. Colours are logarithmic, the same for all models."
    )
    yield Section("Error by training and test domain", (Text(told), *maps), on=_PAGE)
    yield Section(
        "Rollouts over the truth", tuple(_rollouts(shift, samples, played=played)), on=_PAGE
    )
    curves = [
        Section(model, (_curves(shift, model),), folded=True, opened=not k)
        for k, model in enumerate(trained_models(shift))
    ]
    told = (
        "Medians over trajectories; a line a seed, thick at home. The band is the other engines, "
        "going on from the same frame."
    )
    yield Section("Error over time", (Text(told), *curves), on=_PAGE)


def _rollouts(shift: Shift, samples: Samples, *, played: bool) -> Iterator[Block]:
    yield Text(
        f"On {samples.domain.name}, a trajectory of each interval, from the last known frame on; "
        "first seeds. A colour a model, dashed where it was trained on the engine furthest from "
        "this one."
    )

    def draw(figure: Any) -> None:
        draw_samples(figure, samples)

    yield Figures((Figure("rollouts over the truth", draw, picture_size(samples), wide=True),))
    if played:
        names = map(name_of, samples.models)
        yield Motion(pack(samples), "truth", tuple(zip(names, styles_of(samples), strict=True)))
    else:
        yield Text(f"A page of this scene alone (--scene {shift.scene}) has the motions to play.")


def _maps(shift: Shift, frame: int) -> Figures:
    """A heat map a model, on one scale of colours."""
    matrices = maps_at(shift, frame)
    spread = spread_of(matrices)
    drawn = []
    for matrix in matrices:
        title = f"{matrix.model}, t = {frame}"

        def draw(figure: Any, matrix: Any = matrix, title: str = title) -> None:
            axes = figure.subplots()
            draw_matrix(axes, matrix, spread)
            axes.set_title(title, fontsize=10, loc="left")

        drawn.append(Figure(title, draw, map_size(matrix)))
    return Figures(tuple(drawn), least=560)


def _curves(shift: Shift, model: str) -> Figures:
    """Errors over time on all engines' domains."""
    drawn = []
    for test in [domain.name for domain in shift.domains if curves_of(shift, model, domain.name)]:

        def draw(figure: Any, test: str = test) -> None:
            draw_curves(figure.subplots(), shift, model, test)
            figure.legend(loc="outside right upper", fontsize=7, frameon=False)

        drawn.append(Figure(f"{model} on {test}: error over time", draw, _CURVES))
    return Figures(tuple(drawn), least=560)
