"""Building blocks of networks: perceptrons, constant linear maps and constant buffers."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

_FAINT = 0.01


class TensorModule(nn.Module):
    """Module whose attributes are tensors unless they are declared or assigned as something else.

    Buffers that `keep` registers need no declaration then; one that needs an explanation has it in
    a declaration.
    """

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Tensor: ...


def mlp(
    inputs: int,
    outputs: int,
    *,
    hidden: int,
    layers: int,
    activation: Callable[[], nn.Module] = nn.SiLU,
    norm: bool = False,
) -> nn.Sequential:
    """Build a perceptron of `layers` linear layers, with a final normalisation if `norm`."""
    widths = [inputs, *[hidden] * (layers - 1), outputs]
    parts: list[nn.Module] = [nn.Linear(widths[0], widths[1])]
    for before, after in pairwise(widths[1:]):
        parts += [activation(), nn.Linear(before, after)]
    return nn.Sequential(*parts, *([nn.LayerNorm(outputs)] if norm else []))


def mixed(weights: Tensor, vectors: Tensor) -> Tensor:
    """Sum vectors with constant weights (after, before): (batch, before, 3) to (batch, after, 3).

    This is one matrix product, while `weights @ vectors` is one for each batch member.
    """
    return torch.tensordot(weights, vectors, ([1], [1])).transpose(0, 1)


def summed(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Sum rows (batch, row, …) that have the same index, to shape (batch, count, …)."""
    return values.new_zeros(len(values), count, *values.shape[2:]).index_add(1, index, values)


def factorised(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Return Cholesky factors of matrices and what failed, as `torch.linalg.cholesky_ex` does.

    The factors replace matrices that are stored by columns, unless these need a gradient: torch
    would copy them element by element, which takes a third as long as factorising them.
    """
    if matrix.requires_grad:
        return torch.linalg.cholesky_ex(matrix)
    failed = matrix.new_empty(len(matrix), dtype=torch.int32)
    return torch.linalg.cholesky_ex(matrix, out=(matrix, failed))


def keep(module: nn.Module, **values: Any) -> None:
    """Register arrays that follow a module's device but are not saved with its parameters."""
    for name, value in values.items():
        module.register_buffer(name, torch.as_tensor(value), persistent=False)


def silence(*networks: nn.Sequential) -> None:
    """Shrink the outputs of new networks, so that learning starts near a model without them."""
    for network in networks:
        last = network[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            last.weight.mul_(_FAINT)
            last.bias.zero_()
