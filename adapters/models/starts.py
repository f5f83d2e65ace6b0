"""How trajectories of an imported model start: random poses inside its limits, at small rates."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import msgspec
import numpy as np

from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.assembly import assemble
from mbds_xsim.scene.draft import UPRIGHT, outboard
from mbds_xsim.scene.imported import Fate
from mbds_xsim.scene.joint_space import BodyStates, joint_coordinate
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import Draw, HingeRate, Levels, Lift, Pose, Throw
from mbds_xsim.scene.scene import Scene

_SHARES = (0.25, 0.5, 0.9)
"""Of a joint's range about its middle, in the intervals low, medium and high."""
_RATES = (0.1, 0.5, 1.0)
"""Largest rates of hinges and free bodies in these intervals [rad/s]."""
_HEIGHTS = (0.01, 0.05, 0.1, 0.2)
"""What is left to fall in these intervals, from one to the next, over the scene's length."""
_TRIED = 30
"""Starts of which none may be in the ground."""


def starts(scene: Scene, limits: Mapping[str, tuple[float, float]]) -> tuple[Draw, ...]:
    """Give the draws: poses of the joints that nothing ties, then rates of hinges and bodies.

    A hinge without limits turns by half a turn either way, a slider goes a tenth of the scene's
    length; with wider limits it goes no farther, a slider the whole length.

    Args:
        scene: The scene.
        limits: Of joints by name, counted from the reference pose.
    """
    mechanism, length = Mechanism.of(scene), scene.length
    looped = _looped(mechanism)
    joints = [j for link in mechanism.links if (j := link.joint) is not None]
    moving = [j for j in joints if j.kind in ("hinge", "slider") and not j.coupled]
    alone = [j for j in moving if j.child not in looped]
    ranges = defaultdict(list)
    for joint in alone:
        usual, most = (math.pi, math.pi) if joint.kind == "hinge" else (0.1 * length, length)
        low, high = limits.get(joint.name, (-usual, usual))
        near = max(low, -most), min(high, most)
        ranges[near if near[0] < near[1] else (low, high)].append(joint.name)
    poses = [Pose(tuple(names), _levels(*span)) for span, names in ranges.items()]
    hinges = tuple(joint.name for joint in alone if joint.kind == "hinge")
    turning = [HingeRate(hinges, _levels(-1.0, 1.0, _RATES))] if hinges else []
    spin = _levels(-1.0, 1.0, _RATES)
    thrown = [Throw(body, angular_velocity=(spin, spin, spin)) for body in _free(mechanism)]
    falls = Levels(*((low * length, high * length) for low, high in pairwise(_HEIGHTS)))
    lifted = [Lift(body, falls) for body in _lifted(mechanism)]
    return (*poses, *turning, *thrown, *lifted)


def _levels(low: float, high: float, shares: Sequence[float] = _SHARES) -> Levels:
    middle, half = (low + high) / 2, (high - low) / 2
    spans = ((middle - share * half, middle + share * half) for share in shares)
    return Levels(*spans)


def _looped(mechanism: Mechanism) -> set[int]:
    """Give the bodies whose joint of the tree is in a loop: it cannot be led alone."""
    parent = {link.body: link.parent for link in mechanism.links}
    looped: set[int] = set()
    ties = [(loop.parent, loop.child) for loop in mechanism.loops]
    for ends in [*ties, *(pair.bodies for pair in mechanism.distances)]:
        first, second = (set(_path(parent, end)) for end in ends)
        looped |= first ^ second
    return looped


def _path(parent: Mapping[int, int], body: int) -> Iterator[int]:
    while body != WORLD_INDEX:
        yield body
        body = parent[body]


def _free(mechanism: Mechanism) -> Iterator[str]:
    """Give the free bodies, where nothing ties one to the world or to another."""
    tied = {end for loop in mechanism.loops for end in (loop.parent, loop.child)}
    for link in mechanism.links:
        if link.joint is None and WORLD_INDEX not in tied and not mechanism.distances:
            yield mechanism.scene.bodies[link.body].name


def _lifted(mechanism: Mechanism) -> Iterator[str]:
    """Give what can be lifted off the ground: free bodies, and those on upright sliders."""
    level = {WORLD_INDEX}
    for link in mechanism.links:
        joint, carried = link.joint, outboard(mechanism, link.body)
        if joint is not None and (joint.kind != "slider" or link.parent not in level):
            continue
        level |= {link.body} if joint is not None else set()
        upright = joint is None or abs(joint.axis[2]) > UPRIGHT
        if upright and np.isin(mechanism.sphere_body, carried).any():
            yield mechanism.scene.bodies[link.body].name


def check_above_ground(scene: Scene) -> None:
    """Raise InputError where draws lead what nothing lifts into the ground."""
    if scene.ground is None:
        return
    mechanism, batch = Mechanism.of(scene), draw_batch(scene, range(_TRIED))
    states = BodyStates.of(mechanism, batch)
    low = mechanism.sphere_heights(states.position, states.native) - mechanism.sphere_radius
    if low.min() < 0.0:
        body = scene.contacts[int(low.min(axis=0).argmin())].body
        msg = (
            f"--ground: of {_TRIED} drawn starts {np.count_nonzero(low.min(axis=1) < 0)} are in "
            f"the ground, {body!r} by {-low.min():.3g} m: it is neither free nor on an upright "
            "slider, which would be lifted; leave --ground out"
        )
        raise InputError(msg)


_PAST = "its start, which a loop or a coupling decides, is past them"


def kept_limits(scene: Scene, label: tuple[str, str]) -> tuple[Scene, list[Fate]]:
    """Give the scene without limits that its start breaks, and what becomes of these.

    Args:
        scene: With the draws of its starts, which are within the limits.
        label: Element and attribute of limits in the format.
    """
    broken = {*_broken(scene)}
    if not broken:
        return scene, []
    joints = (
        msgspec.structs.replace(joint, limits=None) if joint.name in broken else joint
        for joint in scene.joints
    )
    element, attribute = label
    fate = Fate(element, (attribute,), "dropped", _PAST, True, tuple(sorted(broken)), len(broken))
    return msgspec.structs.replace(scene, joints=tuple(joints)), [fate]


def _broken(scene: Scene) -> Iterator[str]:
    drawn = {name for draw in scene.sampling if isinstance(draw, Pose) for name in draw.joints}
    mechanism = Mechanism.of(scene)
    tied = [joint for joint in mechanism.limited if joint.name not in drawn]
    start = assemble(mechanism) if tied else None
    for joint in tied:
        assert start is not None
        if joint.beyond(joint_coordinate(joint, start.position, start.native)) > 0.0:
            yield joint.name
