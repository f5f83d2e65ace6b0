"""Rollouts over the truth: packed for the viewer in the page, and as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.base.safe_text import in_figure
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.shift.study import SampleRollout, Samples
from mbds_xsim.report import themed
from mbds_xsim.report.animation import encoded, packed_base, packed_entry
from mbds_xsim.report.palette import LIGHT, Style, model_style
from mbds_xsim.scene.sampling_terms import INTERVALS

_REACH = 4.0
"""A point further from the truth than this many times the motion's extent has left the view."""
_ROOM = 0.6  # half a side of a picture, of the truth's extent
_SHOTS = 5  # frames of a picture
_PICTURE = (11.0, 2.1, 0.6)  # width, height a trajectory, height of the legend [in]


def name_of(sample: SampleRollout) -> str:
    """How a rollout is told from the others."""
    return f"{sample.model}, trained on {sample.training}"


def styles_of(samples: Samples) -> tuple[Style, ...]:
    """A colour a model; dashed where it was trained elsewhere."""
    return tuple(model_style(s.model, dashed=not s.at_home) for s in samples.models)


def pack(samples: Samples) -> dict[str, Any]:
    """Give what the viewer reads, ready for JSON."""
    graph, truth = samples.evaluation.test.graph, samples.truth
    low, high = truth.min(axis=(0, 1, 2)), truth.max(axis=(0, 1, 2))
    reach = _REACH * max(float(np.linalg.norm(high - low)), graph.length)
    styles = (None, *styles_of(samples))
    motions = [("truth", truth), *((name_of(s), s.position) for s in samples.models)]
    return {
        "frames": truth.shape[1],
        "step": graph.frame_s,
        "low": low.tolist(),
        "high": high.tolist(),
        "base": packed_base(truth, low, high),
        "reach": reach,
        "entries": [
            packed_entry(name, style, motion, truth, reach)
            # Root mean square distance of the particles, frame by frame.
            | {"error": encoded(np.sqrt(((motion - truth) ** 2).sum(-1).mean(-1)), "<f4")}
            for (name, motion), style in zip(motions, styles, strict=True)
        ],
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
    """Width and height of a picture [in]."""
    width, each, legend = _PICTURE
    return width, each * len(samples.index) + legend


def samples_png(studies: Sequence[Samples]) -> bytes:
    """Give the pictures of all studies, one below the other."""
    sizes = [picture_size(samples) for samples in studies]
    heights = [height for _, height in sizes]

    def draw(figure: Any) -> None:
        blocks = figure.subfigures(len(studies), 1, squeeze=False, height_ratios=heights)
        for block, samples in zip(blocks[:, 0], studies, strict=True):
            draw_samples(block, samples)
            if len(studies) > 1:
                block.suptitle(
                    in_figure(samples.evaluation.test.scene.name), fontsize=10, x=0.01, ha="left"
                )

    return themed.png(draw, (sizes[0][0], sum(heights)))


def draw_samples(figure: Any, samples: Samples) -> None:
    """Draw x and z of the particles: a row a trajectory, a few frames from left to right."""
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
            axes.set_xlim(middle[0] - half, middle[0] + half)
            axes.set_ylim(middle[2] - half, middle[2] + half)
            axes.set_aspect("equal")
            axes.tick_params(labelsize=7)
            if not row:
                axes.set_title(f"t = {shot}", fontsize=9)
        charts[row, 0].set_ylabel(f"trajectory {number}: z [m]")
    figure.legend(
        *charts[0, 0].get_legend_handles_labels(),
        loc="outside lower center", ncols=3, fontsize=8, frameon=False,
    )  # fmt: skip


def _draw_nodes(axes: Any, edges: Index, nodes: Array, look: dict[str, Any]) -> None:
    for one, two in edges:
        axes.plot(nodes[[one, two], 0], nodes[[one, two], 2], **look)
    loose = np.setdiff1d(np.arange(len(nodes)), edges)
    hollow = {} if look["ls"] == "-" else {"mfc": "none"}  # as dashed lines are
    axes.plot(nodes[loose, 0], nodes[loose, 2], "o", ms=4, **{**look, "lw": 0.0}, **hollow)


def _edges(graph: Graph) -> Index:
    """Pairs of nodes, each once, shape (edge, 2)."""
    edges = np.stack([graph.senders.numpy(), graph.receivers.numpy()], axis=1)
    return edges[edges[:, 0] < edges[:, 1]]
