"""Which trajectories are for training, validation and test: by index, the same in every engine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["NAMES", "split_of"]

NAMES = ("train", "validation", "test")
_OF = 15_000
_ENDS = (12_000, 13_500)  # the paper's 13 500 and 1 500; the last 1 500 of the former validate


def split_of(index: NDArray[np.int64], trajectories: int) -> NDArray[np.uint8]:
    """Give 0 train, 1 validation, 2 test; the first 80 %, the next 10 %, the rest.

    Args:
        index: Numbers of trajectories.
        trajectories: How many were drawn.
    """
    ends = [end * trajectories // _OF for end in _ENDS]
    return np.searchsorted(ends, index, side="right").astype(np.uint8)
