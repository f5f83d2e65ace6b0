"""Simulators: whatever makes a motion of a scene and a start, be it an engine or a trained model.

Studies take lists of them and need not know which kind each is. An engine's method is one
(`EngineMethod`); a trained model is another, in `mbds_xsim.learn.simulator`, so that only who asks
for models loads torch.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np

from mbds_xsim.base import isolate
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import ModelSize, Profile, Settings
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.claims import RTOL, Method
from mbds_xsim.simulate.timed import WARM_UP, checked, stopwatch

Options = Mapping[str, float | int | bool | str]

NATIVE = "native"
"""Variation that stands for what an ordinary user of an engine gets."""
LEARNED = "learned"
"""Family of trained models."""

_WORTH = 0.1  # of the scene's length: shorter ways are not compared


@dataclass(frozen=True, eq=False)
class Signs:
    """What shows in a motion held against the truth, each of shape (frame,), NaN if unknown.

    All that is left to judge where a simulator gives positions of particles and no bodies.
    """

    time: Array
    """[s]"""
    finite: Mask
    """Whether all numbers of the motion are finite up to this frame."""
    energy: Array
    """Deviation of the energy balance over its scale, with its sign."""
    gap: Array
    """Largest gap of a joint over the scene's length, or angle between its axes [rad]."""
    sunk: Array
    """Deepest overlap of a contact sphere with what it touches, over the scene's length."""
    way: Array
    """Way of the particles over that of the truth, where that is long enough."""
    error: Array
    """RMS distance of the particles to the truth over the scene's length."""
    begin: int = 0
    """First frame that the simulator made itself: those before were given to it."""


def part_of_way(gone: Array, due: Array, length: float) -> Array:
    """Give the part of the way due [m] that is gone, where that is worth comparing; (frame,)."""
    return np.where(due > _WORTH * length, gone / due, np.nan)


@dataclass(frozen=True, eq=False)
class Simulated:
    """What a simulator made of one start, and what that took."""

    motion: Trajectory | Signs
    """The bodies' motion, or where only particles are known, what these show."""
    wall_s: tuple[float, ...]
    """Wall time of the motion, one entry a repeat [s]."""
    cpu_s: tuple[float, ...]
    """Processor time of the motion, one entry a repeat [s]."""
    simulated_s: float
    """Simulated time that these are for [s]."""
    setup_s: float
    """Loading the model [s]."""
    size: ModelSize | None = None
    method: Method | None = None
    step: float | None = None
    """Integration step [s]."""
    contact_time: float | None = None
    """Over which an impact is spread [s]."""


@dataclass(frozen=True)
class Simulator(ABC):
    """What makes motions of scenes, at one or several numbers of steps a frame."""

    engine: str
    """Name of the engine or model."""
    method: str
    """Method by which it steps, or how it was trained."""
    _: KW_ONLY
    variation: str = ""
    """What differs from the usual options; empty: nothing."""
    counts: tuple[int, ...] = (1,)
    """Steps a frame at which it is tried, the fewest first."""
    digits: bool = False
    """Whether counts are digits n in place of steps, for relative tolerances of 10⁻ⁿ."""
    profile: Profile = "matched"
    """Profile of its settings, or of the data that it was trained on."""
    source: str = ""
    """File that it comes from, as the user named it; empty for engines."""
    shown: int = 0
    """First frames of the truth that it has to be shown."""

    @property
    def name(self) -> str:
        """All that tells it from the others of a study."""
        return " ".join(filter(None, (self.engine, self.method, self.variation)))

    @property
    @abstractmethod
    def family(self) -> str:
        """Family of methods: agreement within one is no evidence."""

    @property
    @abstractmethod
    def package(self) -> str:
        """Name of what runs it: the engine, or torch."""

    @property
    @abstractmethod
    def version(self) -> str:
        """Version of that."""

    @abstractmethod
    def clock(self, usual: Clock) -> Clock:
        """Give the frames at which it records, over the time of the usual ones."""

    @abstractmethod
    def refusal(self, scene: Scene) -> str:
        """Say why it cannot simulate a scene; "" where it can."""

    @abstractmethod
    def options(self, scene: Scene) -> Options:
        """Give the options with which it simulates a scene."""

    @abstractmethod
    def decisive(self, scene: Scene, count: int) -> list[Any]:
        """List all of it that decides the motion, in words and numbers that JSON can hold."""

    @abstractmethod
    def simulate(
        self, scene: Scene, start: Batch, count: int, truth: Trajectory | None, *, often: bool
    ) -> Simulated:
        """Simulate one start in this process.

        Args:
            scene: What to simulate.
            start: A batch of one.
            count: Steps a frame.
            truth: The reference, whose first frames some simulators need; None: unknown.
            often: Whether times matter: then it warms up, and short motions are repeated.

        Raises:
            InputError: It cannot do the scene, or lacks what it needs.
        """


@dataclass(frozen=True)
class EngineMethod(Simulator):
    """A method of an engine."""

    _: KW_ONLY
    given: Options | None = None
    """Its options; None: those of the engine's profile for the scene."""
    together: int = 1
    """Copies of the start that run at once: times are each one's share."""
    release: str = ""
    """Version of the engine where it is run, if that is not here."""

    @property
    def family(self) -> str:
        """Family of the method."""
        return registry.load_adapter(self.engine).methods[self.method].family

    @property
    def package(self) -> str:
        """Name of the engine."""
        return self.engine

    @property
    def version(self) -> str:
        """Version of the engine."""
        return self.release or registry.load_adapter(self.engine).version()

    def clock(self, usual: Clock) -> Clock:
        """Give the usual frames."""
        return usual

    def refusal(self, scene: Scene) -> str:
        """Ask the adapter."""
        try:
            settings = self.settings(scene, self.counts[0])
            registry.load_adapter(self.engine).check(scene, settings)
        except Unsupported as error:
            return str(error)
        return ""

    def options(self, scene: Scene) -> Options:
        """Give those of its own, or of the profile's settings, whatever their method."""
        if self.given is not None:
            return dict(self.given)
        return dict(settings_for(scene, registry.load_adapter(self.engine), self.profile).options)

    def settings(self, scene: Scene, count: int) -> Settings:
        """Give the settings at a number of steps a frame, or of digits."""
        options = self.options(scene)
        if self.digits:
            return Settings(self.method, scene.clock.frame, {**options, RTOL: 10.0**-count})
        return Settings(self.method, scene.clock.frame / count, options)

    def decisive(self, scene: Scene, count: int) -> list[Any]:
        """List method, steps, options, and the versions of engine and adapter."""
        adapter = registry.load_adapter(self.engine)
        options = sorted(self.options(scene).items())
        together = [self.together] if self.together > 1 else []
        versions = [self.version, adapter.revision]
        return [self.engine, self.method, count, options, *versions, *together]

    def simulate(
        self, scene: Scene, start: Batch, count: int, truth: Trajectory | None, *, often: bool
    ) -> Simulated:
        """Load the engine, and roll the start out."""
        del truth
        adapter, settings = registry.load_adapter(self.engine), self.settings(scene, count)
        isolate.begin()
        begin = time.perf_counter()
        with adapter.open(scene, settings) as run:
            setup = time.perf_counter() - begin
            if often:
                run.rollout(start.truncated(WARM_UP))
            copies = start[[0] * self.together]
            made, wall, cpu = stopwatch(lambda: run.rollout(copies), often=often)
            return Simulated(
                checked(made, copies)[:1],
                wall,
                cpu,
                simulated_s=scene.clock.frame * start.steps * self.together,
                setup_s=setup,
                size=run.size,
                method=adapter.methods[settings.method],
                step=settings.step,
                contact_time=adapter.contact_scales(settings).time,
            )
