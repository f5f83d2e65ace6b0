"""The N-four-bar mechanism of the IFToMM benchmark library against its closed form.

N + 1 upright cranks of 1 m stand 1 m apart and carry N rods of 1 m; everything weighs 1 kg/m. The
first pin starts at 1 m/s. In 10 s the cranks turn over several times, and every half turn all of
them align with the rods, where each loop could continue in two ways. Cuadrado et al.,
https://www.iftomm-multibody.org/benchmark/problem/N_four-bar_mechanism; the library requires that
mechanical energy is kept to 0.1 J.

All loops move as one parallelogram. The cranks' angle θ from upright therefore obeys one equation,
θ̈ = k sin θ: that of a pendulum that turns over, whose solution is Jacobi's amplitude.

    python -m benchmarks.four_bars 2 10 40
"""

from __future__ import annotations

import sys
import time

import numpy as np
from scipy.special import ellipj, ellipk

from benchmarks.harness import print_table
from mbds_xsim.base.arrays import Array
from mbds_xsim.reference import solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene
from mbds_xsim.scene.state import Trajectory

_G = 9.81
_AXIS = (0.0, 1.0, 0.0)
_RATES = {0: -1.0}  # of the feet [rad/s]; the others follow
_UPRIGHT = Inertia(1.0, (1 / 12, 1 / 12, 1e-4))
_LEVEL = Inertia(1.0, (1e-4, 1 / 12, 1 / 12))


def four_bars(loops: int, duration: float) -> Scene:
    """Make the mechanism; bodies are the cranks, then the rods."""
    cranks = [Body(f"crank{k}", inertia=_UPRIGHT, position=(k, 0.0, 0.5)) for k in range(loops + 1)]
    rods = [Body(f"rod{k}", inertia=_LEVEL, position=(k + 0.5, 0.0, 1.0)) for k in range(loops)]
    feet = [
        Joint(f"foot{k}", "hinge", "world", f"crank{k}", (k, 0.0, 0.0), _AXIS, rate=_RATES.get(k))
        for k in range(loops + 1)
    ]
    pins = [
        Joint(f"pin{k}{end}", "hinge", f"rod{k}", f"crank{k + end}", (k + end, 0.0, 1.0), _AXIS)
        for k in range(loops)
        for end in (0, 1)
    ]
    return Scene(
        f"{loops}fourbars",
        (*cranks, *rods),
        1.0,
        dimension=2,
        joints=(*feet, *pins),
        clock=Clock(0.02, round(duration / 0.02)),
    )


def angle_and_rate(loops: int, time: Array) -> tuple[Array, Array]:
    """Return the exact angle of the cranks from upright [rad] and its rate [rad/s]."""
    inertia, moment = (loops + 1) / 3 + loops, ((loops + 1) / 2 + loops) * _G
    pace = np.sqrt(0.25 + moment / inertia)
    share = moment / inertia / pace**2
    # am(u) starts at the lowest point, where a pendulum is fastest; am(u + K) starts upright.
    _, _, delta, amplitude = ellipj(pace * time + ellipk(share), share)
    return np.pi - 2.0 * amplitude, -2.0 * pace * delta


def energy(motion: Trajectory) -> Array:
    """Return the mechanical energy of the first trajectory [J], shape (frame,)."""
    slow = np.sum(motion.velocity[0] ** 2, axis=-1) / 2 + _G * motion.position[0, :, :, 2]
    return np.asarray(np.sum(slow + motion.angular_velocity[0, :, :, 1] ** 2 / 24, axis=-1))


def _row(loops: int, duration: float = 10.0) -> list[str]:
    scene, begin = four_bars(loops, duration), time.perf_counter()
    motion = solve(scene, draw_batch(scene, [0]), cache=False)
    took = time.perf_counter() - begin
    angle, _ = angle_and_rate(loops, motion.time)
    pin = motion.position[0, :, 0, [0, 2]] * 2.0 - np.array([np.sin(angle), np.cos(angle)])
    drift = energy(motion)
    figures = (np.abs(pin).max(), np.abs(drift - drift[0]).max())
    return [str(loops), *(f"{figure:.1e}" for figure in figures), f"{took:.0f}"]


if __name__ == "__main__":
    print_table(
        ">N|>error of the first pin [m]|>energy drift [J]|>time [s]",
        (_row(int(loops)) for loops in sys.argv[1:]),
    )
