"""The base class of everything that a scene is made of."""

from __future__ import annotations

from typing import Any, dataclass_transform

import msgspec
import numpy as np


@dataclass_transform(frozen_default=True, field_specifiers=(msgspec.field,))
class _TakesLists(msgspec.StructMeta):
    """Lets values be given as lists or arrays: a scene is hashed, so it holds tuples."""

    def __call__(cls, *values: Any, **named: Any) -> Any:
        return super().__call__(
            *map(_hashable, values), **{key: _hashable(value) for key, value in named.items()}
        )


class Neutral(
    msgspec.Struct,
    metaclass=_TakesLists,
    frozen=True,
    forbid_unknown_fields=True,
    omit_defaults=True,
):
    """A frozen table of a scene file; lists and arrays that it is given become tuples."""


def _hashable(value: Any) -> Any:
    plain = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    return tuple(map(_hashable, plain)) if isinstance(plain, list | tuple) else plain
