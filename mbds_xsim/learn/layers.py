"""What networks share: linear layers with an activation between them, and constants beside them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

_FAINT = 0.01


def mlp(
    inputs: int,
    outputs: int,
    *,
    hidden: int,
    layers: int,
    activation: Callable[[], nn.Module] = nn.SiLU,
    norm: bool = False,
) -> nn.Sequential:
    """Give so many linear layers with activations between them, and normalisation if asked for."""
    widths = [inputs, *[hidden] * (layers - 1), outputs]
    parts: list[nn.Module] = [nn.Linear(widths[0], widths[1])]
    for before, after in pairwise(widths[1:]):
        parts += [activation(), nn.Linear(before, after)]
    return nn.Sequential(*parts, *([nn.LayerNorm(outputs)] if norm else []))


def mixed(weights: Tensor, vectors: Tensor) -> Tensor:
    """Add up vectors by constant weights (after, before), (batch, before, 3) to (batch, after, 3).

    It is one product of matrices, where `weights @ vectors` is one for each of the batch.
    """
    return torch.tensordot(weights, vectors, ([1], [1])).transpose(0, 1)


def keep(module: nn.Module, **values: Any) -> None:
    """Keep arrays that follow a module's device but are no part of what it learned."""
    for name, value in values.items():
        module.register_buffer(name, torch.as_tensor(value), persistent=False)


def silence(*networks: nn.Sequential) -> None:
    """Have networks begin by giving next to nothing: learning starts where all else leads."""
    for network in networks:
        last = network[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            last.weight.mul_(_FAINT)
            last.bias.zero_()
