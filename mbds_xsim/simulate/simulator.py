"""Simulators: anything that makes a motion from a scene and a start, an engine or a trained model.

Studies take lists of them and need not know which kind each is. An engine's method is one
(`EngineMethod`); a trained model is another, in `mbds_xsim.learn.simulator`, so that torch is
loaded only if models are requested.
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
from mbds_xsim.simulate.timed import WARM_UP, checked, size_of, stopwatch

Options = Mapping[str, float | int | bool | str]

NATIVE = "native"
"""Variation with the settings that an ordinary user of an engine gets."""
LEARNED = "learned"
"""Family of trained models."""

_WORTH = 0.1  # of the scene's length: shorter paths are not compared


@dataclass(frozen=True, eq=False)
class Signs:
    """Figures of a motion compared with the truth, each of shape (frame,), NaN if unknown.

    They are the only basis for judgement if a simulator gives particle positions but no bodies.
    """

    time: Array
    """Time [s]."""
    finite: Mask
    """Whether all numbers of the motion are finite up to this frame."""
    energy: Array
    """Signed deviation of the energy balance, relative to its scale."""
    gap: Array
    """Largest gap of a joint relative to the scene's length, or angle between its axes [rad]."""
    sunk: Array
    """Deepest overlap of a contact sphere, relative to the scene's length."""
    way: Array
    """Path length of the particles relative to the truth's, if that is long enough."""
    error: Array
    """RMS distance of the particles from the truth, relative to the scene's length."""
    begin: int = 0
    """First frame that the simulator made itself; earlier ones were given to it."""


def part_of_way(gone: Array, due: Array, length: float) -> Array:
    """Return path `gone` [m] over path `due` [m], NaN if `due` is too short; shape (frame,)."""
    return np.where(due > _WORTH * length, gone / due, np.nan)


@dataclass(frozen=True, eq=False)
class Simulated:
    """Motion that a simulator made from one start, and its cost."""

    motion: Trajectory | Signs
    """Motion of the bodies, or its figures if only particles are known."""
    wall_s: tuple[float, ...]
    """Wall time of the motion, one entry per repeat [s]."""
    cpu_s: tuple[float, ...]
    """Processor time of the motion, one entry per repeat [s]."""
    simulated_s: float
    """Simulated time that these times cover [s]."""
    setup_s: float
    """Time to load the model [s]."""
    size: ModelSize | None = None
    method: Method | None = None
    step: float | None = None
    """Integration step [s]."""
    contact_time: float | None = None
    """Duration of an impact [s]."""


@dataclass(frozen=True)
class Simulator(ABC):
    """An engine method or trained model, at one or several numbers of steps per frame."""

    engine: str
    """Name of the engine or model."""
    method: str
    """Method by which it steps, or how it was trained."""
    _: KW_ONLY
    variation: str = ""
    """Difference from the usual options; empty if there is none."""
    counts: tuple[int, ...] = (1,)
    """Numbers of steps per frame to try, in ascending order."""
    digits: bool = False
    """Whether counts are digits n of relative tolerances 10⁻ⁿ instead of steps."""
    profile: Profile = "matched"
    """Profile of its settings, or of the data that it was trained on."""
    source: str = ""
    """File that it comes from, as the user named it; empty for engines."""
    context: int = 0
    """Number of first frames of the truth that it must be shown."""

    @property
    def name(self) -> str:
        """Name that is unique within a study."""
        return " ".join(filter(None, (self.engine, self.method, self.variation)))

    @property
    @abstractmethod
    def family(self) -> str:
        """Family of methods; agreement within a family is no evidence."""

    @property
    @abstractmethod
    def package(self) -> str:
        """Name of the software that runs it: the engine, or torch."""

    @property
    @abstractmethod
    def version(self) -> str:
        """Version of that software."""

    @abstractmethod
    def clock(self, usual: Clock) -> Clock:
        """Return the clock at which it records, over the duration of the usual one."""

    @abstractmethod
    def refusal(self, scene: Scene) -> str:
        """Return why it cannot simulate a scene; "" if it can."""

    @abstractmethod
    def options(self, scene: Scene) -> Options:
        """Return the options with which it simulates a scene."""

    @abstractmethod
    def decisive(self, scene: Scene, count: int) -> list[Any]:
        """List everything about it that decides the motion, in words and numbers for JSON."""

    @abstractmethod
    def simulate(
        self, scene: Scene, start: Batch, count: int, truth: Trajectory | None, *, often: bool
    ) -> Simulated:
        """Simulate one start in this process.

        Args:
            scene: Scene to simulate.
            start: A batch of one.
            count: Number of steps per frame.
            truth: The reference, whose first frames some simulators need; None if unknown.
            often: Whether times matter: then it warms up, and short motions are repeated.

        Raises:
            InputError: It cannot simulate the scene, or lacks an input that it needs.
        """


@dataclass(frozen=True)
class EngineMethod(Simulator):
    """A method of an engine."""

    _: KW_ONLY
    own_options: Options | None = None
    """Options of the method; if None, those of the engine's profile for the scene."""
    together: int = 1
    """Number of copies of the start that run at once; `simulated_s` counts them all."""
    release: str = ""
    """Version of the engine if it runs elsewhere; empty if it runs here."""

    @classmethod
    def at(cls, engine: str, scene: Scene, settings: Settings, **fields: Any) -> EngineMethod:
        """Make the simulator of an engine at its settings for a scene, and at no other step."""
        count = settings.substeps(scene.clock.frame)
        options = dict(settings.options)
        return cls(engine, settings.method, own_options=options, counts=(count,), **fields)

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
        """Return the usual clock."""
        return usual

    def refusal(self, scene: Scene) -> str:
        """Return why the adapter refuses a scene; "" if it does not."""
        try:
            settings = self.settings(scene, self.counts[0])
            registry.load_adapter(self.engine).check(scene, settings)
        except Unsupported as error:
            return str(error)
        return ""

    def options(self, scene: Scene) -> Options:
        """Return its own options, or those of the profile's settings, whatever their method."""
        if self.own_options is not None:
            return dict(self.own_options)
        return dict(settings_for(scene, registry.load_adapter(self.engine), self.profile).options)

    def settings(self, scene: Scene, count: int) -> Settings:
        """Return the settings at a number of steps per frame, or of digits."""
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
        """Load the engine and roll out the start."""
        del truth
        adapter, settings = registry.load_adapter(self.engine), self.settings(scene, count)
        isolate.begin()
        begin = time.perf_counter()
        with adapter.open(scene, settings) as run:
            setup = time.perf_counter() - begin
            if often:
                run.rollout(start.truncated(WARM_UP))
            copies = start[[0] * self.together]
            trajectory, wall, cpu = stopwatch(lambda: run.rollout(copies), often=often)
            return Simulated(
                checked(trajectory, copies, scene.clock.frame)[:1],
                wall,
                cpu,
                simulated_s=scene.clock.frame * start.steps * self.together,
                setup_s=setup,
                size=size_of(run),
                method=adapter.methods[settings.method],
                step=settings.step,
                contact_time=adapter.contact_scales(settings).time,
            )
