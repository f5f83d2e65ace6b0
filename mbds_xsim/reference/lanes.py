"""Numbers of eight trajectories at once, as one vector of the processor, for compiled kernels.

A `Lanes` value is LLVM's <8 × double>: every operation acts on all eight numbers, whatever the
compiler can prove about arrays. Such values are kept in arrays of shape (number, 8).
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model

from mbds_xsim.reference.compiling import FIRST

LANES = 8

_VECTOR = ir.VectorType(ir.DoubleType(), LANES)


class Lanes(types.Type):
    """Numba type of eight numbers, one for each lane."""

    def __init__(self) -> None:
        super().__init__(name=f"Lanes{LANES}")


lanes = Lanes()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def spread_over(builder: Any, value: Any) -> Any:
    """Put one number into all lanes."""
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, _INDEX(0))
    zeros = ir.Constant(ir.VectorType(_INDEX, LANES), [0] * LANES)
    return builder.shuffle_vector(one, one, zeros)


_INDEX = ir.IntType(32)


def _arithmetic(operation: Any, instruction: str, count: int = 2) -> None:
    """Let an operator take lanes, and lanes with a number."""

    @infer_global(operation)
    class _Typed(AbstractTemplate):
        metadata = FIRST

        def generic(self, args: Any, kws: Any) -> Any:  # noqa: ARG002
            allowed = len(args) == count and lanes in args and set(args) <= {lanes, types.float64}
            return signature(lanes, *args) if allowed else None

    for kinds in itertools.product((lanes, types.float64), repeat=count):
        if lanes not in kinds:
            continue

        @lower_builtin(operation, *kinds)
        def _lowered(context: Any, builder: Any, sig: Any, args: Any) -> Any:  # noqa: ARG001
            whole = (
                value if kind is lanes else spread_over(builder, value)
                for kind, value in zip(sig.args, args, strict=True)
            )
            return getattr(builder, instruction)(*whole)


_arithmetic(operator.add, "fadd")
_arithmetic(operator.sub, "fsub")
_arithmetic(operator.mul, "fmul")
_arithmetic(operator.truediv, "fdiv")
_arithmetic(operator.neg, "fneg", count=1)


def address(context: Any, builder: Any, kind: Any, array: Any, row: Any, width: int) -> Any:
    """Point to eight numbers of an array, by their row and its width."""
    array = context.make_array(kind)(context, builder, array)
    row = builder.mul(row, context.get_constant(types.intp, width))
    return builder.bitcast(builder.gep(array.data, [row]), _VECTOR.as_pointer())


@intrinsic
def spread(typing: Any, value: Any) -> Any:  # noqa: ARG001
    """Put one number into all lanes."""
    return lanes(types.float64), lambda context, builder, sig, args: spread_over(builder, args[0])  # noqa: ARG005


@intrinsic
def positive(typing: Any, test: Any, value: Any, other: Any) -> Any:  # noqa: ARG001
    """Return `value` in the lanes in which `test` is above 0, and `other` in the rest."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:  # noqa: ARG001
        zero = ir.Constant(_VECTOR, [0.0] * LANES)
        return builder.select(builder.fcmp_ordered(">", args[0], zero), args[1], args[2])

    return lanes(lanes, lanes, lanes), generate


def _function(name: str, count: int) -> Callable[..., Any]:
    """Make an intrinsic from one of LLVM's functions for vectors."""

    def call(context: Any, builder: Any, sig: Any, args: Any) -> Any:  # noqa: ARG001
        kind = ir.FunctionType(_VECTOR, [_VECTOR] * count)
        whole = f"llvm.{name}.v{LANES}f64"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, whole), args)

    if count == 1:
        return intrinsic(lambda typing, a: (lanes(lanes), call))  # noqa: ARG005
    return intrinsic(lambda typing, a, b: (lanes(lanes, lanes), call))  # noqa: ARG005


root = _function("sqrt", 1)
size = _function("fabs", 1)
sine = _function("sin", 1)
cosine = _function("cos", 1)
larger = _function("maxnum", 2)


@intrinsic
def arctan2(typing: Any, a: Any, b: Any) -> Any:  # noqa: ARG001
    """Return angles in (−π, π], lane by lane: LLVM has no such function for vectors."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:  # noqa: ARG001
        one = context.get_function(math.atan2, signature(types.float64, *[types.float64] * 2))
        angles = ir.Constant(_VECTOR, ir.Undefined)
        for k in map(_INDEX, range(LANES)):
            value = one(builder, [builder.extract_element(each, k) for each in args])
            angles = builder.insert_element(angles, value, k)
        return angles

    return lanes(lanes, lanes), generate
