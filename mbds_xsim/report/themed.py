"""Figures: colours and markers with one meaning everywhere, in the themes of pages and of files.

Most colours of engines are Okabe and Ito's, which colour-blind people can tell apart. No engine,
model, interval, part of a scene or outcome of a run looks like one of another kind.
"""

from __future__ import annotations

import hashlib
import io
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from markupsafe import Markup

from mbds_xsim.simulate import registry

if TYPE_CHECKING:
    from PIL.Image import Image


ENGINES = ("#009e73", "#dd00bb", "#cc79a7", "#0072b2", "#3838d8", "#d55e00", "#e69f00", "#56b4e9")
MODELS = {"gns": "#7a4fb5", "hgnn": "#a8123e", "lgnn": "#8c6d1f", "sgnn": "#5c8a00"}
_OTHER = "#6b6b6b"

LIGHT = (*ENGINES, *MODELS.values(), _OTHER)
"""Palette for a light background: engines, models, and any other model."""
DARK = (
    "#2fc79c", "#ff66ee", "#e8a0c8", "#56a8ec", "#9494ff", "#ff8c42", "#f2bb3f", "#9ad8fa",
    "#b795f2", "#ff7394", "#cfae5c", "#a5cf52", "#a9a9a9",
)  # fmt: skip
"""The same palette, lighter, for a dark background."""

INTERVALS = ("#6fc7cf", "#008c9e", "#00565f")
"""Colours of the intervals low, medium and high."""

PARTS = {
    "hinge": "#2b3f8c",
    "slider": "#5fa05a",
    "ball": "#a33b73",
    "fixed": "#1c2733",
    "spring": "#c2452d",
    "distance link": "#b59a00",
    "contact sphere": "#9a7fd6",
}
"""Colours of the parts of a scene's drawing other than bodies."""

METHODS = {
    "Euler": "o",
    "semi-implicit-euler": "s",
    "RK4": "D",
    "implicitfast": "^",
    "trapezoidal": "v",
    "generalised-alpha": "P",
    "RK44": "X",
    "RK67": "p",
    "tree-RK44": "<",
    "forward-dynamics-RK4": ">",
    "adaptive": "d",
    "runge_kutta5": "8",
}
"""Markers of methods: filled shapes, used for nothing else."""
_ANOTHER_MARKER = "h"


@dataclass(frozen=True)
class Style:
    """Style in which a result is drawn."""

    colour: int
    """Index into the palettes `LIGHT` and `DARK`."""
    dashed: bool
    """Whether lines are dashed: native settings, next to the same engine's matched ones."""
    letter: str = ""
    """Letter on curves, for those who do not see colours."""


def engine_style(engine: str, others: Iterable[str] = (), *, dashed: bool = False) -> Style:
    """Return an engine's style: colours go to registered engines in order, then to the others."""
    names = list(dict.fromkeys([*registry.simulator_names(), *others, engine]))
    initials = "".join(word[:1] for word in engine.split("-")).upper()
    return Style(names.index(engine) % len(ENGINES), dashed, initials)


def model_style(model: str, *, dashed: bool = False) -> Style:
    """Return a learned model's style; a variant with a plus has the same."""
    names, kin = list(MODELS), model.removesuffix("+")
    place = names.index(kin) if kin in MODELS else len(MODELS)
    return Style(len(ENGINES) + place, dashed, model[:1].upper())


def model_colour(model: str) -> str:
    """Return a learned model's colour on white."""
    return LIGHT[model_style(model).colour]


def marker_of(method: str) -> str:
    """Return a method's marker; unknown methods share one."""
    return METHODS.get(method, _ANOTHER_MARKER)


SOURCE = "Source"
"""Key of the checksum in a PNG."""

INK = "#010203"
"""Stand-in for the colour of the page's text."""
PAPER = "#fefdfc"
"""Stand-in for the colour of the page's background."""
GREY = "#7f7f7f"
DRAWN, PALE = "#1c2733", "#8a949e"
"""Colours of lines in pictures of scenes and of their motions."""

DOTTED: dict[str, Any] = {"color": INK, "linewidth": 0.9, "linestyle": (0, (1, 2))}
"""Line style of targets and limits, on every chart."""

_COLOURS = 256
_EXACT = 128  # colours kept exactly: lines, areas and text; the others are of edges that fade out
_STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "mbds-xsim",
    "font.size": 9,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": GREY,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.grid": True,
    "grid.color": GREY,
    "grid.alpha": 0.25,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
ON_WHITE = {"font.size": 9, "text.color": DRAWN, "axes.edgecolor": PALE}

Draw = Callable[[Any], None]
Layout = Literal["constrained"] | None


def picture(draw: Draw, size: tuple[float, float], layout: Layout, **options: Any) -> bytes:
    """Draw into a full-colour PNG on white, without the style of pages; sizes are in inches."""
    options |= {"format": "png", "dpi": 150, "metadata": {"Software": None}}
    return _saved(draw, size, layout, ON_WHITE, **options)


def svg(
    title: str, draw: Draw, size: tuple[float, float], tips: dict[str, str], place: int = 0
) -> Markup:
    """Draw into an SVG that goes straight into a page.

    Args:
        title: Description for those who do not see it.
        draw: Function that draws on the figure it is given.
        size: Width and height [in].
        tips: Tool tips by the gid of an artist. A gid's part before the last dash is the
            artist's class.
        place: Number of the figure on its page: no two figures share the id of a definition, which
            would not be drawn where the first of them is folded away.
    """
    style = _STYLE | {"svg.hashsalt": f"{_STYLE['svg.hashsalt']}-{place}"}
    options = {"format": "svg", "transparent": True, "metadata": {"Date": None}}
    drawn = _saved(draw, size, "constrained", style, **options)
    return _themed(drawn.decode(), title, tips)


def png(draw: Draw, size: tuple[float, float], stored: bytes = b"") -> bytes:
    """Draw into a PNG of 256 colours on white, of a size [in].

    `stored` is the file that keeps the drawn data; its checksum goes into the PNG.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    raw = _saved(draw, size, "constrained", _STYLE, format="png", dpi=150, facecolor="white")
    picture = few_colours(Image.open(io.BytesIO(raw)).convert("RGB"))
    metadata, stream = PngInfo(), io.BytesIO()
    if stored:
        metadata.add_text(SOURCE, checksum(stored))
    picture.save(stream, format="png", optimize=True, pnginfo=metadata)
    return stream.getvalue()


def stacked(parts: Sequence[tuple[Draw, tuple[float, float]]], stored: bytes = b"") -> bytes:
    """Draw parts one below the other, each with its size [in], into a PNG as `png` does."""
    draws, sizes = zip(*parts, strict=True)
    widths, heights = zip(*sizes, strict=True)

    def draw(figure: Any) -> None:
        rows = figure.subfigures(len(parts), 1, squeeze=False, height_ratios=heights)
        for row, part in zip(rows[:, 0], draws, strict=True):
            part(row)

    return png(draw, (max(widths), sum(heights)), stored)


def checksum(stored: bytes) -> str:
    """Return the checksum by which a picture names the file of its data."""
    return f"sha256 {hashlib.sha256(stored.strip()).hexdigest()}"


def few_colours(picture: Image) -> Image:
    """Reduce a picture to 256 colours: the most frequent, then repeatedly the farthest one left.

    The usual median cut goes by numbers of pixels alone: two small markers of different colours
    can get one between them. The picture goes from mode RGB to mode P.
    """
    from PIL.Image import fromarray

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
    image = fromarray(nearest[place].reshape(picture.height, picture.width), "P")
    image.putpalette(colours[chosen].astype(np.uint8).tobytes())
    return image


def level(axes: Any, value: float, text: str) -> None:
    """Draw a target or limit as a line across a chart, with its label at the right."""
    axes.axhline(value, **DOTTED)
    note(axes, text, (1.0, value), ("axes fraction", "data"), ha="right")


def note(
    axes: Any, text: str, spot: tuple[float, float], where: tuple[str, str], ha: str = "left"
) -> None:
    """Write a few words just above a spot of a chart; `ha` is the side on which they begin.

    `where` names the coordinates of the spot across and upwards, as matplotlib does.
    """
    axes.annotate(
        text, spot, xycoords=where, xytext=(-3 if ha == "right" else 3, 3),
        textcoords="offset points", ha=ha, fontsize=8, color=INK,
        bbox={"facecolor": PAPER, "alpha": 0.75, "edgecolor": "none", "pad": 1},
    )  # fmt: skip


def _saved(
    draw: Draw, size: tuple[float, float], layout: Layout, style: Any, **options: Any
) -> bytes:
    """Draw in a style; letters that the font lacks become boxes, without a warning."""
    import matplotlib
    from matplotlib.figure import Figure

    stream = io.BytesIO()
    with matplotlib.rc_context(style), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")
        figure = Figure(figsize=size, layout=layout)
        draw(figure)
        figure.savefig(stream, **options)
    return stream.getvalue()


def _themed(text: str, title: str, tips: dict[str, str]) -> Markup:
    """Cut what only a file needs; use the page's colours, and drop ids that clash."""
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'<g id="((?:curve|tip)-[\w-]+)">', lambda match: _group(match[1], tips), text)
    text = re.sub(r' id="[\w.]+_\d+"', "", text)
    text = re.sub(r"font(-family)?: ([\d.]+px )?[^;\"]*sans-serif[^;\"]*", _short_font, text)
    text = text.replace(INK, "var(--ink)").replace(PAPER, "var(--paper)")
    for place, colour in enumerate(LIGHT):
        text = text.replace(colour, f"var(--c{place})")
    opening = Markup('<svg role="img" aria-label="{}" ').format(title)
    return Markup(re.sub(r"<svg ", lambda _: str(opening), text, count=1))


def _group(gid: str, tips: dict[str, str]) -> str:
    kind = gid if gid.startswith("curve") else f"{gid.rsplit('-', 1)[0]}"
    name = kind.replace("tip", "curve")
    if gid not in tips:
        return f'<g class="{name}">'
    return str(Markup('<g class="{} tip"><title>{}</title>').format(name, tips[gid]))


def _short_font(match: re.Match[str]) -> str:
    """Leave the choice of the font to the page."""
    size = (match[2] or "").strip()
    return f"font-size: {size}" if size else "font-family: inherit"
