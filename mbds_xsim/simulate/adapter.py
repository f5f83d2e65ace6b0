"""What an adapter is: a neutral scene goes in, a run that makes trajectories comes out."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from importlib.metadata import version
from types import TracebackType
from typing import Any, ClassVar, Literal, Self, SupportsFloat, final

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.errors import InputError, UnknownName, Unsupported
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory

Array = NDArray[np.float64]
Profile = Literal["native", "matched"]
Family = Literal[
    "semi-implicit Euler", "implicit Euler", "RK4", "Runge-Kutta 5(4)", "Runge-Kutta 6(7)",
    "generalised-alpha", "trapezoidal", "toolkit RK4",
]  # fmt: skip


class Feature(Enum):
    """What a scene can ask of an engine."""

    BALL = "ball joint"
    HINGE = "hinge joint"
    SLIDER = "slider joint"
    FIXED = "fixed joint"
    FREE_BODY = "free body"
    LOOP_BALL = "loop closed by a ball joint"
    LOOP_HINGE = "loop closed by a hinge"
    LOOP_SLIDER = "loop closed by a slider"
    LOOP_FIXED = "loop closed by a fixed joint"
    DISTANCE_LINK = "distance link"
    SPRING_DAMPER = "spring–damper"
    FORCE = "force at the centre of mass"
    HINGE_TORQUE = "hinge torque"
    FULL_INERTIA = "inertia not along the body frame"
    CONTACT = "sphere on the ground"


LOOPS = frozenset(feature for feature in Feature if feature.name.startswith("LOOP_"))
"""Every way of closing a loop."""


def features_of(scene: Scene) -> frozenset[Feature]:
    """List what the scene needs; forces count where sampling, noise or tables can make one."""
    mechanism = Mechanism.of(scene)
    tree = [link.joint for link in mechanism.links]
    kinds = {Feature[joint.kind.upper()] for joint in tree if joint is not None}
    kinds |= {Feature[f"LOOP_{joint.kind.upper()}"] for joint in mechanism.loops}
    diagonal = np.einsum("kii->ki", mechanism.inertia)[:, :, None] * np.eye(3)
    draws = {draw.__struct_config__.tag for draw in scene.sampling}
    asked = {
        Feature.FREE_BODY: None in tree,
        Feature.DISTANCE_LINK: bool(scene.distance_links),
        Feature.SPRING_DAMPER: bool(scene.springs),
        Feature.FORCE: bool(scene.forces) or scene.noise > 0 or "wind" in draws,
        Feature.HINGE_TORQUE: bool(scene.torques) or "hinge_torque" in draws,
        Feature.FULL_INERTIA: not np.allclose(mechanism.inertia, diagonal, rtol=0, atol=1e-14),
        Feature.CONTACT: bool(scene.contacts),
    }
    return frozenset(kinds | {feature for feature, needed in asked.items() if needed})


@dataclass(frozen=True)
class Method:
    """One way of stepping, with the claims that the contract suite measures."""

    name: str
    family: Family
    """Methods of one family are one vote: their agreement is no evidence."""
    order: int
    """Order of convergence on smooth scenes that the method can run."""
    refuses: Mapping[Feature, str] = field(default_factory=dict)
    """Features that this method, unlike the engine, cannot do, with the reason."""
    loop_order: int | None = None
    """Order where constraints are solved beside the coordinates, if it differs."""
    loop_velocity_order: int | None = None
    """Order of the velocities there, if it is lower than that of the positions."""
    velocity_lag: float = 0.0
    """Recorded velocities belong to (frame time + lag · step): −½ for a leapfrog's."""
    own: bool = True
    """Whether the engine itself steps. What the toolkit steps is never matched by a search: it
    says nothing about the engine's stepping."""

    def order_for(self, scene: Scene) -> int:
        """Order that holds for a scene."""
        constrained = self.loop_order is not None and _constrained(scene)
        return self.loop_order if constrained and self.loop_order is not None else self.order

    def velocity_order_for(self, scene: Scene) -> int:
        """Order to which a scene's velocities may be down, where they carry constraint forces."""
        order = self.order_for(scene)
        lower = self.loop_velocity_order
        return min(order, lower) if lower is not None and _constrained(scene) else order


def _constrained(scene: Scene) -> bool:
    mechanism = Mechanism.of(scene)
    return bool(mechanism.loops or mechanism.distances)


@dataclass(frozen=True)
class Settings:
    """How an engine steps a scene."""

    method: str
    step: float
    """[s]; divides the frame interval."""
    options: Mapping[str, float | int | bool | str] = field(default_factory=dict)
    """The method's own knobs, as `Adapter.options` lists them; what is left out has its default."""

    def substeps(self, frame: float) -> int:
        """Steps in a frame; raise InputError where the step does not divide it."""
        number = isinstance(self.step, SupportsFloat) and math.isfinite(self.step)
        count = round(frame / self.step) if number and self.step > 0 else 0
        if count < 1 or abs(count * self.step - frame) > 1e-9 * frame:
            msg = (
                f"step: got {self.step!r} s, allowed is the frame interval {frame} s divided by a "
                "whole number"
            )
            raise InputError(msg)
        return count


@dataclass(frozen=True)
class Option:
    """A knob of an adapter: its default, what it does and which values it takes.

    Values are of the default's kind: true or false, a whole number, a finite number or a name.
    """

    default: float | int | bool | str
    meaning: str
    least: float | None = None
    """Smallest number allowed; None sets no bound, here and below."""
    most: float | None = None
    above: float | None = None
    """Bound that numbers must exceed."""
    names: tuple[str, ...] = ()
    """All names allowed."""

    def check(self, what: str, value: object) -> None:
        """Raise InputError, which calls the option `what`, unless the value is allowed."""
        if self.names:
            if value not in self.names:
                raise UnknownName.of(what, str(value), list(self.names))
        elif not (self._kind_fits(value) and self._is_within(value)):
            raise InputError(f"{what}: got {value!r}, allowed is {self._allowed()}")

    def _kind_fits(self, value: object) -> bool:
        if isinstance(self.default, bool | str):
            return isinstance(value, type(self.default))
        number = int if isinstance(self.default, int) else int | float
        return isinstance(value, number) and not isinstance(value, bool) and math.isfinite(value)

    def _is_within(self, value: Any) -> bool:
        return (
            (self.least is None or value >= self.least)
            and (self.most is None or value <= self.most)
            and (self.above is None or value > self.above)
        )

    def _allowed(self) -> str:
        if isinstance(self.default, bool | str):
            return "true or false" if isinstance(self.default, bool) else "a text"
        kind = "a whole number" if isinstance(self.default, int) else "a finite number"
        bounds = {"more than": self.above, "at least": self.least, "at most": self.most}
        told = [f"{word} {bound:g}" for word, bound in bounds.items() if bound is not None]
        return ", ".join([kind, *([" and ".join(told)] if told else [])])


@dataclass(frozen=True)
class Sweep:
    """Values of an option that are worth trying, one at a time, in place of the one in use."""

    values: tuple[float | int | bool | str, ...]
    methods: tuple[str, ...] = ()
    """Methods that the option acts on; all where none is named."""
    needs: frozenset[Feature] = frozenset()
    """The option acts where a scene needs any of these; everywhere where none is named."""


@dataclass(frozen=True)
class ContactScales:
    """How finely an engine resolves contact; the contract suite derives from it what it allows."""

    time: float
    """Over which it spreads an impact: the step where contact is rigid, and as long as a spring
    takes to push a sphere out where it is compliant [s]."""
    slip: float = 0.0
    """Slip up to which friction is less than Coulomb's [m/s]."""


@dataclass(frozen=True)
class ContactLaw:
    """What contact is in an engine, in words; `mbds-xsim contact` measures it."""

    normal: str
    """How a sphere is kept out of the ground."""
    restitution: str
    """What decides the rebound."""
    friction: str
    """In which set the friction force is."""
    mixing: str
    """How the coefficients of two bodies become those of the pair."""
    adapter: str
    """What the adapter does about it, in sentences."""


@dataclass(frozen=True, eq=False)
class Readback:
    """The native model as the engine holds it, in the toolkit's conventions.

    `mbds_xsim.simulate.readback.compare` holds it against the scene before the first step. What an
    engine has no way of telling is None.
    """

    mass: Array
    """[kg], shape (body,)."""
    inertia: Array
    """About the centre of mass in native frames [kg·m²], shape (body, 3, 3)."""
    com: Array
    """In W with the engine's model put at the batch's first start [m], shape (body, 3)."""
    orientation: Array
    """At that start, published convention, shape (body, 4)."""
    velocity: Array
    """At that start [m/s], shape (body, 3)."""
    angular_velocity: Array
    """At that start [rad/s], shape (body, 3)."""
    gravity: Array | None
    """[m/s²], shape (3,)."""
    step: float | None
    """[s]"""
    joint_axis: Array | None
    """Of hinges and sliders in scene order, in W at that start, shape (joint, 3); NaN where a
    loop joint has no native counterpart."""
    damping: Array | None
    """Every damping coefficient the engine reports; all must be 0, shape (any,)."""
    contact: Array | None = None
    """Radius [m], friction and restitution of each contact sphere on the ground, in scene order;
    NaN where the engine has no such coefficient. Shape (sphere, 3)."""
    sphere: Array | None = None
    """Centres of the contact spheres, in scene order and in W at that start [m], (sphere, 3)."""
    anchor: Array | None = None
    """Anchors of the joints in scene order, as fixed in the parent and in the child, in W at that
    start [m], shape (joint, 2, 3); NaN where a joint has no native counterpart that tells."""
    spring: Array | None = None
    """Stiffness [N/m], damping [N·s/m], rest length [m] and length at that start [m] of the
    springs in scene order, shape (spring, 4). Where an engine has none, what the adapter that
    applies them goes by."""


@dataclass(frozen=True)
class ModelSize:
    """Size of the native model."""

    coordinates: int
    """Velocity coordinates."""
    constraints: int
    """Constraint rows solved beside them."""
    contact_pairs: int = 0


class Run(ABC):
    """A loaded scene. The only owner of engine memory; use it in a `with` block."""

    size: ModelSize

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @abstractmethod
    def rollout(self, batch: Batch) -> Trajectory:
        """Simulate every trajectory of the batch over its `steps` recorded steps.

        Frame 0 is the start as the engine holds it. A blow-up, NaN, engine warning or silent
        clamp ends that trajectory with a `Failure`; it never raises and never touches the others.
        The result's arrays are the caller's. Calling again starts afresh: same batch, same bits.
        """

    @abstractmethod
    def readback(self, batch: Batch) -> Readback:
        """Put the model at the batch's first start and read the native model back."""

    @abstractmethod
    def native(self, batch: Batch) -> str:
        """Exactly what the engine is given, at the batch's first start, to run without us.

        A file of the engine's own format, or a Python script that simulates the scene's frames
        without inputs and then prints the bodies' states.
        """

    @abstractmethod
    def close(self) -> None:
        """Free the engine's memory; a second call does nothing."""


class Adapter(ABC):
    """An engine: stateless, its claims are class attributes."""

    name: ClassVar[str]
    """Entry point, extra, file name and attribute in files."""
    package: ClassVar[str]
    """Distribution on the package index."""
    revision: ClassVar[int] = 1
    """Raised in the change that makes the adapter's motions differ: kept results are made anew."""
    methods: ClassVar[Mapping[str, Method]]
    """By name; the first is the one `matched` prefers."""
    options: ClassVar[Mapping[str, Option]]
    sweeps: ClassVar[Mapping[str, Sweep]] = {}
    """By option: what trade-off charts try. Options that decide between speed and accuracy."""
    limits: ClassVar[Mapping[Feature, str]]
    """Features that the engine cannot represent, with the reason."""
    coordinates: ClassVar[Literal["reduced", "maximal"]]
    contact_law: ClassVar[ContactLaw | None] = None
    """None without contact."""
    smallest: ClassVar[str] = "none that a scene file can name is too small"
    """Which masses and moments of inertia the engine holds; `too_small` finds others."""

    @final
    def open(self, scene: Scene, settings: Settings) -> Run:
        """Check that the engine can do it, then load it.

        Raises:
            Unsupported: The engine or the method cannot represent the scene.
            InputError: The settings are wrong (method, step, option).
        """
        self.check(scene, settings)
        return self.load(scene, settings)

    @final
    def check(self, scene: Scene, settings: Settings) -> None:
        """Raise as `open` would, without loading anything."""
        if settings.method not in self.methods:
            raise UnknownName.of(f"method of {self.name}", settings.method, sorted(self.methods))
        for key, value in settings.options.items():
            if key not in self.options:
                raise UnknownName.of(f"option of {self.name}", key, sorted(self.options))
            self.options[key].check(f"option {key} of {self.name}", value)
        settings.substeps(scene.clock.frame)
        refusals = self.refusals(scene, settings.method)
        if refusals:
            feature, reason = next(iter(refusals.items()))
            msg = f"{self.name} {settings.method} cannot do {feature.value}: {reason}"
            raise Unsupported(msg)
        small = self.too_small(scene)
        if small:
            raise Unsupported(f"{self.name} cannot do so small a body: {small}")

    @final
    def refusals(self, scene: Scene, method: str) -> dict[Feature, str]:
        """Give what the scene needs and the method cannot do, each with the reason."""
        missing = {**self.limits, **self.methods[method].refuses}
        needs = features_of(scene)
        return {feature: missing[feature] for feature in Feature if feature in needs & set(missing)}

    @final
    def option(self, settings: Settings, name: str) -> Any:
        """Value of an option, or its default."""
        return settings.options.get(name, self.options[name].default)

    def too_small(self, scene: Scene) -> str:
        """Name a body that is smaller than the engine can hold, and what it holds; "": none is."""
        del scene
        return ""

    def contact_scales(self, settings: Settings) -> ContactScales:
        """Tell how finely contact is resolved; impulses of one step unless an adapter says so."""
        return ContactScales(settings.step)

    def version(self) -> str:
        """Version of the installed engine: that of its distribution unless an adapter says so."""
        return version(self.package)

    @abstractmethod
    def settings(self, scene: Scene, profile: Profile) -> Settings:
        """Preset without a search: `native` is what an ordinary user of the engine gets,
        `matched` a careful choice for a scene that has none stored.
        """

    @abstractmethod
    def load(self, scene: Scene, settings: Settings) -> Run:
        """Build the native model. Called by `open` only, after its checks."""
