"""Windows that go on from a model's own prediction, so that it learns to correct what it does.

What a model gets wrong, such as a rod's length, is in no data; never shown it, a model may let it
grow from frame to frame.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from mbds_xsim.learn.model import PointModel
from mbds_xsim.learn.window import Inputs, Sample

__all__ = ["pushed"]

PART = 0.5
"""Of the windows, those that go on for a frame more; so half of a batch are true ones."""


def pushed(model: PointModel, sample: Sample) -> Sample:
    """Let half of a batch go on from the model's own prediction, half of these again, and so on.

    The more frames to come, the farther; the last of them is learned from. No gradient passes
    through the predictions. Source: Brandstetter, Worrall and Welling, "Message passing neural
    PDE solvers", ICLR 2022, section 3.1, there one frame of all windows; what more are worth is
    in docs/train.md.

    Args:
        model: Whose loss it is for.
        sample: Windows; with one frame to come they stay as they are.

    Returns:
        The windows, with one frame to come: what follows the predictions, or the last known frame.
    """
    history, inputs = sample.start.history, sample.inputs
    age = torch.zeros(len(history), dtype=torch.int64, device=history.device)
    with torch.no_grad():
        for frame in range(sample.position.shape[1] - 1):
            count = round(PART ** (frame + 1) * len(history))
            if not count:  # a small batch
                break
            given = Inputs(inputs.force[:count, frame], inputs.torque[:count, frame])
            history = torch.cat([model.advance(history[:count], given), history[count:]])
            age[:count] += 1
    row = torch.arange(len(age), device=age.device)
    return Sample(
        start=replace(sample.start, history=history),
        inputs=Inputs(inputs.force[row, age][:, None], inputs.torque[row, age][:, None]),
        position=sample.position[row, age][:, None],
        velocity=sample.velocity[row, age][:, None],
    )
