"""An engine at the settings of a built-in scene, put to other scenes on the same ground."""

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
from mbds_xsim.scene.scene import (
    GRAVITY,
    PARTICLE_RADIUS,
    Body,
    Clock,
    ContactSphere,
    Ground,
    Inertia,
    Particle,
    Scene,
)
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate.adapter import Profile, Settings
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.simulate.timed import checked

PULL = -GRAVITY[2]
UP = np.array([0.0, 0.0, 1.0])
RADIUS = PARTICLE_RADIUS
FRICTION, RESTITUTION = 0.43, 0.9332
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
    """None where there is none; the note says why."""
    at: dict[str, float] = {}
    """Under which conditions, SI units."""
    low: float | None = None
    """Of several starts: the smallest; the value is their median then."""
    high: float | None = None
    note: str = ""


@dataclass(frozen=True)
class ContactBench:
    """An engine at a profile."""

    engine: str
    profile: Profile
    like: str
    """The built-in scene whose settings are taken, whatever is run."""

    @property
    def settings(self) -> Settings:
        """What the engine gets."""
        return settings_for(load_scene(self.like), load_adapter(self.engine), self.profile)

    @property
    def lag(self) -> float:
        """Recorded velocities belong to frame time + lag [s]."""
        settings = self.settings
        return load_adapter(self.engine).methods[settings.method].velocity_lag * settings.step

    def clock(self, frame: float, duration: float) -> Clock:
        """Record whole steps, about a frame [s] apart and never less than one, for a time [s]."""
        step = self.settings.step
        whole = step * max(1, round(frame / step))
        return Clock(whole, math.ceil(duration / whole))

    def motion(self, scene: Scene, batch: Batch) -> Trajectory:
        """Let the engine run a batch; velocities are as recorded, all NaN if it cannot do it."""
        try:
            with load_adapter(self.engine).open(scene, self.settings) as run:
                return checked(run.rollout(batch), batch)
        except Unsupported as refusal:
            time = scene.clock.frame * np.arange(batch.steps + 1, dtype=np.float64)
            lost = Trajectory.empty(time, len(batch), len(scene.bodies))
            return dataclasses.replace(lost, failures=(Failure(0, str(refusal)),) * len(batch))

    def measured(
        self,
        quantity: str,
        unit: str,
        values: Array | float | None,
        motion: Trajectory,
        at: dict[str, float] | None = None,
        note: str = "",
    ) -> ContactFigure:
        """Put a figure of a motion down; of several the median, NaN passed over.

        Args:
            quantity: What was measured.
            unit: "1" for a plain number.
            values: One or several.
            motion: What was looked at; why it failed goes before any other note.
            at: Under which conditions, SI units.
            note: What else is to be said of the figure.
        """
        note = reason(motion) or note
        known = np.atleast_1d(np.nan if values is None else values).astype(np.float64)
        known = known[np.isfinite(known)]
        several = len(known) > 1
        return ContactFigure(
            self.engine,
            self.profile,
            quantity,
            unit,
            float(np.median(known)) if len(known) else None,
            at or {},
            low=float(known.min()) if several else None,
            high=float(known.max()) if several else None,
            note=note if len(known) else note or "not seen",
        )


def ball(ground: Ground, clock: Clock, **start: Array) -> tuple[Scene, Batch]:
    """Make one particle and its starts, fields of shape (row, 3); at rest on the ground if none."""
    body = Body("ball", particles=(Particle(_CENTRE),))
    return _sphere(body, ground, clock, start)


def wheel(ground: Ground, clock: Clock, **start: Array) -> tuple[Scene, Batch]:
    """Make a ball that turns about y as a particle does, and about x and z ten times harder."""
    moment = 0.4 * RADIUS**2
    inertia = Inertia(1.0, (10.0 * moment, moment, 10.0 * moment))
    return _sphere(Body("wheel", inertia=inertia, position=_CENTRE), ground, clock, start)


def _sphere(
    body: Body, ground: Ground, clock: Clock, start: dict[str, Array]
) -> tuple[Scene, Batch]:
    scene = Scene(
        body.name,
        (body,),
        length=1.0,
        contacts=(ContactSphere(body.name, _CENTRE, RADIUS),),
        ground=ground,
        clock=clock,
    )
    return scene, _started(scene, start)


def crate(ground: Ground, clock: Clock, **start: Array) -> tuple[Scene, Batch]:
    """Make a cube with a contact sphere at each corner and its starts; at rest on four if none."""
    middle = (0.0, 0.0, _HALF_EDGE + RADIUS)
    corners = np.array(list(product((-_HALF_EDGE, _HALF_EDGE), repeat=3))) + middle
    moment = CRATE_MASS * (2.0 * _HALF_EDGE) ** 2 / 6.0
    body = Body("crate", inertia=Inertia(CRATE_MASS, (moment,) * 3), position=middle)
    scene = Scene(
        "crate",
        (body,),
        length=0.4,
        contacts=tuple(ContactSphere("crate", (x, y, z), RADIUS) for x, y, z in corners.tolist()),
        ground=ground,
        clock=clock,
    )
    return scene, _started(scene, start)


def reason(motion: Trajectory) -> str:
    """Say why the first trajectory that failed did; nothing where all ran to the end."""
    return next((failure.reason for failure in motion.failures if failure), "")


def _started(scene: Scene, start: dict[str, Array]) -> Batch:
    """Start as many rows as are given; a force is held throughout."""
    rows = len(next(iter(start.values()))) if start else 1
    batch = draw_batch(scene, range(rows), noise=False)
    fields: dict[str, Any] = {key: value[:, None] for key, value in start.items()}
    if "force" in fields:
        fields["force"] = np.broadcast_to(fields["force"][:, None], batch.force.shape).copy()
    if "position" in fields:
        fields["position"] = batch.position + fields["position"]
    return dataclasses.replace(batch, **fields)
