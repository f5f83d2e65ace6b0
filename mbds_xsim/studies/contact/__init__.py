"""Contact bench: an engine with the settings of a built-in scene simulates simple test scenes."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from itertools import product
from typing import Any

import msgspec
import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import GRAVITY, Body, Clock, Ground, Inertia, Particle, Scene
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate.adapter import Profile, Settings
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.simulate.timed import checked
from mbds_xsim.testing.contact_cases import RADIUS, on_ground

PULL = -GRAVITY[2]
UP = np.array([0.0, 0.0, 1.0])
CRATE_MASS = 30.0
_HALF_EDGE = 0.2
_CENTRE = (0.0, 0.0, RADIUS)


class ContactFigure(msgspec.Struct, frozen=True):
    """One figure of an engine at one profile."""

    engine: str
    profile: Profile
    quantity: str
    unit: str
    """"1" for a plain number."""
    value: float | None
    """None if there is none; `note` says why."""
    at: dict[str, float] = {}
    """Conditions of the measurement, in SI units; headings in degrees."""
    low: float | None = None
    """Smallest value of several starts, of which `value` is the median; else None."""
    high: float | None = None
    note: str = ""


@dataclass(frozen=True)
class ContactBench:
    """An engine at a profile."""

    engine: str
    profile: Profile
    like: str
    """Built-in scene whose settings are used for all scenes."""

    @property
    def settings(self) -> Settings:
        """Settings of the engine in every run."""
        return settings_for(load_scene(self.like), load_adapter(self.engine), self.profile)

    @property
    def lag(self) -> float:
        """Time lag of recorded velocities, which belong to frame time + lag [s]."""
        settings = self.settings
        return load_adapter(self.engine).methods[settings.method].velocity_lag * settings.step

    def clock(self, frame: float, duration: float) -> Clock:
        """Return a clock with about this frame [s], in whole steps, that covers a duration [s]."""
        step = self.settings.step
        rounded = step * max(1, round(frame / step))
        return Clock(rounded, math.ceil(duration / rounded))

    def motion(self, scene: Scene, batch: Batch) -> Trajectory:
        """Simulate a batch; velocities are as recorded. All are NaN if the engine cannot do it."""
        try:
            with load_adapter(self.engine).open(scene, self.settings) as run:
                return checked(run.rollout(batch), batch, scene.clock.frame)
        except Unsupported as refusal:
            time = scene.clock.frame * np.arange(batch.steps + 1, dtype=np.float64)
            return Trajectory.empty(time, len(batch), len(scene.bodies), Failure(0, str(refusal)))

    def figure(
        self,
        quantity: str,
        unit: str,
        values: Array | float | None,
        motion: Trajectory,
        at: dict[str, float] | None = None,
        note: str = "",
    ) -> ContactFigure:
        """Record a figure of a motion: the median of its values, without NaN.

        Args:
            quantity: What was measured.
            unit: "1" for a plain number.
            values: One value or several, NaN where unknown; None if there are none.
            motion: Motion that was measured; if it failed, the reason replaces the note.
            at: Conditions, in SI units; headings in degrees.
            note: Remark on the figure.
        """
        note = reason(motion) or note
        array = np.atleast_1d(np.nan if values is None else values).astype(np.float64)
        finite = array[np.isfinite(array)]
        several = len(finite) > 1
        return ContactFigure(
            self.engine,
            self.profile,
            quantity,
            unit,
            float(np.median(finite)) if len(finite) else None,
            at or {},
            low=float(finite.min()) if several else None,
            high=float(finite.max()) if several else None,
            note=note if len(finite) else note or "not seen",
        )


def ball(ground: Ground, clock: Clock, **start: Array) -> tuple[Scene, Batch]:
    """Make one particle and its starts, with fields of shape (row, 3); by default at rest."""
    body = Body("ball", particles=(Particle(_CENTRE),))
    return _scene(body, 1.0, [_CENTRE], ground, clock, start)


def wheel(ground: Ground, clock: Clock, **start: Array) -> tuple[Scene, Batch]:
    """Make a ball with a particle's inertia about y and ten times as much about x and z."""
    moment = 0.4 * RADIUS**2
    inertia = Inertia(1.0, (10.0 * moment, moment, 10.0 * moment))
    body = Body("wheel", inertia=inertia, position=_CENTRE)
    return _scene(body, 1.0, [_CENTRE], ground, clock, start)


def crate(ground: Ground, clock: Clock, **start: Array) -> tuple[Scene, Batch]:
    """Make a cube with spheres at its corners, and its starts; by default at rest on four."""
    middle = (0.0, 0.0, _HALF_EDGE + RADIUS)
    corners = np.array(list(product((-_HALF_EDGE, _HALF_EDGE), repeat=3))) + middle
    moment = CRATE_MASS * (2.0 * _HALF_EDGE) ** 2 / 6.0
    body = Body("crate", inertia=Inertia(CRATE_MASS, (moment,) * 3), position=middle)
    return _scene(body, 0.4, corners.tolist(), ground, clock, start)


def reason(motion: Trajectory) -> str:
    """Return why the first failed trajectory failed; "" if all ran to the end."""
    return next((failure.reason for failure in motion.failures if failure), "")


def _scene(
    body: Body,
    length: float,
    centres: list[Any],
    ground: Ground,
    clock: Clock,
    start: dict[str, Array],
) -> tuple[Scene, Batch]:
    """Put a body with contact spheres on the ground; positions are offsets, a force is constant."""
    scene = on_ground(body, length, centres, ground, clock)
    rows = len(next(iter(start.values()))) if start else 1
    batch = draw_batch(scene, range(rows), noise=False)
    fields: dict[str, Any] = {key: value[:, None] for key, value in start.items()}
    if "force" in fields:
        fields["force"] = np.broadcast_to(fields["force"][:, None], batch.force.shape).copy()
    if "position" in fields:
        fields["position"] = batch.position + fields["position"]
    return scene, dataclasses.replace(batch, **fields)
