"""Windows that go on from a model's own prediction, so that it learns to correct what it does.

What a model gets wrong, such as a rod's length, is in no data; never shown it, a model may let it
grow from frame to frame.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from mbds_xsim.errors import InputError
from mbds_xsim.learn.model import PointModel
from mbds_xsim.learn.window import Inputs, Sample

__all__ = ["pushed"]

NEEDED = 2
"""Frames to come: the one that is predicted, and what follows it."""


def pushed(model: PointModel, sample: Sample, part: float) -> Sample:
    """Let a part of a batch go on from the model's own prediction, a frame later.

    No gradient passes through the prediction. Source: Brandstetter, Worrall and Welling, "Message
    passing neural PDE solvers", ICLR 2022, section 3.1, there of all windows.

    Args:
        model: Whose loss it is for.
        sample: Windows with two frames to come, or one where the part is 0.
        part: Of the batch, 0 to 1, taken from its front.

    Returns:
        The windows, with one frame to come: what follows the prediction, or the last known frame.

    Raises:
        InputError: Windows are to be pushed, and have one frame to come.
    """
    count = round(part * len(sample.position))
    if not count:
        return sample
    if sample.position.shape[1] < NEEDED:
        msg = (
            f"pushed: got {part} and windows of 1 frame to come, needed are {NEEDED}; "
            "raise the recipe's horizon, or leave pushed at 0"
        )
        raise InputError(msg)
    start, inputs = sample.start, sample.inputs.at(0)
    with torch.no_grad():
        given = Inputs(inputs.force[:count], inputs.torque[:count])
        own = model.advance(start.history[:count], given)
    return Sample(
        start=replace(start, history=torch.cat([own, start.history[count:]])),
        inputs=Inputs(_later(sample.inputs.force, count), _later(sample.inputs.torque, count)),
        position=_later(sample.position, count),
        velocity=_later(sample.velocity, count),
    )


def _later(frames: torch.Tensor, count: int) -> torch.Tensor:
    """Take the second frame of the first rows and the first of the others, (batch, 1, …)."""
    return torch.cat([frames[:count, 1:2], frames[count:, :1]])
