"""Paired bootstrap over trajectories and, below it, over seeds."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

__all__ = ["DRAWS", "Resampler", "bounds_of"]

Array = NDArray[np.float64]

DRAWS = 1000
_LEVEL = 0.95
_SEED = 20240607


class Resampler:
    """Draws the same trajectories for every model and domain: what they share cancels.

    Runs of a seed share first weights and the order of windows, whatever they are trained on: seeds
    are drawn together, too.
    """

    def __init__(self, trajectories: int, *, draws: int = DRAWS, seed: int = _SEED) -> None:
        self._draws, self._seed = draws, seed
        self._weights = _weights(np.random.default_rng([seed]), draws, trajectories)

    def means(self, errors: Array, runs: str) -> Array:
        """Give resampled means.

        Args:
            errors: Shape (seed, trajectory, frame), finite.
            runs: Name of what the seeds are of; the same name draws the same seeds.

        Returns:
            Shape (draw, frame).
        """
        rng = np.random.default_rng([self._seed, zlib.crc32(runs.encode())])
        seeds = _weights(rng, self._draws, len(errors))
        each = np.einsum("dt,stf->dsf", self._weights, errors, optimize=True)
        return np.einsum("ds,dsf->df", seeds, each)


def bounds_of(draws: Array) -> tuple[Array, Array]:
    """Central 95 % of draws, frame by frame; not a number where a draw is none."""
    tail = 0.5 * (1.0 - _LEVEL)
    low, high = np.quantile(draws, [tail, 1.0 - tail], axis=0)
    return low, high


def _weights(rng: np.random.Generator, draws: int, count: int) -> Array:
    return np.asarray(rng.multinomial(count, np.full(count, 1.0 / count), draws) / count)
