"""Colours and markers, each with one meaning on every chart and page.

Engines have Okabe and Ito's colours, which colour-blind people tell apart. No engine, model,
interval, part of a scene or outcome of a run looks like one of another kind.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from dataclasses import dataclass

from mbds_xsim.simulate import registry

ENGINES = ("#009e73", "#cc79a7", "#0072b2", "#d55e00", "#e69f00", "#56b4e9")
MODELS = {"gns": "#7a4fb5", "hgnn": "#a8123e", "lgnn": "#8c6d1f", "sgnn": "#5c8a00"}
_OTHER = "#6b6b6b"

LIGHT = (*ENGINES, *MODELS.values(), _OTHER)
"""Of what pages show."""
DARK = (
    "#2fc79c", "#e8a0c8", "#56a8ec", "#ff8c42", "#f2bb3f", "#9ad8fa",
    "#b795f2", "#ff7394", "#cfae5c", "#a5cf52", "#a9a9a9",
)  # fmt: skip
"""The same, lighter, for a dark background."""

INTERVALS = ("#6fc7cf", "#008c9e", "#00565f")
"""Low, medium and high."""

PARTS = {
    "hinge": "#2b3f8c",
    "slider": "#5fa05a",
    "ball": "#a33b73",
    "fixed": "#1c2733",
    "spring": "#c2452d",
    "distance link": "#b59a00",
    "contact sphere": "#9a7fd6",
}
"""What a drawing of a scene shows beside its bodies."""

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
}
"""Markers of methods: filled forms, which nothing else has."""
_MORE_MARKERS = "h8"


@dataclass(frozen=True)
class Style:
    """How a result is drawn."""

    colour: int
    """Place in the palettes `LIGHT` and `DARK`."""
    dashed: bool
    """Native settings are dashed, beside the same engine's matched ones."""
    letter: str = ""
    """On curves, for those who do not see colours."""


def engine_style(engine: str, others: Iterable[str] = (), *, dashed: bool = False) -> Style:
    """Give an engine its colour: registered ones in their order, then the others."""
    known = list(dict.fromkeys([*registry.simulator_names(), *others, engine]))
    return Style(known.index(engine) % len(ENGINES), dashed, engine[:1].upper())


def model_style(model: str, *, dashed: bool = False) -> Style:
    """Give a learned model its colour."""
    known = list(MODELS)
    place = known.index(model) if model in MODELS else len(MODELS)
    return Style(len(ENGINES) + place, dashed, model[:1].upper())


def model_colour(model: str) -> str:
    """Give a learned model its colour on white."""
    return LIGHT[model_style(model).colour]


def marker_of(method: str) -> str:
    """Give a method its marker; one that is not known gets the same one every time."""
    return METHODS.get(method, _MORE_MARKERS[zlib.crc32(method.encode()) % len(_MORE_MARKERS)])
