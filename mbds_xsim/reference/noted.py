"""Named tuples of arrays that compiled kernels pass by reference.

By value, as numba passes them, a call hands over hundreds of addresses and lengths, which takes
long to compile and to run. Fields of such a tuple never change; elements of its arrays may.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr, signature
from numba.extending import intrinsic, models, register_model


class Noted(types.Type):
    """Numba type of a reference to a named tuple."""

    def __init__(self, inner: Any) -> None:
        self.inner = inner
        super().__init__(name=f"Noted({inner})")

    def field(self, name: str) -> Any:
        """Return the type of a field; for a named tuple this is a reference, too."""
        kind = self.inner[self.inner.fields.index(name)]
        return Noted(kind) if isinstance(kind, types.BaseNamedTuple) else kind


@register_model(Noted)
class _NotedModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, manager.lookup(kind.inner).get_value_type().as_pointer())


@intrinsic
def noted(typing: Any, kind: Any) -> Any:  # noqa: ARG001
    """Put a named tuple into memory while the calling kernel runs, and return a reference to it."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:  # noqa: ARG001
        return cgutils.alloca_once_value(builder, args[0])

    return signature(Noted(kind), kind), generate


@infer_getattr
class _NotedFields(AttributeTemplate):
    key = Noted

    def generic_resolve(self, kind: Any, name: str) -> Any:
        return kind.field(name) if name in kind.inner.fields else None


@lower_getattr_generic(Noted)
def _field(context: Any, builder: Any, kind: Any, place: Any, name: str) -> Any:  # noqa: ARG001
    at = cgutils.gep_inbounds(builder, place, 0, kind.inner.fields.index(name))
    return at if isinstance(kind.field(name), Noted) else _loaded(builder, at)


def _loaded(builder: Any, place: Any) -> Any:
    """Load a value that never changes number by number, so that unused numbers are left out."""
    kind = place.type.pointee
    if not isinstance(kind, ir.Aggregate):
        value = builder.load(place)
        value.set_metadata("invariant.load", builder.module.add_metadata([]))
        return value
    whole = ir.Constant(kind, ir.Undefined)
    for k in range(len(kind)):
        part = _loaded(builder, cgutils.gep_inbounds(builder, place, 0, k))
        whole = builder.insert_value(whole, part, k)
    return whole
