"""Array types; docstrings state the shapes."""

from dataclasses import replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]


class Picked:
    """Dataclass of arrays with the same first axes, and of numbers that belong to all of them."""

    def __getitem__(self, picks: Any) -> Self:
        """Select along the first axes of all arrays."""
        parts = {key: part for key, part in vars(self).items() if not isinstance(part, int | float)}
        return replace(self, **{key: part[picks] for key, part in parts.items()})  # type: ignore[type-var]
