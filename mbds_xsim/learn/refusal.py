"""Why a model cannot represent a scene."""

from __future__ import annotations

import torch

from mbds_xsim.errors import Unsupported
from mbds_xsim.learn.channels import CHANNELS
from mbds_xsim.learn.graph import DIMENSION, Graph
from mbds_xsim.learn.model import build
from mbds_xsim.learn.statistics import Moments, Statistics

__all__ = ["refusal"]


def refusal(name: str, graph: Graph, *, track: str = "native") -> str:
    """Say why a model cannot represent a scene; "" where it can.

    Raises:
        UnknownName: There is no such model.
        InputError: It has no such track.
    """
    try:
        build(name, graph, _of_nothing(), track=track)
    except Unsupported as error:
        return str(error)
    return ""


def _of_nothing() -> Statistics:
    """Statistics of what does not move."""
    one = Moments(torch.zeros(DIMENSION).double(), torch.ones(DIMENSION).double())
    return Statistics(one, one, one, torch.ones(len(CHANNELS)).double())
