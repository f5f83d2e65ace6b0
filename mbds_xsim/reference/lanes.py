"""Numbers of eight trajectories at once, as one vector of the processor, for compiled kernels.

A `Lanes` value is LLVM's <8 × double>: every operation on it is one on all eight, whatever the
compiler can prove about arrays. They are kept in arrays of shape (number, 8). Vectors of space
are tuples of three, symmetric matrices of six (xx, yy, zz, xy, xz, yz), others of nine by rows.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils, config
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model

from mbds_xsim.reference.cache import kernel_folder

LANES = 8

# Nothing is left to be found here by what looks for vectors in loops and expressions.
config.LOOP_VECTORIZE = config.SLP_VECTORIZE = 0

_VECTOR = ir.VectorType(ir.DoubleType(), LANES)


class Lanes(types.Type):
    """Numba's type of such a value."""

    def __init__(self) -> None:
        super().__init__(name=f"Lanes{LANES}")


lanes = Lanes()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def _spread(builder: Any, value: Any) -> Any:
    """Put one number into all lanes."""
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, _INDEX(0))
    zeros = ir.Constant(ir.VectorType(_INDEX, LANES), [0] * LANES)
    return builder.shuffle_vector(one, one, zeros)


_INDEX = ir.IntType(32)


def _arithmetic(operation: Any, instruction: str) -> None:
    """Let an operator take lanes, and lanes with a number."""

    @infer_global(operation)
    class _Typed(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:  # noqa: ARG002
            allowed = len(args) == 2 and lanes in args and set(args) <= {lanes, types.float64}
            return signature(lanes, *args) if allowed else None

    for left, right in ((lanes, lanes), (types.float64, lanes), (lanes, types.float64)):

        @lower_builtin(operation, left, right)
        def _lowered(
            context: Any,  # noqa: ARG001
            builder: Any,
            sig: Any,
            args: Any,
        ) -> Any:
            a, b = (
                value if kind is lanes else _spread(builder, value)
                for kind, value in zip(sig.args, args, strict=True)
            )
            return getattr(builder, instruction)(a, b)


for _operation, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _arithmetic(_operation, _instruction)


@infer_global(operator.neg)
class _Negated(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:  # noqa: ARG002
        return signature(lanes, lanes) if args == (lanes,) else None


@lower_builtin(operator.neg, lanes)
def _negated(context: Any, builder: Any, sig: Any, args: Any) -> Any:  # noqa: ARG001
    return builder.fneg(args[0])


def _address(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Point to a row of an array of lanes."""
    array = context.make_array(sig.args[0])(context, builder, args[0])
    row = builder.mul(args[1], context.get_constant(types.intp, LANES))
    return builder.bitcast(builder.gep(array.data, [row]), _VECTOR.as_pointer())


@intrinsic
def load(typing: Any, array: Any, row: Any) -> Any:  # noqa: ARG001
    """Read a row of an array of shape (number, 8)."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_address(context, builder, sig, args), align=8)

    return lanes(array, types.intp), generate


@intrinsic
def store(typing: Any, array: Any, row: Any, value: Any) -> Any:  # noqa: ARG001
    """Write a row of an array of shape (number, 8)."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _address(context, builder, sig, args[:2]), align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), generate


@intrinsic
def spread(typing: Any, value: Any) -> Any:  # noqa: ARG001
    """Put one number into all lanes."""
    return lanes(types.float64), lambda context, builder, sig, args: _spread(builder, args[0])  # noqa: ARG005


@intrinsic
def positive(typing: Any, test: Any, value: Any, other: Any) -> Any:  # noqa: ARG001
    """Give `value` in the lanes in which `test` is above 0, and `other` in the rest."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:  # noqa: ARG001
        zero = ir.Constant(_VECTOR, [0.0] * LANES)
        return builder.select(builder.fcmp_ordered(">", args[0], zero), args[1], args[2])

    return lanes(lanes, lanes, lanes), generate


def _function(name: str, count: int) -> Callable[..., Any]:
    """Make an intrinsic of a function that LLVM has for vectors."""

    def call(context: Any, builder: Any, sig: Any, args: Any) -> Any:  # noqa: ARG001
        kind = ir.FunctionType(_VECTOR, [_VECTOR] * count)
        whole = f"llvm.{name}.v{LANES}f64"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, whole), args)

    if count == 1:
        return intrinsic(lambda typing, a: (lanes(lanes), call))  # noqa: ARG005
    return intrinsic(lambda typing, a, b: (lanes(lanes, lanes), call))  # noqa: ARG005


root = _function("sqrt", 1)
size = _function("fabs", 1)
larger = _function("maxnum", 2)


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a kernel that kernels call; no references are counted, as it makes no arrays."""
    return _compiled(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def entered(function: Callable[..., Any]) -> Any:
    """Compile a kernel that Python calls; what takes its arguments apart takes long to compile."""
    return _compiled(function, no_cfunc_wrapper=True)


def _compiled(function: Callable[..., Any], **options: bool) -> Any:
    before = config.CACHE_DIR
    config.CACHE_DIR = before or str(kernel_folder())
    make = functools.partial(
        njit, nogil=True, error_model="numpy", fastmath={"contract"}, _nrt=False, **options
    )
    try:
        return make(cache=True)(function)
    except RuntimeError:  # no folder can be written to
        return make()(function)
    finally:
        config.CACHE_DIR = before


@compiled
def load3(a, k):
    """Read a vector."""
    return load(a, k), load(a, k + 1), load(a, k + 2)


@compiled
def store3(a, k, v):
    """Write a vector."""
    store(a, k, v[0])
    store(a, k + 1, v[1])
    store(a, k + 2, v[2])


@compiled
def load6(a, k):
    """Read a symmetric matrix."""
    x, y = load3(a, k), load3(a, k + 3)
    return x[0], x[1], x[2], y[0], y[1], y[2]


@compiled
def store6(a, k, m):
    """Write a symmetric matrix."""
    store3(a, k, (m[0], m[1], m[2]))
    store3(a, k + 3, (m[3], m[4], m[5]))


@compiled
def load9(a, k):
    """Read a matrix."""
    return (
        load(a, k), load(a, k + 1), load(a, k + 2), load(a, k + 3), load(a, k + 4), load(a, k + 5),
        load(a, k + 6), load(a, k + 7), load(a, k + 8),
    )  # fmt: skip


@compiled
def store9(a, k, m):
    """Write a matrix."""
    store3(a, k, (m[0], m[1], m[2]))
    store3(a, k + 3, (m[3], m[4], m[5]))
    store3(a, k + 6, (m[6], m[7], m[8]))


@compiled
def number3(a, k):
    """Read three numbers that are the same in all lanes."""
    return a[k, 0], a[k, 1], a[k, 2]


@compiled
def add(a, b):
    """Add vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled
def add_to3(a, k, v):
    """Add a vector to one in an array."""
    store3(a, k, add(load3(a, k), v))


@compiled
def sub(a, b):
    """Subtract vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def times(f, v):
    """Multiply a vector."""
    return f * v[0], f * v[1], f * v[2]


@compiled
def dot(a, b):
    """Multiply vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a, b):
    """Multiply vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def apply(m, v):
    """Multiply a matrix and a vector."""
    return (
        m[0] * v[0] + m[1] * v[1] + m[2] * v[2],
        m[3] * v[0] + m[4] * v[1] + m[5] * v[2],
        m[6] * v[0] + m[7] * v[1] + m[8] * v[2],
    )


@compiled
def apply_turned(m, v):
    """Multiply a transposed matrix and a vector."""
    return (
        m[0] * v[0] + m[3] * v[1] + m[6] * v[2],
        m[1] * v[0] + m[4] * v[1] + m[7] * v[2],
        m[2] * v[0] + m[5] * v[1] + m[8] * v[2],
    )


@compiled
def apply_even(m, v):
    """Multiply a symmetric matrix and a vector."""
    return (
        m[0] * v[0] + m[3] * v[1] + m[4] * v[2],
        m[3] * v[0] + m[1] * v[1] + m[5] * v[2],
        m[4] * v[0] + m[5] * v[1] + m[2] * v[2],
    )


@compiled
def inverse_even(m):
    """Invert a symmetric matrix."""
    a = m[1] * m[2] - m[5] * m[5]
    b = m[4] * m[5] - m[3] * m[2]
    c = m[3] * m[5] - m[4] * m[1]
    f = 1.0 / (m[0] * a + m[3] * b + m[4] * c)
    return (
        f * a, f * (m[0] * m[2] - m[4] * m[4]), f * (m[0] * m[1] - m[3] * m[3]),
        f * b, f * c, f * (m[3] * m[4] - m[0] * m[5]),
    )  # fmt: skip


@compiled
def product(a, b):
    """Multiply matrices."""
    x, y, z = (b[0], b[3], b[6]), (b[1], b[4], b[7]), (b[2], b[5], b[8])
    return _columns(apply(a, x), apply(a, y), apply(a, z))


@compiled
def even_product(a, b):
    """Multiply a symmetric matrix and another one."""
    x, y, z = (b[0], b[3], b[6]), (b[1], b[4], b[7]), (b[2], b[5], b[8])
    return _columns(apply_even(a, x), apply_even(a, y), apply_even(a, z))


@compiled
def crossed_even(m, r):
    """Multiply a symmetric matrix M and [r]× from the right."""
    x, y, z = (m[0], m[3], m[4]), (m[3], m[1], m[5]), (m[4], m[5], m[2])
    # Each row v of M becomes v × r, which is vᵀ [r]×.
    a, b, c = cross(x, r), cross(y, r), cross(z, r)
    return a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]


@compiled
def cross_matrix(r, m):
    """Multiply [r]× and a matrix."""
    x, y, z = (m[0], m[3], m[6]), (m[1], m[4], m[7]), (m[2], m[5], m[8])
    return _columns(cross(r, x), cross(r, y), cross(r, z))


@compiled
def transposed(m):
    """Transpose a matrix."""
    return m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]


@compiled
def _columns(x, y, z):
    return x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]


@compiled
def rotation_of(w, x, y, z):
    """Give the matrix of a quaternion of any length."""
    f = 2.0 / (w * w + x * x + y * y + z * z)
    fx, fy, fz = f * x, f * y, f * z
    return (
        1.0 - fy * y - fz * z, fx * y - fz * w, fx * z + fy * w,
        fx * y + fz * w, 1.0 - fx * x - fz * z, fy * z - fx * w,
        fx * z - fy * w, fy * z + fx * w, 1.0 - fx * x - fy * y,
    )  # fmt: skip
