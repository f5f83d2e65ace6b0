"""The trajectories that are held against the reference too, which costs too much for all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import reference
from mbds_xsim.checks import Finding, agreement
from mbds_xsim.judge import error_findings
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Trajectory

__all__ = ["AUDIT_SAMPLE", "sample_findings", "sampled"]

_EVERY = 15_000
_COUNT = 3  # one of each interval

AUDIT_SAMPLE = f"index mod {_EVERY} < {_COUNT}"
"""As the files say it."""


def sampled(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of the trajectories of the sample."""
    return np.flatnonzero(index % _EVERY < _COUNT)


def sample_findings(scene: Scene, batch: Batch, trajectory: Trajectory) -> list[Finding]:
    """Hold trajectories against the reference, as `mbds-xsim validate` does."""
    # Stored solutions would save time but not be the same to the last bit.
    truth = reference.solve(scene, batch, cache=False)
    growth = reference.sensitivity(scene, batch, cache=False)
    growth[~np.isfinite(truth.position).all(axis=(2, 3))] = np.nan
    error = agreement.particle_error(Mechanism.of(scene), trajectory, truth)
    return error_findings(scene, batch, error, truth, growth)
