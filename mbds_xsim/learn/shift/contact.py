"""Horizons that are counted from the first contact.

Ten frames after the last known one most balls are still in the air, where engines differ only in
steps and damping. To see the effect of contact, frames are counted from its beginning: frame 1 is
the first at which a contact sphere has touched the ground, in whichever domain that is earliest.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.learn.particles import RolloutFigures
from mbds_xsim.learn.shift.domains import Paired
from mbds_xsim.learn.shift.evaluation import Evaluation
from mbds_xsim.learn.window import HISTORY
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene

_LEAST = 10
"""Least number of trajectories in a study from the first contact on, and of their frames."""


def first_contact(test: Paired, horizon: int) -> Index:
    """Return the predicted frame, counted from 0, of each trajectory's first ground contact.

    −1 if that is within the known frames, `horizon` if there is none.
    """
    mechanism, earliest = test.graph.mechanism, np.full(len(test.index), horizon)
    if not len(mechanism.sphere_radius):
        return earliest
    for domain in test.domains:
        body = domain.motions(torch.float64).body
        assert body is not None
        touches = _touches(test.scene, body[:, : HISTORY + horizon].numpy())
        first = np.where(touches.any(axis=1), touches.argmax(axis=1) - HISTORY, horizon)
        earliest = np.minimum(earliest, first)
    return np.maximum(earliest, -1)


def _touches(scene: Scene, states: Array) -> Mask:
    """Return whether a sphere is on the ground at a frame, or by free flight from the last one.

    A ball may bounce between two frames and be seen in the air at both.
    """
    mechanism, frame = Mechanism.of(scene), scene.clock.frame
    native = mechanism.native_rotation(states[..., 3:7])
    gap = mechanism.sphere_heights(states[..., :3], native) - mechanism.sphere_radius
    carrier = states[..., mechanism.sphere_body, :]
    arm = rotation.rotate(native[..., mechanism.sphere_body, :], mechanism.sphere_offset)
    rate = carrier[..., 9] + rotation.cross(carrier[..., 10:], arm)[..., 2]
    ahead = gap + frame * rate + 0.5 * frame**2 * scene.gravity[2]
    predicted = np.concatenate([gap[:, :1], ahead[:, :-1]], axis=1)
    return np.any(np.minimum(gap, predicted) <= 0.0, axis=-1)


def from_contact(evaluation: Evaluation) -> Evaluation | None:
    """Count frames from the first contact on, for trajectories that have it early enough.

    None if fewer than ten do, as without a ground, or if a body starts on it.
    """
    horizon = max(evaluation.frames)
    first = first_contact(evaluation.test, horizon)
    last = horizon - _LEAST
    rows = np.flatnonzero((first >= 0) & (first <= last))
    if len(rows) < _LEAST:
        return None
    length = horizon - int(first[rows].max())
    place = first[rows, None] + np.arange(length)

    def later(figures: RolloutFigures) -> RolloutFigures:
        own = {name: values[rows] for name, values in vars(figures).items()}
        # What was lost before the contact stays lost.
        own["error"] = np.where(evaluation.exploded(own["error"]), np.inf, own["error"])
        along = {k: np.take_along_axis(v, place, axis=1) for k, v in own.items() if v.ndim > 1}
        return RolloutFigures(**(own | along))

    return dataclasses.replace(
        evaluation,
        test=dataclasses.replace(evaluation.test, index=evaluation.test.index[rows]),
        frames=tuple(frame for frame in evaluation.frames if frame <= length),
        figures={key: later(figures) for key, figures in evaluation.figures.items()},
        oracles={key: later(figures) for key, figures in evaluation.oracles.items()},
        restarted={key: later(figures) for key, figures in evaluation.restarted.items()},
        floors={},
    )
