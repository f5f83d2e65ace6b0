"""What a GPU can do faster: bfloat16 in the networks, and networks replayed as CUDA graphs."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import nn

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import core_count
from mbds_xsim.learn.model import LearnedModel, PointModel


def check_device(device: str, *, here: bool = True) -> None:
    """Raise InputError for a device that is not known or, if it is to be here, is not there."""
    if device not in ("cpu", "cuda"):
        msg = f"--device: got {device!r}, allowed is cpu or cuda"
        raise InputError(msg)
    if here and device == "cuda" and not torch.cuda.is_available():
        msg = "--device: got 'cuda', but torch finds no GPU here; allowed is cpu"
        raise InputError(msg)


def process_count(asked: int | None, device: str) -> int:
    """As many at a time as asked; left out, one for a GPU, which they would share, or all cores."""
    if asked is not None:
        return asked
    return 1 if device == "cuda" else core_count()


def put(model: LearnedModel, device: str) -> None:
    """Move a model, and the graph that it asks in every step."""
    model.to(device)
    model.graph = model.graph.to(device)


def precision(model: LearnedModel, *, mixed: bool) -> AbstractContextManager[object]:
    """Give the block in which a model's loss is computed, mixed where it is asked for and can be.

    Parameters, optimiser and integration stay float32, and so do the sums and norms that torch
    keeps there. bfloat16 has float32's range: no gradient needs scaling.
    """
    if not (mixed and model.mixes):
        return nullcontext()
    return torch.autocast(next(model.parameters()).device.type, dtype=torch.bfloat16)


def compile_networks(model: LearnedModel, *, backend: str | None = None) -> None:
    """Have a model's networks compiled at their first use; its parameters keep their names.

    A run has few shapes (a batch, its parts that are pushed on, a validation), so that the kernels
    of each are recorded once, as a CUDA graph, and replayed. Models of an energy are left as they
    are: torch does not compile through the second derivatives that their training needs. Another
    backend than torch's own is without CUDA graphs.
    """
    if not isinstance(model, PointModel):
        return
    how = {"mode": "reduce-overhead"} if backend is None else {"backend": backend}
    networks = [model] if _has_forward(model) else [*filter(_has_forward, model.children())]
    for network in networks:
        if any(True for _ in network.parameters()):
            network.compile(**how, dynamic=False)


def _has_forward(module: nn.Module) -> bool:
    return type(module).forward is not nn.Module.forward
