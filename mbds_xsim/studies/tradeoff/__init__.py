"""What a trade-off study tries, and records: raw rows, and the points and curves made of them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import msgspec

from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.base.files import read_file
from mbds_xsim.measure.runner import Keyed
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Adapter, Settings
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.claims import features_of
from mbds_xsim.simulate.simulator import NATIVE, EngineMethod, Options

SCHEMA = "mbds-xsim/tradeoff/1"

INSTANT = 1.0
"""Time of the error that is charted, where the reference lasts so long [s]."""
AT_ONCE = 64
"""Trajectories of a batch, of what does several at once."""
BATCH = f"{AT_ONCE} at a time"
"""Variation that stands for each one's share of such a batch."""

Kind = Literal["done", "failed", "crashed", "timed out", "refused", "too slow"]
"""How a run ended: at the last frame; early, by the engine's or the adapter's word; with its
process; at the time limit; not at all, as the settings are not allowed; or it was not begun, as
it would have taken longer than the limit."""
COUNTS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""Steps a frame that a method is tried at."""
DIGITS = (5, 6, 7, 8, 9, 10, 11, 12)
"""Of the tolerances that an adaptive method is tried at."""
SPAN = 100
"""A method is tried up to so many steps a frame whatever comes of it: two decades of steps."""
_THIN = (2, 5, 20)  # steps a frame at which a changed option is tried


class Measurement(Keyed, frozen=True, kw_only=True):
    """One start simulated at one setting, as it is kept."""

    scene: str
    engine: str
    version: str
    method: str
    variation: str
    options: Options
    steps_per_frame: int
    step_s: float
    rtol: float | None = None
    """Relative tolerance of a method that chooses its steps, which may go over a whole frame."""
    trajectory: int
    """Index of the start."""
    seed: int
    machine: str
    limit_s: float
    """Longest time a rollout was given."""
    kind: Kind
    reason: str = ""
    wall_s: tuple[float, ...] = ()
    """Wall time per simulated second, one a repeat."""
    cpu_s: tuple[float, ...] = ()
    """Processor time per simulated second, one a repeat."""
    setup_s: float | None = None
    """Loading the model [s]."""
    error_m: float | None = None
    """RMS particle error at the horizon [m]."""
    horizon_s: float = 0.0
    """1 s, or where the reference ends before that."""
    error_weighted_m: float | None = None
    """Largest error / max(1, G) over the frames with growth G < 100 [m]."""
    gap_m: float | None = None
    energy: float | None = None
    """Energy balance over the energy scale; with contact, the passivity."""
    broken: tuple[str, ...] = ()
    """Checks whose budget is not kept."""
    coordinates: int | None = None
    constraints: int | None = None
    contact_pairs: int | None = None

    @property
    def count(self) -> int:
        """Steps a frame, or digits of the tolerance."""
        return self.steps_per_frame if self.rtol is None else round(-math.log10(self.rtol))

    @property
    def unmeasured(self) -> bool:
        """Whether it was not waited for, so that nothing is known of it."""
        return self.kind == "timed out"


Found = list[list[list[Measurement]]]
"""Rows by curve, by point and by start."""


class Point(msgspec.Struct, frozen=True, kw_only=True):
    """A setting: its rows put together. Errors are the worst of its starts."""

    steps_per_frame: int
    step_s: float
    rtol: float | None = None
    """In place of the step, where a method chooses its steps."""
    kind: Kind
    reason: str = ""
    starts: int = 0
    """Starts that were simulated to the end."""
    wall_s: float | None = None
    """Median wall time per simulated second over all starts and repeats."""
    wall_low_s: float | None = None
    wall_high_s: float | None = None
    cpu_s: float | None = None
    setup_s: float | None = None
    error_m: float | None = None
    error_weighted_m: float | None = None
    gap_m: float | None = None
    energy: float | None = None
    broken: tuple[str, ...] = ()
    on_front: bool = False
    """Whether no point is both faster and nearer to the reference."""


class CurveResult(msgspec.Struct, frozen=True, kw_only=True):
    """One way of simulating the scene, at several steps."""

    engine: str
    version: str
    method: str
    family: str
    variation: str
    options: Options
    order: int
    """Declared order of convergence."""
    measured_order: float | None
    """Slope of the asymptotic part of error over step; None where there is none."""
    points: tuple[Point, ...]
    """The longest step first."""
    own: bool = True
    """Whether the engine itself steps; else this toolkit steps the engine's dynamics."""

    @property
    def changed(self) -> bool:
        """Whether an option is another than usual."""
        return self.variation not in ("", NATIVE, BATCH)

    @property
    def name(self) -> str:
        """Engine, method and what is varied."""
        return " ".join(filter(None, (self.engine, self.method, self.variation)))


class Ratio(msgspec.Struct, frozen=True, kw_only=True):
    """What one accuracy costs."""

    error_m: float
    budget: bool
    """Whether it is the scene's budget at 1 s."""
    wall_s: tuple[float | None, ...]
    """Wall time per simulated second of each curve, interpolated; None: not reached."""
    best: int | None
    """Place of the cheapest curve."""


class Learned(msgspec.Struct, frozen=True, kw_only=True):
    """A trained model on the starts of the engines, behind the frames that it was given."""

    model: str
    training: str
    """What it was trained on, and its seed: "not-mujoco-s0"."""
    variant: str
    """Of that data: native or matched."""
    engines: tuple[str, ...]
    """Whose data it was trained on."""
    source: str
    """Its file."""
    known_frames: int
    """Of the reference, which no engine is given; times are of the frames behind them."""
    at_once: int
    """Trajectories of a batch."""
    alone: Point
    """One trajectory at a time."""
    batched: Point
    """A batch of them: times are each trajectory's share, errors the same."""
    train_wall_s: float | None = None
    """What training took [s], which is in no other time."""
    train_cpu_s: float | None = None
    train_steps: float | None = None
    """Of the optimiser."""
    train_trajectories: float | None = None
    train_device: str = ""
    machine: str = ""
    """That it was timed on."""

    @property
    def name(self) -> str:
        """Model, training and variant."""
        return f"{self.model} {self.training} {self.variant}"


class Tradeoff(msgspec.Struct, frozen=True, kw_only=True):
    """Speed against accuracy of one scene."""

    schema: str
    scene: str
    description: str
    command: str
    seed: int
    trajectories: tuple[int, ...]
    horizon_s: float
    """Time of the error that is charted; the smallest of all starts [s]."""
    reference_ends_s: float | None
    """Where a contact scene's reference first ends without a unique answer [s]."""
    own_limit: int | None = None
    """Where the reference ends at once, each method is held against its own run at so many steps
    a frame, which shows convergence and no truth; no budget of accuracy is judged."""
    duration_s: float
    length_m: float
    budget: dict[str, float]
    contact: bool
    limit_s: float
    curves: tuple[CurveResult, ...]
    ratios: tuple[Ratio, ...]
    left_out: dict[str, str]
    """Methods that cannot do the scene, each with the reason."""
    versions: dict[str, str]
    machine: str
    workers: int
    busy: float
    """Median of wall time over processor time: what else the machine had to do."""
    measured: int
    """Rows that were measured in this run."""
    kept: int
    """Rows that came from an earlier one."""
    wall_s: float
    fingerprint: str = ""
    """Stands for the scene's physics and starts; empty in results of earlier versions."""
    models: tuple[Learned, ...] = ()
    """Trained models, where any were asked for."""

    @property
    def error_budget_m(self) -> float:
        """Allowed error at the horizon [m]."""
        return self.budget["error_1s"] * self.length_m

    @property
    def cut_short(self) -> bool:
        """Whether an impact ends the reference of a start before the error's usual time."""
        return self.reference_ends_s is not None and self.reference_ends_s < INSTANT


def read_tradeoff(path: Path) -> Tradeoff:
    """Read what the command has written of one study.

    Raises:
        InputError: It cannot be read, or is something else.
    """
    try:
        found = msgspec.json.decode(read_file(path), type=Tradeoff)
    except (OSError, msgspec.DecodeError) as error:
        msg = f"{path}: no result of one scene of mbds-xsim tradeoff ({error})"
        raise InputError(msg) from error
    if found.schema != SCHEMA:
        msg = f"{path}: got schema {found.schema!r}, allowed is {SCHEMA!r}"
        raise InputError(msg)
    return found


def curves_of(scene: Scene, engines: Sequence[str]) -> tuple[list[EngineMethod], dict[str, str]]:
    """List the curves of a scene's chart.

    The options in use are those of the engine's matched settings, for all of its methods. They
    are changed for the matched method only, and where an option belongs to certain methods.

    Returns:
        The curves, and the methods left out as "engine method", each with the reason.
    """
    curves: list[EngineMethod] = []
    left_out: dict[str, str] = {}
    for name in engines:
        adapter = registry.load_adapter(name)
        try:
            matched = settings_for(scene, adapter, "matched")
        except Unsupported as error:
            left_out[name] = str(error)
            continue
        for method in adapter.methods:
            curve = _curve(scene, adapter, matched, method)
            if refusal := curve.refusal(scene):
                left_out[f"{name} {method}"] = refusal
            elif curve.digits:
                curves += [curve, dataclasses.replace(curve, variation=BATCH, together=AT_ONCE)]
            else:
                curves += [curve, *_variations(scene, adapter, curve, matched.method)]
        curves += _native(scene, adapter)
    return curves, left_out


def _curve(scene: Scene, adapter: Adapter, matched: Settings, method: str) -> EngineMethod:
    """Give a method at the matched options, and at steps or tolerances."""
    if adapter.methods[method].adaptive:
        return EngineMethod(adapter.name, method, given={}, counts=DIGITS, digits=True)
    counts = _counts(scene, matched, method)
    return EngineMethod(adapter.name, method, given=dict(matched.options), counts=counts)


def _counts(scene: Scene, matched: Settings, method: str) -> tuple[int, ...]:
    """Take the matched steps a frame in, so that the chart shows what is published."""
    own = {matched.substeps(scene.clock.frame)} if method == matched.method else set()
    return tuple(sorted(own | set(COUNTS)))


def _variations(
    scene: Scene, adapter: Adapter, base: EngineMethod, preferred: str
) -> Iterator[EngineMethod]:
    """Change one option at a time."""
    needs = features_of(scene)
    for option, sweep in adapter.sweeps.items():
        acts = base.method in (sweep.methods or (preferred,))
        if not acts or (sweep.needs and not sweep.needs & needs):
            continue
        usual = base.options(scene)
        used = usual.get(option, adapter.options[option].default)
        for value in sweep.values:
            if value != used:
                yield dataclasses.replace(
                    base,
                    variation=f"{option} = {value}",
                    given={**usual, option: value},
                    counts=_THIN,
                )


def _native(scene: Scene, adapter: Adapter) -> Iterator[EngineMethod]:
    try:
        settings = adapter.settings(scene, "native")
        adapter.check(scene, settings)
    except Unsupported:
        return
    if adapter.methods[settings.method].adaptive:  # on the curve, at the digits of its own
        return
    count = settings.substeps(scene.clock.frame)
    yield EngineMethod(
        adapter.name, settings.method, variation=NATIVE, given=dict(settings.options),
        counts=(count,), profile="native",
    )  # fmt: skip
