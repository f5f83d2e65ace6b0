"""Many trajectories of one model, which Warp's kernels step side by side."""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.base.errors import check_name
from mbds_xsim.base.process import redirected

# A cost improvement below this ends the solver. MuJoCo Warp cuts a model's to 1e-6, with which
# 2ladder diverges within 0.2 s.
_TOLERANCE = 1e-12
# Warp's own, which inline more, take a seventh longer to compile and are no faster.
_COMPILER = "-march=native"


class Worlds:
    """A model on a device, and as many states as trajectories were asked for last.

    Args:
        model: MuJoCo's; afterwards it has the numbers that the device has.
        rows: Constraint rows that a state can have.
        device: Warp's name of it.

    Raises:
        UnknownName: There is no such device.
    """

    def __init__(self, model: Any, rows: int, device: str) -> None:
        self._host, self._rows = model, rows
        self._device = _device(device)
        with wp.ScopedDevice(self._device):
            self._model = mjw.put_model(model)
        self._model.opt.tolerance.fill_(_TOLERANCE)
        self._model.opt.run_collision_detection = False
        self._model.opt.warn_overflow = 0  # in 24 bits it may not come so far, and would print it
        _as_held(model, self._model)
        if rows:
            _with_present_rates(self._model)
        self._data: Any = None
        self._graph: Any = None

    def stepped(
        self, start: tuple[Array, Array], force: Array, torque: Array, bodies: Index, count: int
    ) -> tuple[Array, Array]:
        """Step all trajectories, `count` steps a frame, and give qpos and qvel at each frame.

        Args:
            start: qpos and qvel, shapes (trajectory, nq) and (trajectory, nv).
            force: Held over each frame [N], shape (trajectory, step, body, 3).
            torque: Of the motors [N·m], shape (trajectory, step, motor).
            bodies: MuJoCo's numbers of the bodies.
            count: Steps of a frame.
        """
        with wp.ScopedDevice(self._device):
            self._put(start)
            data, frames = self._data, force.shape[1] + 1
            states = data.qpos, data.qvel
            kept = [np.empty((frames, *state.shape)) for state in states]
            push = np.zeros((len(force), self._host.nbody, 6), np.float32)
            for frame in range(frames):
                for values, state in zip(kept, states, strict=True):
                    values[frame] = state.numpy()
                if frame == frames - 1:
                    break
                push[:, bodies, :3] = force[:, frame]
                data.xfrc_applied.assign(push)
                if self._host.nu:
                    data.ctrl.assign(torque[:, frame].astype(np.float32))
                for _ in range(count):
                    wp.capture_launch(self._graph)
        q, u = (np.moveaxis(values, 0, 1) for values in kept)
        return q, u

    def read(self, start: tuple[Array, Array], data: Any) -> None:
        """Place the bodies of MuJoCo's `data` as kernels do at the first of some starts."""
        with wp.ScopedDevice(self._device):
            self._put(start)
            mjw.get_data_into(data, self._host, self._data)

    def _put(self, start: tuple[Array, Array]) -> None:
        """Start afresh, without the solver's memory of earlier trajectories."""
        if self._data is None or self._data.nworld != len(start[0]):
            self._record(len(start[0]))
        data = self._data
        for state in (data.qacc_warmstart, data.xfrc_applied, data.ctrl, data.time):
            state.zero_()
        for state, values in zip((data.qpos, data.qvel), start, strict=True):
            state.assign(values.astype(np.float32))
        mjw.forward(self._model, data)  # what a step reads of the one before

    def _record(self, count: int) -> None:
        """Make room, and a graph of the launches of a step, whose calls from Python cost more."""
        self._data = mjw.make_data(self._host, nworld=count, nconmax=0, njmax=self._rows)
        mjw.step(self._model, self._data)  # compiles, which a graph does not
        with wp.ScopedCapture() as capture:
            mjw.step(self._model, self._data)
        self._graph = capture.graph


def _device(name: str) -> Any:
    wp.config.log_level = wp.LOG_WARNING
    wp.config.cpu_compiler_flags = _COMPILER
    with open(os.devnull, "w") as nowhere, redirected((1, 2), nowhere.fileno()):
        wp.init()  # says what there is
    names = [device.alias for device in wp.get_devices()]
    check_name("device of Warp", name, names)
    return wp.get_device(name)


def _with_present_rates(model: Any) -> None:
    """Make the constraints again once the bodies' velocities are known.

    MuJoCo Warp 4.0.0 makes them before, with what the velocities of the evaluation before do to
    their rows (J̇ v): gaps in 2ladder are ten times as wide.
    """
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    model.callback.control = mjw.make_constraint


def _as_held(model: Any, held: Any) -> None:
    """Give MuJoCo's model the numbers of the kernels', which are shorter."""
    model.opt.timestep = float(held.opt.timestep.numpy()[0])
    for own, other in ((model, held), (model.opt, held.opt)):
        for field in dataclasses.fields(other):
            values, array = getattr(own, field.name, None), getattr(other, field.name)
            if isinstance(array, wp.array) and isinstance(values, np.ndarray):
                told = array.numpy()
                if told.dtype == np.float32 and told.size == values.size:
                    values[...] = told.reshape(values.shape)
