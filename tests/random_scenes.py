"""Random mechanisms and states, for which formulas must hold as for the built-in scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import msgspec
import numpy as np
from hypothesis import strategies as st

from mbds_xsim.scene.joint_space import LinkStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Body, Clock, DistanceLink, Inertia, Joint, Scene

Kind = Literal["fixed", "hinge", "slider", "ball", "free"]
SEEDS = st.integers(0, 10**6)
MOVED = st.lists(st.sampled_from(["hinge", "slider"]), min_size=1, max_size=3)
"""Kinds of joints with one coordinate."""


def ruled_tree(seed: int, kinds: Sequence[Kind], clock: Clock, **law: Any) -> Scene:
    """Make a tree whose joints all have the same springs, friction, limits or rates."""
    scene = random_tree(np.random.default_rng(seed), kinds)
    joints = (msgspec.structs.replace(joint, **law) for joint in scene.joints)
    return msgspec.structs.replace(scene, joints=tuple(joints), clock=clock)


def random_tree(rng: np.random.Generator, kinds: Sequence[Kind], *, links: int = 0) -> Scene:
    """Make a tree with one body a kind, each joined to a random earlier body or the world.

    Body frames are off the centres of mass and turned, inertias are full, joints point either
    way. `links` adds that many distance links between random bodies, which close loops.
    """
    bodies = tuple(_body(rng, f"body{k}") for k in range(len(kinds)))
    names = ["world", *(body.name for body in bodies)]
    joints = tuple(
        _joint(rng, kind, names[rng.integers(k + 1)], names[k + 1])
        for k, kind in enumerate(kinds)
        if kind != "free"
    )
    pairs = [rng.permutation(len(names))[:2] for _ in range(links)]
    return Scene(
        name="random tree",
        length=1.0,
        bodies=bodies,
        joints=tuple(joints[k] for k in rng.permutation(len(joints))),
        distance_links=tuple(
            DistanceLink(f"link{k}", (names[a], names[b]), (_vector(rng), _vector(rng)))
            for k, (a, b) in enumerate(pairs)
        ),
    )


def random_links(
    rng: np.random.Generator, mechanism: Mechanism, lead: tuple[int, ...]
) -> LinkStates:
    """Draw states of a tree, with the columns that a joint's kind does not use at zero."""
    shape = (*lead, mechanism.body_count)
    kinds = np.array(
        ["free" if link.joint is None else link.joint.kind for link in mechanism.links]
    )
    turns, free = np.isin(kinds, ["ball", "free"]), kinds == "free"
    slides = np.isin(kinds, ["hinge", "slider"])
    quaternion = rng.standard_normal((*shape, 4))
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return LinkStates(
        rotation=np.where(turns[:, None], quaternion, [1.0, 0.0, 0.0, 0.0]),
        angular_velocity=rng.standard_normal((*shape, 3)) * turns[:, None],
        coordinate=rng.uniform(-3.0, 3.0, shape) * slides,
        rate=rng.standard_normal(shape) * slides,
        position=rng.standard_normal((*shape, 3)) * free[:, None],
        velocity=rng.standard_normal((*shape, 3)) * free[:, None],
    )


def _vector(rng: np.random.Generator) -> tuple[float, float, float]:
    x, y, z = rng.standard_normal(3).tolist()
    return (x, y, z)


def _body(rng: np.random.Generator, name: str) -> Body:
    # The inertia of four random point masses: full, physical and far from isotropic.
    points = rng.standard_normal((4, 3))
    tensor = np.eye(3) * np.sum(points**2) - points.T @ points
    w, x, y, z = rng.standard_normal(4)
    norm = float(np.sqrt(w * w + x * x + y * y + z * z))
    return Body(
        name,
        inertia=Inertia(
            mass=float(rng.uniform(0.5, 3.0)),
            moments=(float(tensor[0, 0]), float(tensor[1, 1]), float(tensor[2, 2])),
            products=(float(tensor[0, 1]), float(tensor[0, 2]), float(tensor[1, 2])),
            com=_vector(rng),
        ),
        position=_vector(rng),
        orientation=(float(w) / norm, float(x) / norm, float(y) / norm, float(z) / norm),
    )


def _joint(
    rng: np.random.Generator,
    kind: Literal["fixed", "hinge", "slider", "ball"],
    inner: str,
    outer: str,
) -> Joint:
    parent, child = (inner, outer) if rng.random() < 0.5 else (outer, inner)
    axis = _vector(rng) if kind in ("hinge", "slider") else None
    return Joint(f"{inner}-{outer}", kind, parent, child, _vector(rng), axis)
