"""Pictures keep the colours that were drawn."""

import io
from typing import Any

import numpy as np
from PIL import Image, ImageColor

from mbds_xsim.report import themed
from mbds_xsim.report.themed import few_colours

RARE = ("#7a4fb5", "#8c6d1f", "#5c8a00")


def drawn(figure: Any) -> None:
    """Broad lines, shaded in hundreds of tints, and small markers of other colours."""
    axes = figure.subplots()
    across = np.linspace(0, 1, 200)
    for place, colour in enumerate(themed.LIGHT):
        for share in np.linspace(0.05, 1, 12):
            axes.plot(across, place + share * across**2, color=colour, alpha=share)
    for place, colour in enumerate(RARE):
        axes.plot(place / 3 + 0.1, -1, "h", color=colour, ms=6)


def test_a_colour_of_few_pixels_is_not_lost_to_others() -> None:
    png = Image.open(io.BytesIO(themed.png(drawn, (6, 4))))
    assert png.mode == "P"
    pixels = np.array(png.convert("RGB"), int)
    for colour in RARE:
        off = np.abs(pixels - np.array(ImageColor.getrgb(colour))).max(axis=-1)
        assert (off <= 15).sum() > 50, colour


def test_256_colours_stay_exact_and_what_is_most_does_among_more() -> None:
    rng = np.random.default_rng(3)
    few = rng.integers(0, 256, (256, 3), np.uint8)[rng.integers(0, 256, (60, 80))]
    assert np.array_equal(np.array(few_colours(Image.fromarray(few)).convert("RGB")), few)
    many = rng.integers(0, 256, (60, 80, 3), np.uint8)
    many[:20] = 201, 202, 203
    reduced = np.array(few_colours(Image.fromarray(many)).convert("RGB"))
    assert (reduced[:20] == (201, 202, 203)).all()
    # The best 125 points, a grid of five, are 44 off at most; taking the farthest, twice that.
    assert np.linalg.norm(reduced.astype(int) - many, axis=-1).max() < 2 * 256 / 5 * 3**0.5 / 2
