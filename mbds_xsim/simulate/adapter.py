"""The adapter contract: a neutral scene goes in, a run that makes trajectories comes out."""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any, ClassVar, Literal, Self, SupportsFloat, final

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.base.errors import InputError, Unsupported, check_name
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import CUT, JointKind, Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate.claims import (
    ContactLaw,
    ContactScales,
    Feature,
    Method,
    Option,
    Sweep,
    features_of,
)

Profile = Literal["native", "matched"]

version_of = functools.cache(version)
"""Version of an installed distribution, cached since reading it takes milliseconds."""

_REFINABLE = 4
# Shortest step of a preset [s]: 20 000 in a frame of 20 ms; even shorter ones cost too much.
_SHORTEST = 1e-6
MOST_STEPS = 10**9
"""Largest number of steps in a frame: engines count in 32 bits, and this many take hours."""
# A body that crosses so many scene lengths in a frame has blown up.
_LENGTHS_PER_FRAME = 1e3


@dataclass(frozen=True)
class Settings:
    """Method, step and options with which an engine steps a scene."""

    method: str
    step: float
    """Integration step [s]; divides the frame interval."""
    options: Mapping[str, float | int | bool | str] = field(default_factory=dict)
    """Options of the method, as listed in `Adapter.options`; omitted ones have their default."""

    def substeps(self, frame: float) -> int:
        """Return the steps in a frame; raise InputError if the step does not divide it."""
        number = isinstance(self.step, SupportsFloat) and math.isfinite(self.step)
        count = round(frame / self.step) if number and self.step > frame / MOST_STEPS else 0
        if count < 1 or abs(count * self.step - frame) > 1e-9 * frame:
            raise InputError(
                f"step: got {self.step!r} s, allowed is the frame interval {frame} s divided by a "
                f"whole number below {MOST_STEPS:.0e}"
            )
        return count


@dataclass(frozen=True, eq=False)
class Readback:
    """The native model as the engine holds it, in the toolkit's conventions.

    `mbds_xsim.simulate.readback.compare` compares it with the scene before the first step. Fields
    that an engine cannot report are None.
    """

    mass: Array
    """Masses [kg], shape (body,)."""
    inertia: Array
    """Inertia about the centre of mass in native frames [kg·m²], shape (body, 3, 3)."""
    com: Array
    """Centres of mass in W with the model at the batch's first start [m], shape (body, 3)."""
    orientation: Array
    """Orientations at that start, published convention, shape (body, 4)."""
    velocity: Array
    """Velocities of the centres of mass at that start [m/s], shape (body, 3)."""
    angular_velocity: Array
    """Angular velocities in W at that start [rad/s], shape (body, 3)."""
    gravity: Array | None
    """Gravity in W [m/s²], shape (3,)."""
    step: float | None
    """Integration step [s]."""
    joint_axis: Array | None
    """Axes of hinges and sliders in scene order, in W at that start, shape (joint, 3); NaN if a
    loop joint has no native counterpart."""
    damping: Array | None
    """Every damping coefficient that the engine reports, minus the scene's; all must be 0,
    shape (any,)."""
    contact: Array | None = None
    """Radius [m], friction and restitution of each contact sphere on the ground, in scene order;
    NaN if the engine, or the scene, has no such coefficient. Shape (sphere, 3)."""
    collision: Array | None = None
    """Friction and restitution of each of `Mechanism.sphere_pairs`, as above, shape (pair, 2)."""
    sphere: Array | None = None
    """Centres of the contact spheres, in scene order and in W at that start [m], (sphere, 3)."""
    anchor: Array | None = None
    """Anchors of the joints in scene order, as fixed in the parent and in the child, in W at that
    start [m], shape (joint, 2, 3); NaN if no native counterpart of a joint reports it."""
    spring: Array | None = None
    """Stiffness [N/m], damping [N·s/m], rest length [m] and length at that start [m] of the
    springs in scene order, shape (spring, 4). If an engine has none, the values with which the
    adapter applies them."""
    law: Array | None = None
    """Stiffness, damping and coordinate at rest of `Mechanism.compliant` [N·m/rad or N/m,
    N·m·s/rad or N·s/m, rad or m], shape (joint, 3); as for `spring`."""
    armature: Array | None = None
    """Armature of `Mechanism.rotors` [kg·m² or kg], shape (joint,)."""
    friction: Array | None = None
    """Dry friction of `Mechanism.frictional` [N·m or N], shape (joint,)."""
    limits: Array | None = None
    """Lower and upper limits of `Mechanism.limited` [rad or m], shape (joint, 2)."""
    drive: Array | None = None
    """Stiffness, damping, limit (0: none) of `Mechanism.drives`, (drive, 3); as for `spring`."""
    coupling: Array | None = None
    """Ratio and offset (NaN if not reported) of `Mechanism.couplings`, shape (coupling, 2)."""


@dataclass(frozen=True)
class ModelSize:
    """Size of the native model."""

    coordinates: int
    """Number of velocity coordinates."""
    constraints: int
    """Number of constraint rows solved in addition."""
    contact_pairs: int = 0


class Run(ABC):
    """A loaded scene and the only owner of engine memory; use it in a `with` block."""

    size: ModelSize

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @abstractmethod
    def rollout(self, batch: Batch) -> Trajectory:
        """Simulate every trajectory of the batch over its `steps` recorded steps.

        Frame 0 is the start as the engine holds it. A blow-up, NaN, engine warning or silent
        clamp ends that trajectory with a `Failure`; it never raises and never affects the others.
        The result's arrays are the caller's, and the batch's stay as they are. Calling again starts
        afresh: same batch, same bits.
        """

    @abstractmethod
    def readback(self, batch: Batch) -> Readback:
        """Put the model at the batch's first start and read the native model back."""

    @abstractmethod
    def native(self, batch: Batch) -> str:
        """Return the exact engine input at the batch's first start, to run without the toolkit.

        It is a file in the engine's own format, or a Python script that simulates the scene's
        frames without inputs and then prints the bodies' states.
        """

    @abstractmethod
    def close(self) -> None:
        """Free the engine's memory; a second call does nothing."""


class Adapter(ABC):
    """An engine behind the common contract; stateless, with its claims as class attributes."""

    name: ClassVar[str]
    """Name of the engine as entry point, extra, file name and attribute in files."""
    package: ClassVar[str]
    """Name of its distribution on the package index."""
    revision: ClassVar[int] = 1
    """Number raised by any change that affects motions, so that stored results are made anew."""
    methods: ClassVar[Mapping[str, Method]]
    """Methods by name; `matched` prefers the first."""
    options: ClassVar[Mapping[str, Option]]
    sweeps: ClassVar[Mapping[str, Sweep]] = {}
    """Values that trade-off charts try, for options that trade speed for accuracy."""
    limits: ClassVar[Mapping[Feature, str]]
    """Features that the engine cannot represent, with the reason."""
    coordinates: ClassVar[Literal["reduced", "maximal"]]
    cut: ClassVar[tuple[JointKind, ...]] = CUT
    """All joint kinds, those first that the engine prefers for closing loops:
    `Mechanism.of(scene, cut)` builds that tree, and `limits` refer to it."""
    contact_law: ClassVar[ContactLaw | None] = None
    """Contact law in words; None without contact."""
    smallest: ClassVar[str] = "any mass that a scene file allows"
    """Masses, moments of inertia and other values that the engine can hold, in words; `cannot_hold`
    finds values that it cannot."""

    @final
    def open(self, scene: Scene, settings: Settings) -> Run:
        """Check that the engine can simulate the scene, then load it.

        Raises:
            Unsupported: The engine or the method cannot represent the scene.
            InputError: The settings are wrong (method, step, option).
        """
        self.check(scene, settings)
        return self.load(scene, settings)

    @final
    def check(self, scene: Scene, settings: Settings) -> None:
        """Raise as `open` would, without loading anything."""
        self.check_options(settings.method, settings.options)
        settings.substeps(scene.clock.frame)
        refusals = self.refusals(scene, settings.method)
        if refusals:
            feature, reason = next(iter(refusals.items()))
            raise Unsupported(f"{self.name} {settings.method} cannot do {feature.value}: {reason}")
        value = self.cannot_hold(scene)
        if value:
            raise Unsupported(f"{self.name} cannot represent a value of the scene: {value}")

    @final
    def check_options(self, method: str, options: Mapping[str, object]) -> None:
        """Raise InputError for a method, an option or a value that the adapter does not have."""
        check_name(f"method of {self.name}", method, sorted(self.methods))
        for key, value in options.items():
            check_name(f"option of {self.name}", key, sorted(self.options))
            self.options[key].check(f"option {key} of {self.name}", value)

    @final
    def refusals(self, scene: Scene, method: str) -> dict[Feature, str]:
        """Return the features that the scene needs and the method lacks, each with the reason."""
        missing = {**self.limits, **self.methods[method].refuses}
        needs = features_of(scene, self.cut)
        return {feature: missing[feature] for feature in Feature if feature in needs & set(missing)}

    @final
    def option(self, settings: Settings, name: str) -> Any:
        """Return the value of an option, or its default."""
        return settings.options.get(name, self.options[name].default)

    def cannot_hold(self, scene: Scene) -> str:
        """Name a scene value that the engine cannot hold, and what it can; "" if there is none.

        Examples are the mass of a body that is too small, or a spring without a rest length.
        """
        del scene
        return ""

    def contact_scales(self, settings: Settings) -> ContactScales:
        """Return how finely contact is resolved; by default, impacts last one step."""
        return ContactScales(settings.step)

    def version(self) -> str:
        """Return the version of the installed engine, by default that of its distribution."""
        return version_of(self.package)

    @abstractmethod
    def settings(self, scene: Scene, profile: Profile) -> Settings:
        """Return a preset without a search.

        `native` is what an ordinary user of the engine gets, `matched` a careful choice for scenes
        without stored settings.
        """

    @abstractmethod
    def load(self, scene: Scene, settings: Settings) -> Run:
        """Build the native model. Called by `open` only, after its checks."""


def nearest_step(frame: float, usual: float) -> float:
    """Divide a frame [s] into equal steps as close as possible to the usual one [s]."""
    return frame / max(1, round(frame / usual))


def careful_step(frame: float, longest: float, fewest: int) -> float:
    """Divide a frame [s] into at least `fewest` equal steps, none longer than `longest` [s].

    A longest step below 1 µs counts as 1 µs. Frames resolve the motion, so `fewest` gives finer
    steps to fast mechanisms. The number is a multiple of four, so that the consistency check can
    use coarser steps.
    """
    count = max(fewest, math.ceil(frame / max(longest, _SHORTEST) - 1e-9))
    return frame / (_REFINABLE * math.ceil(count / _REFINABLE))


def recorded(
    mechanism: Mechanism, bodies: BodyStates, failures: tuple[Failure | None, ...]
) -> Trajectory:
    """Make a trajectory from body states of shape (trajectory, frame, body, …).

    Frames from a failure on become NaN, in the given arrays as well.
    """
    motion = Trajectory(
        mechanism.scene.clock.frame * np.arange(bodies.position.shape[1], dtype=np.float64),
        bodies.position,
        mechanism.body_orientation(bodies.native),
        bodies.velocity,
        bodies.angular_velocity,
        failures,
    )
    return motion.cut_at_failures()


def until_blow_up(
    mechanism: Mechanism, bodies: BodyStates, reported: Sequence[Failure | None] = ()
) -> Trajectory:
    """Make a trajectory that ends where it blows up, or earlier if the engine reported a failure.

    Args:
        mechanism: Mechanism of the scene.
        bodies: States, shape (trajectory, frame, body, …); the start is as it was given.
        reported: Failures that the engine reported, one per trajectory; empty if it reports none.
    """
    bad = too_fast(mechanism, bodies.velocity)
    blown = first_failures(bad, lambda *_: blow_up(mechanism), earliest=1)
    return recorded(mechanism, bodies, earlier(reported, blown) if reported else blown)


def earlier(
    one: Sequence[Failure | None], other: Sequence[Failure | None]
) -> tuple[Failure | None, ...]:
    """Return the earlier of two failures of each trajectory."""
    both = (filter(None, pair) for pair in zip(one, other, strict=True))
    return tuple(min(failures, key=lambda end: end.frame, default=None) for failures in both)


def first_failures(
    bad: Mask, reason: Callable[[int, int], str], *, earliest: int = 0
) -> tuple[Failure | None, ...]:
    """Turn each trajectory's first bad frame into a failure.

    Args:
        bad: Whether a frame is bad, shape (trajectory, frame).
        reason: Function that says what is wrong, given row and frame.
        earliest: Earliest frame of a failure; 1 if the start is recorded as it was given.
    """
    first = bad.argmax(axis=1).tolist()
    return tuple(
        Failure(max(earliest, frame), reason(row, frame)) if bad[row, frame] else None
        for row, frame in enumerate(first)
    )


def blow_up(mechanism: Mechanism) -> str:
    """Return the reason of a failure for frames that `too_fast` finds."""
    return f"a body's speed passes {_top_speed(mechanism):.3g} m/s or is not a number"


def too_fast(mechanism: Mechanism, velocity: Array) -> Mask:
    """Find the frames of a blow-up; a NaN counts as one.

    Args:
        mechanism: Mechanism of the scene.
        velocity: Velocities of the bodies [m/s], shape (…, body, 3).
    """
    return ~(rotation.norm(velocity).max(axis=-1) < _top_speed(mechanism))


def _top_speed(mechanism: Mechanism) -> float:
    scene = mechanism.scene
    return _LENGTHS_PER_FRAME * scene.length / scene.clock.frame
