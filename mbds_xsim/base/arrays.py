"""Array types; docstrings state the shapes."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]
