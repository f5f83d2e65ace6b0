"""Pictures of 256 colours, which takes a third of the space, that keep the colours drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["few_colours"]

_COLOURS = 256
_EXACT = 128  # lines, areas and text as they are; the others are of edges that fade out


def few_colours(picture: Image) -> Image:
    """Give a picture 256 colours: those of most pixels, then time and again the farthest one left.

    Median cut, the usual way, goes by numbers of pixels alone: two small markers of different
    colours can get one between them.

    Args:
        picture: Of mode RGB.

    Returns:
        The picture with a palette, mode P.
    """
    from PIL import Image

    pixels = np.asarray(picture).reshape(-1, 3) @ np.array([1 << 16, 1 << 8, 1])
    packed, place, often = np.unique(pixels, return_inverse=True, return_counts=True)
    colours = np.stack([packed >> 16, packed >> 8 & 255, packed & 255], axis=1)
    chosen = list(np.argsort(-often, kind="stable")[:_EXACT])
    nearest = np.zeros(len(colours), np.uint8)
    off = np.full(len(colours), np.inf)
    for number in range(min(_COLOURS, len(colours))):
        if number == len(chosen):
            chosen.append(off.argmax())
        distance = ((colours - colours[chosen[number]]) ** 2).sum(axis=1)
        closer = distance < off
        nearest[closer], off[closer] = number, distance[closer]
    found = Image.fromarray(nearest[place].reshape(picture.height, picture.width), "P")
    found.putpalette(colours[chosen].astype(np.uint8).tobytes())
    return found
