"""Functions of lanes that become instructions where a kernel calls them.

numba types, lowers and compiles each function that a kernel calls, statement by statement. For a
product of vectors this takes far longer than to emit the dozen instructions that it needs. So a
plain Python function is called here with numbers that emit instructions: `a * b` of two such
numbers emits a multiplication.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import signature
from numba.extending import intrinsic

from mbds_xsim.reference.lanes import LANES, address, lanes, spread_over


@dataclass(frozen=True)
class Number:
    """A number, or eight, while a function is traced; without a builder only its type is known."""

    kind: Any
    builder: Any = None
    value: Any = None

    def __add__(self, other: Number | int) -> Number:
        return self._with(other, "add")

    def __sub__(self, other: Number) -> Number:
        return self._with(other, "sub")

    def __mul__(self, other: Number) -> Number:
        return self._with(other, "mul")

    def __truediv__(self, other: Number) -> Number:
        return self._with(other, "div")

    def __rsub__(self, other: float) -> Number:
        return self._of(other) - self

    def __rmul__(self, other: float) -> Number:
        return self._of(other) * self

    def __rtruediv__(self, other: float) -> Number:
        return self._of(other) / self

    def __neg__(self) -> Number:
        return Number(self.kind, self.builder, self.builder and self.builder.fneg(self.value))

    def _of(self, constant: float) -> Number:
        kind = types.float64 if self.kind is lanes else self.kind
        whole = ir.IntType(64) if kind == types.intp else ir.DoubleType()
        return Number(kind, self.builder, ir.Constant(whole, constant))

    def _with(self, other: Number | float, instruction: str) -> Number:
        if not isinstance(other, Number):
            other = self._of(other)
        kind = lanes if lanes in (self.kind, other.kind) else self.kind
        if self.builder is None:
            return Number(kind)
        one, two = (
            spread_over(self.builder, each.value) if kind is not each.kind else each.value
            for each in (self, other)
        )
        name = instruction if kind == types.intp else "f" + instruction
        return Number(kind, self.builder, getattr(self.builder, name)(one, two))


@dataclass(frozen=True)
class RowArray:
    """An array while a function is traced."""

    kind: Any
    context: Any = None
    builder: Any = None
    value: Any = None

    def row(self, at: Number, width: int = LANES) -> Number:
        """Read eight numbers, which are a row of an array of lanes, or start at any number."""
        if self.builder is None:
            return Number(lanes)
        place = address(self.context, self.builder, self.kind, self.value, at.value, width)
        return Number(lanes, self.builder, self.builder.load(place, align=8))

    def put(self, at: Number, number: Number, width: int = LANES) -> None:
        """Write eight numbers, as `row` reads them."""
        if self.builder is not None:
            place = address(self.context, self.builder, self.kind, self.value, at.value, width)
            self.builder.store(number.value, place, align=8)

    def __getitem__(self, at: tuple[Number, int]) -> Number:
        if self.builder is None:
            return Number(types.float64)
        row, column = at
        array = self.context.make_array(self.kind)(self.context, self.builder, self.value)
        indices = [row.value, self.context.get_constant(types.intp, column)]
        place = cgutils.get_item_pointer(self.context, self.builder, self.kind, array, indices)
        return Number(types.float64, self.builder, self.builder.load(place))


def traced(function: Callable[..., Any]) -> Any:
    """Let kernels call a function of numbers, tuples of numbers, and arrays."""

    def typed(typing: Any, *arguments: Any) -> Any:  # noqa: ARG001
        kinds = [types.intp if isinstance(kind, types.Integer) else kind for kind in arguments]
        result = _kind_of(function(*(_traceable(kind) for kind in kinds)))

        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            pairs = zip(sig.args, args, strict=True)
            output = function(*(_traceable(kind, context, builder, arg) for kind, arg in pairs))
            return _packed(context, builder, result, output)

        return signature(result, *kinds), generate

    # numba matches arguments to parameters by their names.
    first, _ = inspect.signature(typed).parameters.values()
    named = inspect.Signature([first, *inspect.signature(function).parameters.values()])
    typed.__signature__ = named  # type: ignore[attr-defined]
    wrapper = intrinsic(typed)
    # Traced functions call each other.
    own = {"__call__": lambda _, *arguments: function(*arguments)}
    wrapper.__class__ = type("Traced", (type(wrapper),), own)
    return wrapper


def _traceable(kind: Any, context: Any = None, builder: Any = None, value: Any = None) -> Any:
    if isinstance(kind, types.Array):
        return RowArray(kind, context, builder, value)
    if not isinstance(kind, types.BaseTuple):
        return Number(kind, builder, value)
    parts = [None] * len(kind) if builder is None else cgutils.unpack_tuple(builder, value)
    return tuple(Number(each, builder, part) for each, part in zip(kind, parts, strict=True))


def _kind_of(output: Any) -> Any:
    if isinstance(output, tuple):
        return types.Tuple([_kind_of(each) for each in output])
    return types.void if output is None else output.kind


def _packed(context: Any, builder: Any, kind: Any, output: Any) -> Any:
    if isinstance(output, tuple):
        parts = zip(kind, output, strict=True)
        return context.make_tuple(
            builder, kind, [_packed(context, builder, *each) for each in parts]
        )
    return context.get_dummy_value() if output is None else output.value


@traced
def load(a, k):
    """Read a row of an array of shape (number, 8)."""
    return a.row(k)


@traced
def store(a, k, value):
    """Write a row of an array of shape (number, 8), or as many as a tuple has numbers."""
    for q, number in enumerate(value if isinstance(value, tuple) else (value,)):
        a.put(k + q, number)


@traced
def eight(a, at):
    """Read eight numbers that follow each other in an array of one axis."""
    return a.row(at, 1)


@traced
def put_eight(a, at, value):
    """Write eight numbers that follow each other in an array of one axis."""
    a.put(at, value, 1)
