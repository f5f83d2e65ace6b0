"""How far a motion is from its method's own limit, where there is no motion to hold it against.

To be near it says nothing of the truth: engines converge to different motions where contact has no
unique solution. To be far from it is to be wrong whatever is true.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mbds_xsim.campaign import ReferenceOutcome
from mbds_xsim.checks import Finding, agreement
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.scene import Scene
from mbds_xsim.state import Trajectory

__all__ = ["is_unknown", "own_limit"]

_INSTANT = 1.0  # of the budget [s]


def is_unknown(reference: ReferenceOutcome) -> bool:
    """Whether nothing is known of a motion after its start."""
    return not np.isfinite(reference.trajectory.position[:, 1:]).all(axis=(2, 3)).any()


def own_limit(
    scene: Scene,
    motion: Trajectory,
    step: float,
    sample: Sequence[int],
    others: Mapping[float, Trajectory],
) -> Finding:
    """Extrapolate a motion at 1 s, or its end before that, to a vanishing step.

    Contact makes every method one of the first order: with steps h and k·h the error of the longer
    one is k / (k − 1) times their distance, that of the shorter one 1 / (k − 1) times. The nearest
    shorter step is taken, or where there is none the nearest longer one.

    Args:
        scene: What was simulated.
        motion: At the step in question.
        step: That step [s].
        sample: Rows of the motion that ran at other steps too.
        others: The sample by step [s].

    Returns:
        RMS distance of the particles [m], against the scene's budget of the error at 1 s; 0 for
        rows beside the sample.
    """
    shorter = max((h for h in others if h < step), default=None)
    other = min(others) if shorter is None else shorter
    ratio = max(step, other) / min(step, other)
    apart = agreement.particle_error(Mechanism.of(scene), motion[list(sample)], others[other])
    share = apart * (1.0 if shorter is None else ratio) / (ratio - 1.0)
    frame = min(round(_INSTANT / scene.clock.frame), share.shape[1] - 1)
    series = np.full((*motion.position.shape[:2], 1), np.nan)
    series[:, frame] = 0.0
    series[list(sample), frame, 0] = np.where(np.isfinite(share), share, np.inf)[:, frame]
    budget = scene.budget.error_1s * scene.length
    return Finding.of("distance to its own limit", "m", series, budget=budget)
