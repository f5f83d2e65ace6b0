"""Mechanisms that HGNN and LGNN must handle beyond the project's own scenes."""

from __future__ import annotations

import math
import re
from pathlib import Path

import msgspec

from mbds_xsim.scene.scene import Body, DistanceLink, Inertia, Joint, Particle, Scene, SpringDamper
from mbds_xsim.simulate.registry import load_scene

_PAGE = Path(__file__).parents[2] / "docs" / "scene-file.md"

INERTIA = Inertia(2.0, (0.3, 0.4, 0.5), (0.02, -0.03, 0.04), (0.1, 0.2, -0.1))
TURN = 2.0 * math.pi / 3.0
BALL = Inertia(1.0, (0.1, 0.1, 0.1))


def scene_of(name: str) -> Scene:
    """Return one of these scenes, or one of the project's."""
    makers = {"every_joint": every_joint, "linked": linked, "four-bar": four_bar}
    return makers[name]() if name in makers else load_scene(name)


def every_joint() -> Scene:
    """A tree with every joint kind, a spring and skew inertias."""
    return Scene(
        "every_joint",
        tuple(Body(f"b{k}", inertia=INERTIA, position=(1.0 * k, 0.2 * k, 0.0)) for k in range(6)),
        1.0,
        joints=(
            Joint("h", "hinge", "world", "b0", (0.0, 0.0, 0.0), (1.0, 0.5, 0.2)),
            Joint("s", "slider", "b0", "b1", (0.5, 0.0, 0.0), (0.3, 1.0, 0.2)),
            Joint("f", "fixed", "b1", "b2", (1.5, 0.1, 0.0)),
            Joint("b", "ball", "b3", "b2", (2.5, 0.1, 0.3)),
            Joint("h2", "hinge", "b4", "b3", (3.5, 0.1, 0.3), (0.0, 0.0, 1.0)),
        ),
        springs=(
            SpringDamper("k", ("b0", "b4"), ((0.0, 0.3, 0.0), (3.0, 2.0, 1.0)), 100.0, 3.0, 0.5),
        ),
    )


def linked() -> Scene:
    """Bodies on oblique arms, whose points at joints are exact up to rounding; links, springs."""
    return Scene(
        "linked",
        (
            Body("bob", particles=(Particle((0.3, 0.1, -0.4)),)),
            Body("knob", inertia=BALL, position=(1.4, 0.0, -0.5)),
            Body("door", inertia=BALL, position=(2.3, 0.2, -0.7)),
            Body("kite", inertia=INERTIA, position=(3.0, 0.3, -1.0)),
            # Neither spins, and yet it shows how it is turned.
            Body("top", inertia=Inertia(1.0, (0.2, 0.2, 0.1)), position=(0.0, 4.0, -0.5)),
            Body(
                "star",
                particles=tuple(
                    Particle((0.5 * math.cos(k * TURN), 6.0 + 0.5 * math.sin(k * TURN), -0.5))
                    for k in range(3)
                ),
            ),
        ),
        1.0,
        joints=(
            Joint("a", "ball", "world", "bob", (0.0, 0.0, 0.0)),
            Joint("b", "ball", "world", "knob", (1.0, 0.0, 0.0)),
            Joint("t", "ball", "world", "top", (0.0, 4.0, 0.0)),
            Joint("s", "ball", "world", "star", (0.0, 6.0, 0.0)),
            Joint("c", "hinge", "world", "door", (2.0, 0.1, 0.0), (0.3, 1.0, 0.2), rate=2.0),
        ),
        distance_links=(
            DistanceLink("l", ("bob", "knob"), ((0.3, 0.1, -0.4), (1.4, 0.0, -0.5))),
            DistanceLink("m", ("door", "kite"), ((2.3, 0.2, -0.7), (2.9, 0.4, -0.8))),
        ),
        springs=(
            SpringDamper("soft", ("knob", "door"), ((1.4, 0.1, -0.5), (2.3, 0.2, -0.7)), 5.0, 0.5),
            SpringDamper(
                "stiff", ("kite", "world"), ((3.0, 0.3, -1.2), (3.5, 0.0, 0.0)), 90.0, 1.0
            ),
        ),
    )


def four_bar() -> Scene:
    """The driven crank-rocker of the docs: a plane loop with redundant hinges."""
    match = re.search(r"^`four-bar.toml`:\n\n```toml\n(.*?)^```$", _PAGE.read_text(), re.M | re.S)
    assert match is not None
    return msgspec.toml.decode(match[1], type=Scene)
