"""Starts for an imported model: random poses inside its limits, at small rates."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import msgspec
import numpy as np

from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.assembly import assemble
from mbds_xsim.scene.coupling import PlacedCoupling, trains
from mbds_xsim.scene.draft import UPRIGHT, outboard
from mbds_xsim.scene.imported import Fate
from mbds_xsim.scene.joint_space import BodyStates, joint_coordinate
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import Draw, HingeRate, Levels, Lift, Pose, Throw
from mbds_xsim.scene.scene import Scene

_SHARES = (0.25, 0.5, 0.9)
"""Share of a joint's range, about its middle, that the intervals low, medium and high cover."""
_RATES = (0.1, 0.5, 1.0)
"""Largest rates of hinges, with all hinges that follow them, and of free bodies [rad/s]."""
_HEIGHTS = (0.01, 0.05, 0.1, 0.2)
"""Heights above the ground that bound these intervals, over the scene's length."""
_ROUNDED = 1e-9
"""Deviation from a limit that starts are allowed [rad or m]."""
_STARTS = 30
"""Number of starts that are checked not to be in the ground."""


def starts(scene: Scene, limits: Mapping[str, tuple[float, float]]) -> tuple[Draw, ...]:
    """Return the draws: poses of joints outside loops that follow none, then rates and heights.

    Without limits, the range of a hinge is half a turn either way, and that of a slider a tenth of
    the scene's length. Limits are cut to half a turn or the whole length, if anything is left.

    Args:
        scene: The scene.
        limits: Limits of joints, keyed by name and counted from the reference pose.
    """
    mechanism, length = Mechanism.of(scene), scene.length
    start = assemble(mechanism)
    looped = _loop_bodies(mechanism)
    outside = [j for link in mechanism.links if (j := link.joint) and j.child not in looped]
    led, outer = trains(mechanism.couplings), {joint.name for joint in outside}
    held = {each.follower.name for train in led.values() for each in train}
    held |= {k for k, train in led.items() if not outer.issuperset(c.follower.name for c in train)}
    independent = [j for j in outside if j.kind in ("hinge", "slider") and j.name not in held]
    ranges = defaultdict(list)
    for joint in independent:
        span = _span(joint, limits, length)
        if joint.name in led:
            span = _common_span(span, led[joint.name], limits, length)
        if span[0] < span[1] or joint.name not in led:
            # Draws add to the start, which offsets of couplings may move off the reference pose.
            at = float(joint_coordinate(joint, start.position, start.native))
            ranges[span[0] - at, span[1] - at].append(joint.name)
    poses = [Pose(tuple(names), _levels(*span)) for span, names in ranges.items()]
    geared = defaultdict(list)
    for joint in independent:
        if joint.kind == "hinge":
            turned = [each for each in led.get(joint.name, ()) if each.follower.kind == "hinge"]
            geared[max([1.0, *(abs(each.ratio) for each in turned)])].append(joint.name)
    spin = _levels(-1.0, 1.0, _RATES)
    rates = [
        HingeRate(tuple(names), _levels(-1.0 / fastest, 1.0 / fastest, _RATES))
        for fastest, names in geared.items()
    ]
    throws = [Throw(body, angular_velocity=(spin, spin, spin)) for body in _free(mechanism)]
    heights = Levels(*((low * length, high * length) for low, high in pairwise(_HEIGHTS)))
    liftable = _liftable_bodies(mechanism, looped) if scene.contacts else ()
    lifts = [Lift(body, heights) for body in liftable]
    return (*poses, *rates, *throws, *lifts)


def _span(
    joint: PlacedJoint, limits: Mapping[str, tuple[float, float]], length: float
) -> tuple[float, float]:
    default, largest = (math.pi, math.pi) if joint.kind == "hinge" else (0.1 * length, length)
    low, high = limits.get(joint.name, (-default, default))
    clipped = max(low, -largest), min(high, largest)
    return clipped if clipped[0] < clipped[1] else (low, high)


def _common_span(
    span: tuple[float, float],
    train: list[PlacedCoupling],
    limits: Mapping[str, tuple[float, float]],
    length: float,
) -> tuple[float, float]:
    """Return the part of a joint's range in which all that follow it are in theirs."""
    for each in train:
        own = _span(each.follower, limits, length)
        ends = sorted((end - each.offset) / each.ratio for end in own)
        span = max(span[0], ends[0]), min(span[1], ends[1])
    return span


def _levels(low: float, high: float, shares: Sequence[float] = _SHARES) -> Levels:
    middle, half = (low + high) / 2, (high - low) / 2
    spans = ((middle - share * half, middle + share * half) for share in shares)
    return Levels(*spans)


def _loop_bodies(mechanism: Mechanism) -> set[int]:
    """Return the bodies whose tree joint is part of a loop and cannot be set alone."""
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
    """Yield the free bodies; none if a loop closes on the world or there are distance links."""
    loop_ends = {end for loop in mechanism.loops for end in (loop.parent, loop.child)}
    for link in mechanism.links:
        if link.joint is None and WORLD_INDEX not in loop_ends and not mechanism.distances:
            yield mechanism.scene.bodies[link.body].name


def _liftable_bodies(mechanism: Mechanism, looped: set[int]) -> Iterator[str]:
    """Yield bodies outside loops that a lift moves: free ones and those on upright sliders."""
    translating = {WORLD_INDEX}
    for link in mechanism.links:
        joint, carried = link.joint, outboard(mechanism, link.body)
        carries = joint is None or (joint.kind == "slider" and not joint.coupled)
        if not carries or (joint is not None and link.parent not in translating):
            continue
        translating |= {link.body} if joint is not None else set()
        upright = joint is None or abs(joint.axis[2]) > UPRIGHT
        if upright and link.body not in looped and np.isin(mechanism.sphere_body, carried).any():
            yield mechanism.scene.bodies[link.body].name


def check_above_ground(scene: Scene) -> None:
    """Raise InputError if drawn starts put a body that no draw lifts into the ground."""
    if scene.ground is None:
        return
    mechanism, batch = Mechanism.of(scene), draw_batch(scene, range(_STARTS))
    states = BodyStates.of(mechanism, batch)
    gaps = mechanism.sphere_heights(states.position, states.native) - mechanism.sphere_radius
    if gaps.min() < 0.0:
        body = scene.contacts[int(gaps.min(axis=0).argmin())].body
        raise InputError(
            f"--ground: {np.count_nonzero(gaps.min(axis=1) < 0)} of {_STARTS} drawn starts are in "
            f"the ground, {body!r} by {-gaps.min():.3g} m: it cannot be lifted, as it is neither "
            "free nor on an upright slider, or a loop holds it; leave --ground out"
        )


_PAST = "its start, which a loop or a coupling decides, is past them"


def drop_limits(scene: Scene, label: tuple[str, str]) -> tuple[Scene, list[Fate]]:
    """Return the scene without the limits that its start violates, and the fate of these.

    Args:
        scene: Scene with its draws, which keep the joints that they pose within their limits.
        label: Element and attribute that state limits in the format.
    """
    broken, (element, attribute) = sorted({*_violated_limits(scene)}), label
    joints = tuple(
        msgspec.structs.replace(joint, limits=None) if joint.name in broken else joint
        for joint in scene.joints
    )
    fates = [Fate(element, (attribute,), "dropped", _PAST, True, (name,)) for name in broken]
    return msgspec.structs.replace(scene, joints=joints), fates


def _violated_limits(scene: Scene) -> Iterator[str]:
    drawn = {name for draw in scene.sampling if isinstance(draw, Pose) for name in draw.joints}
    mechanism = Mechanism.of(scene)
    for lead, train in trains(mechanism.couplings).items():
        drawn |= {each.follower.name for each in train if lead in drawn}
    undrawn = [joint for joint in mechanism.limited if joint.name not in drawn]
    if undrawn:
        start = assemble(mechanism)
        for joint in undrawn:
            if joint.beyond(joint_coordinate(joint, start.position, start.native)) > _ROUNDED:
                yield joint.name
