"""A colour and a marker mean one thing, wherever they are shown."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest

from mbds_xsim.learn.curves import looks
from mbds_xsim.report import themed
from mbds_xsim.simulate import registry
from mbds_xsim.studies.stability.words import LOOKS
from mbds_xsim.studies.validate.figures import styles

from .conftest import Case

_KINDS = {
    "engines": themed.ENGINES,
    "models": themed.LIGHT[len(themed.ENGINES) :],
    "intervals": themed.INTERVALS,
    "parts": tuple(colour for part, colour in themed.PARTS.items() if part != "fixed"),
    "outcomes": tuple(look.colour for look in LOOKS.values()),
}
_APART = 12.0
"""Least distance of CIE 1976 colours; 2.3 is just noticeable side by side."""


@pytest.mark.parametrize(("one", "other"), list(itertools.combinations(_KINDS, 2)))
def test_no_kind_of_thing_looks_like_another(one: str, other: str) -> None:
    pairs = itertools.product(_KINDS[one], _KINDS[other])

    assert [pair for pair in pairs if np.linalg.norm(_lab(pair[0]) - _lab(pair[1])) < _APART] == []


def test_a_page_on_dark_ground_has_as_many_colours() -> None:
    assert len(themed.DARK) == len(themed.LIGHT) == len(set(themed.LIGHT))


def test_every_method_has_a_marker_of_its_own() -> None:
    methods = {
        method
        for name in registry.simulator_names()
        for method in registry.load_adapter(name).methods
    }

    assert set(themed.METHODS) == methods
    assert len(set(themed.METHODS.values())) == len(methods)
    assert themed.marker_of("of a plugin") == themed.marker_of("of a plugin")
    assert themed.marker_of("of a plugin") not in themed.METHODS.values()


def test_an_engine_keeps_its_colour_whoever_is_beside_it() -> None:
    place = registry.engine_names().index("mujoco")

    assert themed.engine_style("mujoco") == themed.Style(place, dashed=False, letter="M")
    assert looks(["mujoco"])["mujoco"] == (themed.ENGINES[place], "-")
    assert looks(["all", "dart", "mujoco"])["mujoco"] == (themed.ENGINES[place], "-")
    assert looks(["all"])["all"][0] not in themed.LIGHT


@pytest.mark.parametrize(
    ("profiles", "dashed"),
    [
        (("matched", "native"), [False, True]),
        (("native", "matched"), [True, False]),
        (("native",), [True]),
        (("fine", "coarse"), [False, True]),
    ],
)
def test_two_settings_of_an_engine_differ_by_the_line(
    one_engine: Case, profiles: tuple[str, ...], dashed: list[bool]
) -> None:
    (result,) = one_engine.validation.engines
    shown = styles(msgspec.structs.replace(result, profile=profile) for profile in profiles)
    assert [style.dashed for style in shown] == dashed


def test_a_model_keeps_its_colour() -> None:
    styles = [themed.model_style(model) for model in (*themed.MODELS, "of a plugin")]

    assert len({style.colour for style in styles}) == len(styles)
    assert [themed.model_colour(model) for model in themed.MODELS] == [*themed.MODELS.values()]


def _lab(colour: str) -> np.ndarray:
    """Coordinates of a colour in CIE 1976 L*a*b* (D65)."""
    share = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    linear = np.where(share > 0.04045, ((share + 0.055) / 1.055) ** 2.4, share / 12.92)
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    )
    x, y, z = np.cbrt(to_xyz @ linear / [0.9505, 1.0, 1.089])
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])
