"""The motions of a validation, packed for the viewer on its page."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.measure.result import EngineResult, Evidence
from mbds_xsim.report.animation import encoded, packed_base, packed_entry
from mbds_xsim.report.palette import Style, engine_style
from mbds_xsim.report.skeleton import Skeleton, skeleton

_DASHED = {"native"}

_BYTES = 3_000_000
"""What the positions may take before base64."""
_LARGEST_STRIDE = 4
_REACH = 4.0
"""A point further from the base than this many times the motion's extent has left the view."""


def styles(results: Iterable[EngineResult]) -> tuple[Style, ...]:
    """Give the results of engines their styles."""
    listed = list(results)
    others = [result.engine for result in listed]
    return tuple(engine_style(r.engine, others, dashed=r.profile in _DASHED) for r in listed)


def pack(
    evidence: Evidence, names: tuple[str, ...], styles: tuple[Style, ...], *, limit: int = _BYTES
) -> dict[str, Any]:
    """Give what the viewer reads, ready for JSON.

    Args:
        evidence: Motions of the engines and the reference.
        names: Of the engine results.
        styles: Of the engine results.
        limit: Bytes that positions may take; frames are thinned out, then trajectories left out.
    """
    bones = skeleton(evidence.scene)
    stride, count = _thinning(evidence, len(bones.body), limit)
    motions = [
        None if motion is None else bones.positions(motion[:count])[:, ::stride]
        for motion in (evidence.reference, *evidence.trajectories)
    ]
    base = _base([motion for motion in motions if motion is not None])
    low, high = base.min(axis=(0, 1, 2)), base.max(axis=(0, 1, 2))
    size = max(float(np.linalg.norm(high - low)), evidence.scene.length)
    reach = _REACH * size
    errors = (None, *evidence.errors)
    entries = [
        packed_entry(name, style, motion, base, reach)
        | {"error": None if error is None else encoded(error[:count, ::stride], "<f4")}
        for name, style, motion, error in zip(
            ("reference", *names), (None, *styles), motions, errors, strict=True
        )
        if motion is not None
    ]
    return _scenery(evidence, bones, count) | {
        "frames": base.shape[1],
        "step": float(evidence.reference.time[1] - evidence.reference.time[0]) * stride,
        "low": low.tolist(),
        "high": high.tolist(),
        "base": packed_base(base, low, high),
        "reach": reach,
        "entries": entries,
    }


def _thinning(evidence: Evidence, points: int, limit: int) -> tuple[int, int]:
    """Stride over frames and number of trajectories that keep to the limit."""
    count, frames = evidence.reference.position.shape[:2]
    streams = 1 + sum(motion is not None for motion in evidence.trajectories)
    frame_bytes = streams * points * 3 * 2
    wanted = -(-count * frames * frame_bytes // limit)
    stride = min(max(1, wanted), _LARGEST_STRIDE, max(1, frames - 1))
    fitting = limit // (frame_bytes * -(-frames // stride))
    return stride, max(1, min(count, fitting))


def _base(motions: list[Array]) -> Array:
    """Take the first motion that is finite, frame by frame; where none is, the last that was."""
    base = motions[0].copy()
    for motion in motions[1:]:
        base = np.where(_finite(base)[..., None, None], base, motion)
    for frame in range(1, base.shape[1]):
        gone = ~_finite(base[:, frame])
        base[gone, frame] = base[gone, frame - 1]
    return np.nan_to_num(base)


def _finite(positions: Array) -> Mask:
    return np.asarray(np.isfinite(positions).all(axis=(-1, -2)))


def _scenery(evidence: Evidence, bones: Skeleton, count: int) -> dict[str, Any]:
    batch = evidence.batch
    return {
        "trajectories": [
            {"index": int(batch.index[row]), "label": batch.label(row).removeprefix("trajectory ")}
            for row in range(count)
        ],
        "left_out": len(evidence.reference) - count,
        "points": len(bones.body),
        "radius": bones.radius.tolist(),
        "fixed": bones.fixed.tolist(),
        "edges": bones.edges,
        "ground": evidence.scene.ground is not None,
        "dimension": evidence.scene.dimension,
    }
