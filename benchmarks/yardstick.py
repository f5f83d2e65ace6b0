"""The toolkit against a bare MuJoCo loop: cost at equal error on the same starts.

python -m benchmarks.yardstick > reports/yardstick.md

The bare loop is what one writes by hand: RK4, a ball joint for every ball joint, a dense Jacobian,
no contact, one `mj_step` after the other. Its loops are closed as hard as the adapter closes them.
All settings take turns, start by start, in one process with one thread; costs are processor time.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import print_head, print_made, print_table, take_turns
from mbds_xsim.measure.campaign import run_references
from mbds_xsim.scene.joint_space import BodyStates, to_links
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.matched import settings_for

Array = NDArray[np.float64]
Rollout = Callable[[Batch], Array]
"""One start to the positions of centres of mass, shape (frame, body, 3)."""

Measure = Callable[[list[float]], float]
"""One figure for the errors of all starts."""

MEASURES: dict[str, Measure] = {
    "median": lambda errors: float(np.median(errors)),
    "RMS": lambda errors: float(np.sqrt(np.mean(np.square(errors)))),
    "worst": max,
}
STARTS = 20
MEDIUM = 1
REPEATS = 5
BARE_COUNTS = {"6pendulum": (1, 2, 3, 4, 6, 8), "3ladder": (1, 2, 4)}
OUR_COUNTS = (1, 2)
ENGINE = registry.load_adapter("mujoco")


@dataclass
class Setting:
    """One way to simulate, with what it cost and missed by, start by start."""

    name: str
    rollout: Rollout
    cost: list[float] = field(default_factory=list)
    error: list[float] = field(default_factory=list)

    @property
    def median_ms(self) -> float:
        return 1e3 * float(np.median(self.cost))


class Bare:
    """The loop that one writes by hand."""

    def __init__(self, scene: Scene, count: int, solver: str) -> None:
        self._mechanism, self._count = Mechanism.of(scene), count
        self._model: Any = mujoco.MjModel.from_xml_string(_bare_text(scene, count, solver))
        self._data: Any = mujoco.MjData(self._model)
        self._bodies = [self._model.body(body.name).id for body in scene.bodies]

    def __call__(self, batch: Batch) -> Array:
        model, data, bodies = self._model, self._data, self._bodies
        self._start(batch)
        positions = np.empty((batch.steps + 1, len(bodies), 3))
        positions[0] = data.xipos[bodies]
        for k in range(batch.steps):
            data.xfrc_applied[bodies, :3] = batch.force[0, k]
            for _ in range(self._count):
                mujoco.mj_step(model, data)
            mujoco.mj_kinematics(model, data)
            positions[k + 1] = data.xipos[bodies]
        return positions

    def _start(self, batch: Batch) -> None:
        model, data = self._model, self._data
        native = self._mechanism.native_rotation(batch.orientation)
        bodies = BodyStates(batch.position, native, batch.velocity, batch.angular_velocity)
        links = to_links(self._mechanism, bodies)
        mujoco.mj_resetData(model, data)
        for k, link in enumerate(self._mechanism.links):
            assert link.joint is not None
            joint = data.joint(link.joint.name)
            joint.qpos[:], joint.qvel[:] = links.rotation[0, k], links.angular_velocity[0, k]
        mujoco.mj_kinematics(model, data)


def _bare_text(scene: Scene, count: int, solver: str) -> str:
    """The adapter's model at its plainest, with MuJoCo's own flags but for contact."""
    step = scene.clock.frame / count
    plain = Settings("RK4", step, {"spin": True, "turn": 0.0, "solver": solver})
    with ENGINE.open(scene, plain) as run:
        root = ElementTree.fromstring(run.native(draw_batch(scene, [0])))
    for flag in root.iter("flag"):
        flag.attrib.clear()
        flag.set("contact", "disable")
    return ElementTree.tostring(root, encoding="unicode")


def ours(scene: Scene, settings: Settings) -> Rollout:
    run = ENGINE.open(scene, settings)
    return lambda batch: run.rollout(batch).position[0]


def measure(scene: Scene, settings: list[Setting]) -> None:
    """Let all settings take turns on each start."""
    batch = draw_batch(scene, range(MEDIUM, 3 * STARTS, 3))
    exact = run_references(scene, batch, cache=True, workers=None).trajectory.position
    second = round(1.0 / scene.clock.frame) + 1
    for row in range(len(batch)):
        start = batch[[row]]
        works = [functools.partial(setting.rollout, start) for setting in settings]
        costs = np.median(take_turns(works, (REPEATS, REPEATS)), axis=0)
        for setting, cost in zip(settings, costs, strict=True):
            setting.cost.append(float(cost))
            off = np.sum((setting.rollout(start)[:second] - exact[row, :second]) ** 2, axis=-1)
            setting.error.append(float(np.sqrt(off.mean(axis=-1)).max()))


def ratio(bare: list[Setting], mine: Setting, measure: Measure) -> float:
    """Cost of the bare loop at our error over our cost; NaN where it is not reached.

    Both axes logarithmic, between neighbouring steps of the bare loop.
    """
    error, own = [measure(setting.error) for setting in bare], measure(mine.error)
    order = np.argsort(error)
    if not error[order[0]] <= own <= error[order[-1]]:
        return math.nan
    costs = np.log([setting.median_ms for setting in bare])
    at = np.interp(np.log(own), np.log(np.array(error)[order]), costs[order])
    return float(np.exp(at) / mine.median_ms)


def _named(count: int, options: Mapping[str, object]) -> str:
    told = [f"{key} = {value}" for key, value in options.items()]
    return ", ".join([f"mbds-xsim, {count} a frame", *told])


def report(name: str) -> None:
    """Print the table of a scene."""
    scene = registry.load_scene(name)
    bare = [Setting(f"bare loop, {n} a frame", Bare(scene, n, "Newton")) for n in BARE_COUNTS[name]]
    own = ENGINE.settings(scene, "matched").options
    matched = settings_for(scene, ENGINE, "matched").options
    frame = scene.clock.frame
    mine = [
        Setting(_named(n, options), ours(scene, Settings("RK4", frame / n, options)))
        for options in ([own] if own == matched else [own, matched])
        for n in OUR_COUNTS
    ]
    if Mechanism.of(scene).loops:
        mine.insert(0, Setting("bare loop with PGS, 1 a frame", Bare(scene, 1, "PGS")))
    measure(scene, [*bare, *mine])
    print(f"\n## {name}\n")
    heads = "|".join(f">{measure} error [m]|>ratio" for measure in MEASURES)
    rows = (_row(setting, bare, judged=setting in mine) for setting in (*bare, *mine))
    print_table(f"steps|>ms a trajectory|>trajectories a second|{heads}", rows)


def _row(setting: Setting, bare: list[Setting], *, judged: bool) -> list[str]:
    cells = [setting.name, f"{setting.median_ms:.2f}", f"{1e3 / setting.median_ms:.0f}"]
    for how in MEASURES.values():
        gain = ratio(bare, setting, how) if judged else math.nan
        cells += [f"{how(setting.error):.1e}", "" if math.isnan(gain) else f"**{gain:.2f}**"]
    return cells


TEXT = f"""\
Cost at equal error beside a MuJoCo loop by hand, on {STARTS} starts of the medium interval. The
loop has RK4, ball joints, a dense Jacobian, no contact, and one call a step; its loops are closed
as hard as the adapter closes them. Error: largest RMS distance to the reference within the first
second. Cost: processor time of a trajectory, its start and, for the adapter, its conversion to
body states included; median of {REPEATS} repeats and of the starts, all settings in turn. Ratio:
cost of the loop with MuJoCo's default solver, interpolated to the same error, over that of the
line. The adapter's options are its own and, where they differ, those of the matched settings.
"""


def main() -> None:
    command = "python -m benchmarks.yardstick > reports/yardstick.md"
    print_head("Beside a bare MuJoCo loop", command, TEXT)
    for name in BARE_COUNTS:
        report(name)
    print_made(f"mujoco {ENGINE.version()}", f"numpy {np.__version__}")


if __name__ == "__main__":
    main()
