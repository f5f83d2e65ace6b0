"""Many trajectories of one model, stepped side by side by Warp's kernels."""

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

# A cost improvement below this ends the solver. MuJoCo Warp raises a model's value to 1e-6, with
# which 2ladder diverges within 0.2 s.
_TOLERANCE = 1e-12
# Warp's own flags, which inline more, take a seventh longer to compile and run no faster.
_COMPILER = "-march=native"


class Worlds:
    """A model on a device, with one state per trajectory of the last batch.

    Args:
        model: MuJoCo's model; it takes over the device's single-precision numbers.
        rows: Number of constraint rows that a state can have.
        device: Warp's name of the device.

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
        self._model.opt.warn_overflow = 0  # no printed warning if 24 bits miss the tolerance
        _copy_numbers(model, self._model)
        if rows:
            _with_present_rates(self._model)
        self._data: Any = None
        self._graph: Any = None

    def step_frames(
        self, start: tuple[Array, Array], force: Array, torque: Array, bodies: Index, count: int
    ) -> tuple[Array, Array]:
        """Step all trajectories, `count` steps a frame; return qpos and qvel at each frame.

        Args:
            start: qpos and qvel, shapes (trajectory, nq) and (trajectory, nv).
            force: Forces held over each frame [N], shape (trajectory, step, body, 3).
            torque: Torques of the motors [N·m], shape (trajectory, step, motor).
            bodies: MuJoCo's numbers of the bodies.
            count: Number of steps of a frame.
        """
        with wp.ScopedDevice(self._device):
            self._put(start)
            data, frames = self._data, force.shape[1] + 1
            states = data.qpos, data.qvel
            records = [np.empty((frames, *state.shape)) for state in states]
            push = np.zeros((len(force), self._host.nbody, 6), np.float32)
            for frame in range(frames):
                for values, state in zip(records, states, strict=True):
                    values[frame] = state.numpy()
                if frame == frames - 1:
                    break
                push[:, bodies, :3] = force[:, frame]
                data.xfrc_applied.assign(push)
                if self._host.nu:
                    data.ctrl.assign(torque[:, frame].astype(np.float32))
                for _ in range(count):
                    wp.capture_launch(self._graph)
        q, u = (np.moveaxis(values, 0, 1) for values in records)
        return q, u

    def read(self, start: tuple[Array, Array], data: Any) -> None:
        """Set MuJoCo's `data` to what the kernels compute at the first of some starts."""
        with wp.ScopedDevice(self._device):
            self._put(start)
            mjw.get_data_into(data, self._host, self._data)

    def _put(self, start: tuple[Array, Array]) -> None:
        """Set starts without the solver's memory of earlier trajectories."""
        if self._data is None or self._data.nworld != len(start[0]):
            self._record(len(start[0]))
        data = self._data
        for state in (data.qacc_warmstart, data.xfrc_applied, data.ctrl, data.time):
            state.zero_()
        for state, values in zip((data.qpos, data.qvel), start, strict=True):
            state.assign(values.astype(np.float32))
        mjw.forward(self._model, data)  # computes what a step reads from the one before

    def _record(self, count: int) -> None:
        """Allocate states, and record a step's launches as a graph: calls from Python cost more."""
        self._data = mjw.make_data(self._host, nworld=count, nconmax=0, njmax=self._rows)
        mjw.step(self._model, self._data)  # compiles the kernels, which recording does not
        with wp.ScopedCapture() as capture:
            mjw.step(self._model, self._data)
        self._graph = capture.graph


def _device(name: str) -> Any:
    wp.config.log_level = wp.LOG_WARNING
    wp.config.cpu_compiler_flags = _COMPILER
    with open(os.devnull, "w") as nowhere, redirected((1, 2), nowhere.fileno()):
        wp.init()  # prints the devices
    names = [device.alias for device in wp.get_devices()]
    check_name("device of Warp", name, names)
    return wp.get_device(name)


def _with_present_rates(model: Any) -> None:
    """Make the constraints again once the bodies' velocities are known.

    MuJoCo Warp 4.0.0 makes them earlier, so that J̇ v of their rows has the velocities of the
    evaluation before. Gaps in 2ladder are then ten times as wide.
    """
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    model.callback.control = mjw.make_constraint


def _copy_numbers(model: Any, device_model: Any) -> None:
    """Copy the kernels' single-precision numbers to MuJoCo's model."""
    model.opt.timestep = float(device_model.opt.timestep.numpy()[0])
    for target, source in ((model, device_model), (model.opt, device_model.opt)):
        for field in dataclasses.fields(source):
            values, array = getattr(target, field.name, None), getattr(source, field.name)
            if isinstance(array, wp.array) and isinstance(values, np.ndarray):
                numbers = array.numpy()
                if numbers.dtype == np.float32 and numbers.size == values.size:
                    values[...] = numbers.reshape(values.shape)
