"""Curves and records of a trade-off study: raw rows, and the points and results made of them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import msgspec

from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.base.files import read_file
from mbds_xsim.checks import agreement
from mbds_xsim.measure.runner import Keyed
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Adapter, Settings
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.claims import features_of
from mbds_xsim.simulate.simulator import NATIVE, EngineMethod, Options

SCHEMA = "mbds-xsim/tradeoff/1"

AT_ONCE = 64
"""Batch size of methods and models that simulate several trajectories at once."""
BATCH = f"{AT_ONCE} at a time"
"""Variation in which times are each trajectory's share of such a batch."""

Kind = Literal["done", "failed", "crashed", "timed out", "refused", "too slow"]
"""How a run ended: at the last frame; early, as engine or adapter report; with a crash of its
process; or at the time limit. Or why it was not started: its settings are not allowed, or it
would have taken longer than the limit."""
COUNTS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""Steps per frame at which a method is tried."""
DIGITS = (5, 6, 7, 8, 9, 10, 11, 12)
"""Digits n of the relative tolerances 10⁻ⁿ at which an adaptive method is tried."""
SPAN = 100
"""Steps per frame up to which a method is tried whatever its error: two decades of steps."""
_THIN = (2, 5, 20)  # steps per frame at which a changed option is tried


class Measurement(Keyed, frozen=True, kw_only=True):
    """Stored row: one start simulated at one setting."""

    scene: str
    engine: str
    version: str
    method: str
    variation: str
    options: Options
    steps_per_frame: int
    step_s: float
    rtol: float | None = None
    """Relative tolerance of an adaptive method, whose steps may span a whole frame; else None."""
    trajectory: int
    """Index of the start."""
    seed: int
    machine: str
    limit_s: float
    """Longest rollout allowed [s]."""
    kind: Kind
    reason: str = ""
    wall_s: tuple[float, ...] = ()
    """Wall time per simulated second, one entry per repeat."""
    cpu_s: tuple[float, ...] = ()
    """Processor time per simulated second, one entry per repeat."""
    setup_s: float | None = None
    """Time to load the model [s]."""
    error_m: float | None = None
    """RMS particle error at the horizon [m]."""
    horizon_s: float = 0.0
    """Time of `error_m` [s]: 1 s, or less if the reference or the scene ends earlier."""
    error_weighted_m: float | None = None
    """Largest error / max(1, G) over the frames with growth G < 100 [m]."""
    gap_m: float | None = None
    energy: float | None = None
    """Figure of the energy check, over the energy scale; with contact, of the passivity check."""
    broken: tuple[str, ...] = ()
    """Checks whose budget is exceeded."""
    coordinates: int | None = None
    constraints: int | None = None
    contact_pairs: int | None = None

    @property
    def count(self) -> int:
        """Steps per frame, or digits n of the tolerance 10⁻ⁿ."""
        return self.steps_per_frame if self.rtol is None else round(-math.log10(self.rtol))

    @property
    def unmeasured(self) -> bool:
        """Whether the run hit the time limit, so that it has no figures."""
        return self.kind == "timed out"


CurveRows = list[list[list[Measurement]]]
"""Rows, nested by curve, point and start."""


class Point(msgspec.Struct, frozen=True, kw_only=True):
    """One setting, summarised over its starts; errors are the worst of all starts."""

    steps_per_frame: int
    step_s: float
    rtol: float | None = None
    """Relative tolerance, which replaces the step of an adaptive method."""
    kind: Kind
    reason: str = ""
    starts: int = 0
    """Number of starts that were simulated to the end."""
    wall_s: float | None = None
    """Wall time per simulated second: median over the starts of the median over their repeats."""
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
    """Whether the point is on the Pareto front of cost and error."""


class CurveResult(msgspec.Struct, frozen=True, kw_only=True):
    """A method with one set of options, at several steps or tolerances."""

    engine: str
    version: str
    method: str
    family: str
    variation: str
    options: Options
    order: int
    """Declared order of convergence."""
    measured_order: float | None
    """Slope of log(error) over log(step) in the asymptotic range; None if it has none."""
    points: tuple[Point, ...]
    """Points, the longest step or loosest tolerance first."""
    own: bool = True
    """Whether the engine itself integrates; if not, this toolkit integrates its dynamics."""

    @property
    def changed(self) -> bool:
        """Whether an option differs from the usual; False for native settings and batches."""
        return self.variation not in ("", NATIVE, BATCH)

    @property
    def name(self) -> str:
        """Engine, method and variation."""
        return " ".join(filter(None, (self.engine, self.method, self.variation)))


class Ratio(msgspec.Struct, frozen=True, kw_only=True):
    """Cost of one accuracy on each curve."""

    error_m: float
    budget: bool
    """Whether `error_m` is the scene's budget at 1 s."""
    wall_s: tuple[float | None, ...]
    """Wall time per simulated second of each curve, interpolated; None if not reached."""
    best: int | None
    """Index of the cheapest curve; None if no curve reaches the accuracy."""


class ModelResult(msgspec.Struct, frozen=True, kw_only=True):
    """A trained model's figures on the engines' starts."""

    model: str
    training: str
    """Training data and seed, such as "not-mujoco-s0"."""
    variant: str
    """Variant of the training data: native or matched."""
    engines: tuple[str, ...]
    """Engines that made the training data."""
    source: str
    """Model file, as the user named it."""
    known_frames: int
    """Number of reference frames it is given (engines get none); times are of later frames."""
    at_once: int
    """Trajectories per batch."""
    alone: Point
    """Figures for one trajectory at a time."""
    batched: Point
    """Figures for a batch: times are each trajectory's share, errors are as in `alone`."""
    train_wall_s: float | None = None
    """Wall time of training [s], which no other time includes."""
    train_cpu_s: float | None = None
    train_steps: float | None = None
    """Number of optimiser steps."""
    train_trajectories: float | None = None
    train_device: str = ""
    machine: str = ""
    """Machine on which it was timed."""

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
    """Time of the charted error [s], the earliest of all starts."""
    reference_ends_s: float | None
    """Earliest impact after which a reference has no unique solution [s]; None if there is none."""
    own_limit: int | None = None
    """Steps per frame of each method's own run, which replaces a reference that ends at once:
    distances to it show convergence, not truth. None if there is a reference."""
    duration_s: float
    length_m: float
    budget: dict[str, float]
    contact: bool
    limit_s: float
    curves: tuple[CurveResult, ...]
    ratios: tuple[Ratio, ...]
    left_out: dict[str, str]
    """Methods that cannot simulate the scene and models of other scenes, each with the reason."""
    versions: dict[str, str]
    machine: str
    workers: int
    busy: float
    """Median ratio of wall time to processor time; above 1 if other work slowed the machine."""
    measured: int
    """Number of rows measured in this run."""
    kept: int
    """Number of rows kept from earlier runs."""
    wall_s: float
    fingerprint: str = ""
    """Hash of the scene's physics and starts; empty in results of earlier versions."""
    models: tuple[ModelResult, ...] = ()
    """Trained models, if any were asked for."""

    @property
    def error_budget_m(self) -> float:
        """Allowed error at the horizon [m]."""
        return self.budget["error_1s"] * self.length_m

    @property
    def second_s(self) -> float:
        """Time of the frame that stands for 1 s [s]; a shorter scene does not have it."""
        frames = (p.steps_per_frame * p.step_s for c in self.curves for p in c.points if not p.rtol)
        frame = next(frames, 1.0)
        return agreement.second(frame) * frame * (1 - 1e-9)

    @property
    def ends_early(self) -> bool:
        """Whether the scene ends before 1 s."""
        return self.duration_s < self.second_s

    @property
    def cut_short(self) -> bool:
        """Whether an impact ends the reference of a start before 1 s."""
        return self.reference_ends_s is not None and self.reference_ends_s < self.second_s


def read_tradeoff(path: Path) -> Tradeoff:
    """Read the file that the command wrote for one scene.

    Raises:
        InputError: The file cannot be read, or holds something else.
    """
    try:
        study = msgspec.json.decode(read_file(path), type=Tradeoff)
    except (OSError, msgspec.DecodeError) as error:
        msg = f"{path}: no result of one scene of mbds-xsim tradeoff ({error})"
        raise InputError(msg) from error
    if study.schema != SCHEMA:
        raise InputError(f"{path}: got schema {study.schema!r}, allowed is {SCHEMA!r}")
    return study


def curves_of(scene: Scene, engines: Sequence[str]) -> tuple[list[EngineMethod], dict[str, str]]:
    """List the curves of a scene's chart.

    All fixed-step methods of an engine use the options of its matched settings. An option is
    varied for the methods that its sweep names, or for the matched method only if it names none.

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
    """Return the curve of a method: matched options over steps, or tolerances if adaptive."""
    if adapter.methods[method].adaptive:
        return EngineMethod(adapter.name, method, own_options={}, counts=DIGITS, digits=True)
    # With the matched steps per frame, so that the chart shows the published settings.
    own = {matched.substeps(scene.clock.frame)} if method == matched.method else set()
    counts = tuple(sorted(own | set(COUNTS)))
    return EngineMethod(adapter.name, method, own_options=dict(matched.options), counts=counts)


def _variations(
    scene: Scene, adapter: Adapter, base: EngineMethod, preferred: str
) -> Iterator[EngineMethod]:
    """Yield the curves that differ from `base` in one option."""
    needs = features_of(scene)
    for option, sweep in adapter.sweeps.items():
        acts = base.method in (sweep.methods or (preferred,))
        if not acts or (sweep.needs and not sweep.needs & needs):
            continue
        usual = base.options(scene)
        used = usual.get(option, adapter.options[option].default)
        for value in sweep.values:
            if value != used:
                name, options = f"{option} = {value}", {**usual, option: value}
                yield dataclasses.replace(base, variation=name, own_options=options, counts=_THIN)


def _native(scene: Scene, adapter: Adapter) -> Iterator[EngineMethod]:
    try:
        settings = adapter.settings(scene, "native")
        adapter.check(scene, settings)
    except Unsupported:
        return
    if adapter.methods[settings.method].adaptive:  # its curve over the tolerances stands for it
        return
    yield EngineMethod.at(adapter.name, scene, settings, variation=NATIVE, profile="native")
