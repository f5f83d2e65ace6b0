"""Accuracy of an adapter on the cases of the ladder: errors, and their order of convergence."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import rounding
from mbds_xsim.simulate.adapter import Adapter, Run, Settings
from mbds_xsim.simulate.claims import RTOL, Method
from mbds_xsim.simulate.timed import checked
from mbds_xsim.testing.case import Case

STEPS_PER_FRAME = (4, 8, 16)
EXACT = 1e-9
"""Error below which a method has met the answer, with no order left (RK4 on a parabola) [m]."""

_TOLERANCES = (1e-5, 1e-7, 1e-9)


def measured_order(
    adapter: Adapter, case: Case, method: str, steps_per_frame: tuple[int, ...] = STEPS_PER_FRAME
) -> tuple[float, list[float]]:
    """Fit the order of convergence of a case's largest error, and return it with the errors [m].

    The order of an adaptive method is fitted over its tolerance, not over its steps.
    """
    finer: tuple[float, ...] = steps_per_frame
    if adapter.methods[method].adaptive:
        runs = [rolled(adapter, case, method, 1, rtol) for rtol in _TOLERANCES]
        finer = tuple(1.0 / rtol for rtol in _TOLERANCES)
    else:
        runs = [rolled(adapter, case, method, n) for n in steps_per_frame]
    errors = [_error(case, motion) for _, motion in runs]
    if errors[-1] == 0.0:
        return np.inf, errors
    slope = np.polyfit(np.log(finer), -np.log(np.maximum(errors, 1e-300)), 1)[0]
    return float(slope), errors


def answer_known_to(case: Case, method: Method) -> float:
    """Return the error below which a method has met a case's answer [m].

    Such an error cannot be distinguished from rounding added up over the steps, for the
    farthest place of the motion.
    """
    frames = np.arange(case.scene.clock.steps + 1.0)
    place = np.abs(case.exact(case.scene.clock.frame * frames)).max()
    steps = STEPS_PER_FRAME[-1] * case.scene.clock.steps
    return max(EXACT, rounding.step_error(method, steps) * max(case.scene.length, float(place)))


@functools.lru_cache(maxsize=256)
def rolled(
    adapter: Adapter, case: Case, method: str, steps_per_frame: int, rtol: float | None = None
) -> tuple[Batch, Trajectory]:
    """Return a case's first start and its motion, cached for tests; `rtol` if it is adaptive."""
    settings = case_settings(adapter, case, adapter.methods[method], steps_per_frame)
    if rtol is not None:
        settings = dataclasses.replace(settings, options={**settings.options, RTOL: rtol})
    batch = draw_batch(case.scene, [0])
    with adapter.open(case.scene, settings) as run:
        return batch, whole_motion(run, batch, case.scene, method)


def whole_motion(run: Run, batch: Batch, scene: Scene, method: str) -> Trajectory:
    """Roll a batch out; assert that it reaches its end in finite numbers, and is not changed."""
    given = {name: values.copy() for name, values in vars(batch).items()}
    motion = checked(run.rollout(batch), batch, scene.clock.frame)
    where = f"{method} on {scene.name}"
    assert motion.failures == (None,) * len(batch), f"{where}: {motion.failures}"
    assert motion.finite.all(), f"{where}: NaN or infinity, without a Failure"
    for name, values in given.items():
        same = np.array_equal(values, getattr(batch, name))
        assert same, f"{where}: rollout changes {name} of the batch it is given"
    return motion


def _error(case: Case, motion: Trajectory) -> float:
    """Return the largest distance from the exact motion, or angle times the scene's length [m]."""
    error = np.abs(motion.position[0] - case.exact(motion.time)).max()
    if case.exact_orientation is not None:
        turn = rotation.multiply(
            rotation.conjugate(case.exact_orientation(motion.time)), motion.orientation[0]
        )
        angle = np.linalg.norm(rotation.to_vector(turn), axis=-1).max()
        error = max(error, angle * case.scene.length)
    return float(error)


def case_settings(adapter: Adapter, case: Case, method: Method, steps_per_frame: int) -> Settings:
    """Return a method's settings: its preset options, and a step that divides the case's frame."""
    preset = adapter.settings(case.scene, "matched")
    options = preset.options if preset.method == method.name else {}
    count = 1 if method.adaptive else steps_per_frame
    return Settings(method.name, case.scene.clock.frame / count, options)
