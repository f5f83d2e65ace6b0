"""A file of trajectories, read whole, as the core's own types."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.dataset.content import values_of
from mbds_xsim.dataset.facts import attributes_of, scene_of
from mbds_xsim.dataset.fit import check_fit
from mbds_xsim.dataset.gate import Making
from mbds_xsim.dataset.layout import known_names
from mbds_xsim.dataset.opened import opened
from mbds_xsim.engine import Method, Settings
from mbds_xsim.errors import InputError
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Failure, Trajectory

__all__ = ["Held"]

_STATE = ("position", "orientation", "velocity", "angular_velocity")


@dataclass(frozen=True, eq=False)
class Held:
    """What a shard, or a file of rejected trajectories, holds."""

    path: Path
    attributes: dict[str, Any]
    arrays: dict[str, NDArray[Any]]
    scene: Scene

    @staticmethod
    def read(path: Path) -> Held:
        """Read a file.

        Raises:
            InputError: It is no such file, its scene is none, or its datasets are not the scene's.
        """
        attributes = attributes_of(path)
        if attributes["kind"] not in ("shard", "rejected"):
            msg = f"{path}: got a file of the kind {attributes['kind']}, allowed is a shard"
            raise InputError(msg)
        scene = scene_of(attributes["scene"], path)
        with opened(path) as file:
            check_fit(file, path, attributes["kind"], scene)
            arrays = {name: values_of(file[name]) for name in known_names() if name in file}
        return Held(path, attributes, arrays, scene)

    def __len__(self) -> int:
        return len(self.arrays["index"])

    @property
    def batch(self) -> Batch:
        """Starts and inputs."""
        starts = {key: self.arrays[f"start/{key}"] for key in _STATE}
        force, torque = self.arrays["input/force"], self.arrays["input/torque"]
        return Batch(index=self.arrays["index"], **starts, force=force, torque=torque)

    @property
    def trajectory(self) -> Trajectory:
        """Motions; one that has no numbers to its end is a failure."""
        states = {key: self.arrays[f"body/{key}"] for key in _STATE}
        each = [np.isfinite(values).all(axis=(2, 3)) for values in states.values()]
        whole = np.logical_and.reduce(each)
        failures = tuple(
            None if row.all() else Failure(int(np.argmin(row)), "no numbers") for row in whole
        )
        return Trajectory(self.arrays["time"], **states, failures=failures)

    @property
    def making(self) -> Making:
        """What the file says of how it was made."""
        told = self.attributes
        method = Method(
            name=told["method"],
            family=told["method_family"],
            order=told["method_order"],
            velocity_lag=told["velocity_lag_s"] / told["step_s"],
        )
        return Making(method, told["step_s"], told["contact_time_s"])

    @property
    def settings(self) -> Settings:
        """Settings to make it again.

        Raises:
            InputError: Its options are none.
        """
        told = self.attributes
        try:
            options = msgspec.json.decode(told["options"], type=dict[str, Any])
        except (msgspec.DecodeError, UnicodeError) as error:
            msg = f"{self.path}: attribute options: got {told['options']!r}: {error}"
            raise InputError(msg) from error
        return Settings(told["method"], told["step_s"], options)
