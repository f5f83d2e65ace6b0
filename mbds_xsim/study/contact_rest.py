"""What should lie still: how deep it sinks, and whether it hops or trembles."""

from __future__ import annotations

import numpy as np

from mbds_xsim.checks.ground import spheres_of
from mbds_xsim.engine import Profile
from mbds_xsim.joint_space import BodyStates
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.scene import Ground, Scene
from mbds_xsim.state import Trajectory
from mbds_xsim.study.contact_bench import FRICTION, Bench, Measured, ball, crate, reason

__all__ = ["rest"]

_GROUND = Ground(FRICTION, 0.5)
_HEIGHT = 0.05  # dropped from here, a ball of e = 0.5 is at rest after 0.3 s [m]
_FROM, _LONG = 1.0, 0.2  # when it is looked at, and for how long [s]
_FRAME = 0.01
_STARTS = ("placed", "dropped")


def rest(engine: str, profile: Profile) -> list[Measured]:
    """Measure a ball and a crate after 1 s, placed on the ground and dropped onto it."""
    start = np.zeros((2, 3))
    start[1, 2] = _HEIGHT
    found: list[Measured] = []
    for what, make, like in (("ball", ball, "balldrop"), ("crate", crate, "simplecubli")):
        bench = Bench(engine, profile, like)
        scene, batch = make(_GROUND, bench.clock(_FRAME, _FROM + _LONG), position=start)
        found += _stillness(bench, what, scene, bench.motion(scene, batch))
    return found


def _stillness(bench: Bench, what: str, scene: Scene, motion: Trajectory) -> list[Measured]:
    """Look at the lowest sphere and at the centre of mass."""
    mechanism, late = Mechanism.of(scene), motion.time >= _FROM - 1e-9
    native = mechanism.native_rotation(motion.orientation)
    states = BodyStates(motion.position, native, motion.velocity, motion.angular_velocity)
    lowest = spheres_of(mechanism, states).gap[:, late].min(axis=2)
    speed = np.linalg.norm(motion.velocity[:, late, 0], axis=-1).max(axis=1)
    found = []
    for row, start in enumerate(_STARTS):
        gap, note = lowest[row], reason(motion)
        found += [
            bench.measured(f"{what} {start}: sinks by", "m", -gap.min(), {}, note),
            bench.measured(f"{what} {start}: hops by", "m", np.ptp(gap), {}, note),
            bench.measured(f"{what} {start}: moves at", "m/s", speed[row], {}, note),
        ]
    return found
