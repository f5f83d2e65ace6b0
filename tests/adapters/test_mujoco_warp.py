"""MuJoCo Warp, in cases that the contract suite does not cover."""

from __future__ import annotations

import numpy as np
import pytest

from mbds_xsim.base.errors import UnknownName
from mbds_xsim.checks.integrity import gap
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.testing import CASES
from tests.command_line import CommandLine

pytest.importorskip("mujoco_warp")

ENGINE = load_adapter("mujoco-warp")
_OUT = ("--out", "data")


def test_a_device_that_is_not_there_is_told_in_a_line() -> None:
    scene = load_scene("2pendulum")

    with pytest.raises(UnknownName, match=r"no device of Warp is called 'cuda:7'.*cpu"):
        ENGINE.open(scene, Settings("RK4", scene.clock.frame, {"device": "cuda:7"}))


def test_what_is_read_back_are_the_numbers_of_the_kernels() -> None:
    scene = load_scene("workbench")

    with ENGINE.open(scene, ENGINE.settings(scene, "matched")) as run:
        native = run.readback(draw_batch(scene, [0]))

    mass = Mechanism.of(scene).mass
    np.testing.assert_array_equal(native.mass, mass.astype(np.float32).astype(float))
    assert (native.mass != mass).any()


def test_loops_are_closed_by_the_velocities_of_now() -> None:
    """With the velocities of the previous evaluation, loops would open by 0.36 mm."""
    (case,) = (case for case in CASES if case.name == "parallelogram")
    batch = draw_batch(case.scene, [0])

    with ENGINE.open(case.scene, Settings("RK4", case.scene.clock.frame)) as run:
        motion = run.rollout(batch)

    (opening,) = gap.finding(Record(case.scene, batch, motion)).figure
    assert opening < 5e-6


@pytest.mark.usefixtures("in_process")
def test_data_in_single_precision_say_so_and_hold_what_they_say(run: CommandLine) -> None:
    made = run("generate", "2pendulum", "--engines", "mujoco-warp", "--trajectories", "3", *_OUT)
    verify = run("verify", "data/2pendulum")
    audit = run("audit", "data/2pendulum/mujoco-warp-matched.h5", "--scene", "2pendulum")

    assert (made.code, verify.code, audit.code) == (0, 0, 0), (made.err, verify.out, audit.out)
    assert "simulated again: the same bits" in verify.out
    assert "velocities at the frames, in single precision" in " ".join(audit.out.split())
