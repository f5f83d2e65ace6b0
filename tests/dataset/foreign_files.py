"""Trajectories as files from elsewhere hold them, and what an audit of them found."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from mbds_xsim.dataset.audit import Audited
from mbds_xsim.dataset.foreign import Provenance
from mbds_xsim.dataset.points import Points
from mbds_xsim.dataset.table import groups
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import STATES
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.timed import simulate

Arrays = dict[str, NDArray[Any]]
Audit = Callable[..., Audited]

INDEX = (3, 4)
NAMED = Provenance(index=INDEX, seed=7)
FIRST = Provenance(index=INDEX[:1], seed=7)


def simulated(scene: Scene) -> Arrays:
    """Simulate both starts, and return all that a file may hold."""
    contender = Choice.parse(engines="mujoco").contenders(scene)[0][0]
    batch = draw_batch(scene, INDEX, seed=7)
    motion = simulate(scene, batch, "mujoco", contender.settings).trajectory
    position, velocity = Points.of(scene).motion(motion)
    arrays: Arrays = {"time": motion.time, "position": position, "velocity": velocity}
    arrays |= {f"body/{key}": getattr(motion, key) for key in STATES}
    return arrays | {"input/force": batch.force, "input/torque": batch.torque}


def only(arrays: Arrays, *names: str) -> Arrays:
    return {name: arrays[name] for name in ("time", *names)}


def first_of(arrays: Arrays) -> Arrays:
    """Return the first trajectory, as files of one hold it."""
    return {name: values if name == "time" else values[0] for name, values in arrays.items()}


def checks_of(result: Audited) -> set[str]:
    return {finding.check for finding in result.findings}


def failed_in(result: Audited) -> set[str]:
    return {finding.check for finding in result.findings if not finding.passed}


def write_csv(path: Path, scene: Scene, one: Arrays, shown: Callable[[float], str] = repr) -> None:
    columns, names = [[*map(shown, one["time"].tolist())]], ["time"]
    for group in groups(scene):
        if group.name in one:
            values = one[group.name].reshape(len(one[group.name]), -1)
            names += group.columns.ravel().tolist()
            padded = [[shown(value) for value in column] for column in values.T.tolist()]
            columns += [column + [""] * (len(one["time"]) - len(column)) for column in padded]
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([names, *zip(*columns, strict=True)])
