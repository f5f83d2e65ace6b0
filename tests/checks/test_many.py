"""Compiled kernels, which check many trajectories at once, find what numpy finds."""

from __future__ import annotations

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mbds_xsim.checks import Finding, Record, audited
from mbds_xsim.dataset.gate import Making, judge_rows
from mbds_xsim.scene.state import STATES, Trajectory
from mbds_xsim.simulate.claims import Method

METHODS = (Method("RK4", "RK4", 4), Method("Euler", "semi-implicit Euler", 1, velocity_lag=-0.5))


@pytest.fixture(scope="session")
def loose(tumbling: Any, simulate: Any, drawn: Any) -> Any:
    """Two bodies that nothing joins."""
    throw = tumbling.scene.sampling[:1]
    free = msgspec.structs.replace(tumbling.scene, joints=(), sampling=throw)
    scene, batch = drawn(free, 40)
    return dataclasses.replace(tumbling, scene=scene, batch=batch, exact=simulate(scene, batch, 10))


@pytest.fixture(scope="session", params=["pendulum", "tumbling", "linkage", "loose"])
def case(request: pytest.FixtureRequest) -> Any:
    return request.getfixturevalue(request.param)


def shaken(motion: Trajectory, size: float, still: int, seed: int) -> Trajectory:
    """Add noise to all states, and let the first body repeat its pose from a frame on."""
    rng = np.random.default_rng(seed)
    parts: dict[str, Any] = {
        key: getattr(motion, key) + size * rng.standard_normal(getattr(motion, key).shape)
        for key in STATES
    }
    parts["orientation"] /= np.linalg.norm(parts["orientation"], axis=-1, keepdims=True)
    for key in ("position", "orientation"):
        parts[key][:, still:, 0] = parts[key][:, still : still + 1, 0]
    return dataclasses.replace(motion, **parts)


def frames(motion: Trajectory, steps: int) -> Trajectory:
    parts = {key: getattr(motion, key)[:, : steps + 1] for key in STATES}
    return dataclasses.replace(motion, time=motion.time[: steps + 1], **parts)


def assert_alike(one: Finding, other: Finding) -> None:
    """Compare to a millionth of the figure or its budget, as `verify` does with stored figures."""
    assert other.check == one.check
    allowed = 1.0 if one.budget is None else one.budget
    size = np.fmax(np.fmax.reduce(np.abs(one.series), axis=1), allowed)[:, None]
    np.testing.assert_allclose(other.series / size, one.series / size, rtol=0.0, atol=1e-6)
    # Uncertainties are compared with what they are added to, the budget, or the figure.
    ours, theirs = (finding.uncertainty[:, None] / size for finding in (one, other))
    np.testing.assert_allclose(theirs, ours, rtol=0.0, atol=1e-6)


@settings(max_examples=15, deadline=None)
@given(
    steps=st.sampled_from([1, 2, 3, 4, 17, 40]),
    rows=st.sampled_from([1, 3, 8, 10, 19]),  # the kernels take eight at once
    size=st.sampled_from([0.0, 1e-8, 1e-3, 1.0]),
    still=st.integers(1, 40),
    method=st.sampled_from(METHODS),
    seed=st.integers(0, 2**16),
)
def test_kernels_agree_with_numpy(
    case: Any, steps: int, rows: int, size: float, still: int, method: Method, seed: int
) -> None:
    picks = np.resize(np.arange(len(case.batch)), rows).tolist()
    motion = frames(shaken(case.exact[picks], size, min(still, steps), seed), steps)
    record = Record(case.scene, case.batch[picks].truncated(steps), motion, method, 0.005)

    one, other = audited(record), audited(dataclasses.replace(record, many=True))

    for pair in zip(one, other, strict=True):
        assert_alike(*pair)


def test_a_neighbour_that_blows_up_changes_no_figure(pendulum: Any) -> None:
    lost = shaken(pendulum.exact, 0.0, 40, 0)
    lost.velocity[1, 20:] = np.nan
    making = Making(METHODS[0], 0.005, 0.0)
    batch = dataclasses.replace(pendulum.batch, index=pendulum.batch.index + 30)

    alone = judge_rows(pendulum.scene, batch[[0, 2]], lost[[0, 2]], making)
    whole = judge_rows(pendulum.scene, batch, lost, making)

    assert whole.figure[1, 0] == np.inf
    np.testing.assert_array_equal(whole.figure[[0, 2]], alone.figure)
