"""Check trajectories from any source, and report which checks their file does not allow."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.frame import frame_of
from mbds_xsim.checks import CHECKS, Finding, Record, audited
from mbds_xsim.checks.finding import Check
from mbds_xsim.dataset.foreign import Foreign, Provenance, completed, read_foreign
from mbds_xsim.dataset.points import Points, recover
from mbds_xsim.measure.campaign import reference_of
from mbds_xsim.measure.judge import error_findings, failed_lines, finding_result, turn_finding
from mbds_xsim.measure.result import FindingResult
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import STATES, Batch, Trajectory
from mbds_xsim.simulate.claims import Method

_OF_POSITIONS = tuple(check for check in CHECKS if check.of_positions)
_OF_VELOCITIES = tuple(check for check in CHECKS if not check.of_positions)
_OF_REFERENCE = ("error at 1 s", "error growth-weighted", "error of turns")
_ALOFT = np.array([0.0, 0.0, 1e9])  # [m]: from there nothing falls to the ground within a frame
_MOST_COMPARED = 3
_COARSE = 0.25  # share of the budget of gaps; rounding of places that is larger is told
_SAME_INPUT = 1e-9
_SAME_START = 1e-12


@dataclass(frozen=True)
class Audited:
    """Result of the audit of a file of trajectories."""

    file: str
    scene: str
    verdict: str
    """Result of the checks that ran: "pass" or "fail"."""
    trajectories: int
    steps: int
    frame_s: float
    given: tuple[str, ...]
    """Arrays that the file has."""
    taken: tuple[str, ...]
    """Assumptions: the start, the inputs, the method, and the quantities that were derived."""
    findings: tuple[FindingResult, ...]
    reasons: tuple[str, ...]
    """A line for each check that failed."""
    not_checked: dict[str, str]
    """Checks that could not run, each with the reason."""

    def to_frame(self) -> Any:
        """Return a `pandas.DataFrame` with one row per check."""
        return frame_of(self.findings)


def audit_file(path: Path, scene: Scene | None, origin: Provenance) -> Audited:
    """Check a file of trajectories.

    Args:
        path: npz, HDF5 or CSV; `docs/data-commands.md` lists names and columns.
        scene: Scene that moves; the file's own if None.
        origin: Further facts, which take precedence over those in the file.

    Raises:
        InputError: The file, or a fact given about it, cannot be used.
    """
    by_check: dict[str, list[_Part]] = {}
    assumptions, not_checked = dict[str, None](), dict[str, str]()
    first: _Case | None = None
    for foreign in read_foreign(path, scene):
        case = _Case(foreign, origin)
        first = first or case
        for finding in case.findings():
            by_check.setdefault(finding.check, []).append(_Part(case.batch, finding))
        assumptions |= dict.fromkeys(case.assumptions)
        not_checked |= case.not_checked
    assert first is not None  # a file without trajectories is refused
    worst = [max(parts, key=lambda part: part.excess) for parts in by_check.values()]
    reasons = tuple(line for part in worst for line in part.lines)
    return Audited(
        file=str(path),
        scene=foreign.scene.name,
        verdict="fail" if reasons else "pass",
        trajectories=foreign.total,
        steps=foreign.steps,
        frame_s=foreign.scene.clock.frame,
        given=tuple(foreign.arrays),
        taken=(_start_assumption(first, case), *assumptions),
        findings=tuple(map(_pooled, worst, by_check.values())),
        reasons=reasons,
        not_checked={name: reason for name, reason in not_checked.items() if name not in by_check},
    )


class _Part:
    """Finding of one check about some of the trajectories."""

    def __init__(self, batch: Batch, finding: Finding) -> None:
        self.excess = float(finding.excess.max())
        """Worst figure less its uncertainty; infinite if it is NaN."""
        self.result = finding_result(batch, finding)
        self.lines = failed_lines(batch, [finding])
        """Reasons why the check failed."""


def _pooled(worst: _Part, parts: list[_Part]) -> FindingResult:
    """Combine findings about parts of the trajectories into one about all of them."""
    if len(parts) == 1:
        return worst.result
    return msgspec.structs.replace(
        worst.result,
        passed=all(part.result.passed for part in parts),
        figures=tuple(figure for part in parts for figure in part.result.figures),
        note="",  # it is about some of the trajectories only
    )


class _Case:
    """A file with its starts and inputs; collects the assumptions made and the checks left out."""

    def __init__(self, foreign: Foreign, origin: Provenance) -> None:
        self.foreign, self.origin = foreign, completed(origin, foreign)
        self.assumptions: list[str] = []
        self.not_checked: dict[str, str] = {}
        self.orientation: Array | None = None
        """Orientations in the file, or fitted to its points; set by the checks of bodies."""
        self.position = foreign.arrays.get("position")
        """Positions of the points: those of the bodies, once these are checked."""
        self.named = self.origin.index is not None and self.origin.seed is not None
        """Whether seed and index are given, so that the start is known."""
        self.batch = (
            _draw_starts(foreign, self.origin)
            if self.named
            else _unnamed(foreign, self.assumptions)
        )

    @functools.cached_property
    def points(self) -> Points:
        """The scene's points."""
        return Points.of(self.foreign.scene)

    def rounding(self, *names: str) -> float:
        """Return the largest rounding error of the named arrays; missing arrays count as exact."""
        return max(self.foreign.rounding.get(name, 0.0) for name in names)

    def findings(self) -> list[Finding]:
        """Run every check that the file allows."""
        arrays, findings = self.foreign.arrays, list[Finding]()
        turned = self.rounding("body/orientation") * self.foreign.scene.length
        coarse = max(self.rounding("position", "body/position"), turned)
        if coarse > _COARSE * self.foreign.scene.budget.gap:
            self.assumptions.append(
                f"rounding: places are known to {coarse:.0e} m only, by which gap, rigidity, "
                "displacement and others may fail; give more digits"
            )
        if "body/position" in arrays:
            states = {key: arrays.get(f"body/{key}") for key in STATES}
            place, *others = (self.rounding(f"body/{key}") for key in STATES)
            blur = max(place / self.foreign.scene.length, *others)
            findings += self._of_bodies(states, blur, self.rounding("body/orientation"))
            findings += self._carried(states)
        else:
            findings += self._of_points(arrays["position"], arrays.get("velocity"))
        if self.named:
            findings += [*self._inputs(), *self._errors()]
        else:
            reason = "no --index and --seed, so the start is unknown"
            self.not_checked |= dict.fromkeys(("start", *_OF_REFERENCE), reason)
        return findings

    def _of_bodies(
        self, states: dict[str, Array | None], blur: float | None, turned: float
    ) -> list[Finding]:
        """Run the checks on body states; without velocities, only the checks of positions.

        States may be rounded by `blur`, places over the scene's length, orientations by `turned`.
        `blur` is None for states fitted to points: then the points, and not the bodies, are
        compared with the start.
        """
        self.orientation = states["orientation"]
        method, step = self._method()
        batch, checks = self.batch, CHECKS
        if states["velocity"] is None:
            # Hinges count full turns by their rates; those of the start need not last.
            still = {key: np.zeros_like(getattr(batch, key)) for key in STATES[2:]}
            batch, checks = dataclasses.replace(batch, **still), _OF_POSITIONS
            states = states | {key: np.zeros_like(states["position"]) for key in still}
            self._leave_out("no velocities", _OF_VELOCITIES)
        trajectory = self._trajectory(states)
        spread = self.origin.contact_time_s
        record = Record(self.foreign.scene, batch, trajectory, method, step, spread)
        findings = audited(record, checks)
        if blur is None:
            self.not_checked["precision"] = "bodies are fitted to the particles"
        rounding = {"start": blur or 0.0, "finite": 2.0 * turned}  # of a norm of four components
        if max(rounding.values()) > _SAME_INPUT:
            self.not_checked["precision"] = "the numbers have float32 precision or less"
            self.assumptions.append(
                f"rounding: start and finite may be off by up to {max(rounding.values()):.0e}"
            )
        return [
            dataclasses.replace(one, uncertainty=one.uncertainty + rounding.get(one.check, 0.0))
            for one in findings
            if one.check not in self.not_checked
            if one.check != "start" or (self.named and blur is not None)
        ]

    def _trajectory(self, states: dict[str, Array | None]) -> Trajectory:
        """Return a `Trajectory`; missing states are those of the start in every frame."""
        whole = {key: values for key, values in states.items() if values is not None}
        for key in set(STATES) - set(whole):
            shape = (len(self.batch), self.foreign.steps + 1, *getattr(self.batch, key).shape[1:])
            whole[key] = np.broadcast_to(getattr(self.batch, key)[:, None], shape)
        failures = (None,) * len(self.batch)
        return Trajectory(self.foreign.arrays["time"], **whole, failures=failures)

    def _of_points(self, position: Array, velocity: Array | None) -> list[Finding]:
        """Fit rigid bodies to the points, and check the bodies if the points determine them all."""
        scene = self.foreign.scene
        fit = recover(scene, position, velocity)
        names = tuple(body.name for body in scene.bodies)
        rigid = Finding.of("rigidity", "m", fit.residual, budget=scene.budget.gap, names=names)
        if fit.undetermined:
            few = ", ".join(fit.undetermined[:3]) + (" …" if len(fit.undetermined) > 3 else "")
            reason = f"the particles do not show how {few} turned; give body states"
            self.not_checked["error of turns"] = reason
            self._leave_out(reason, CHECKS)
            return [rigid, *self._start_of(position, velocity)]
        self.assumptions.append("bodies: fitted to the particles as rigid, by least squares")
        states = {key: getattr(fit, key) for key in STATES}
        return [*self._of_bodies(states, None, 0.0), rigid, *self._start_of(position, velocity)]

    def _start_of(self, position: Array, velocity: Array | None) -> list[Finding]:
        """Compare the particles at frame 0 with the start that seed and index give."""
        if not self.named:
            return []
        drawn = self._trajectory({})
        parts = np.full((*position.shape[:2], 1), np.nan)
        pairs = zip((position, velocity), self.points.motion(drawn), strict=True)
        errors = [np.abs(got[:, 0] - own[:, 0]) for got, own in pairs if got is not None]
        parts[:, 0, 0] = np.stack([error.max(axis=(1, 2)) for error in errors]).max(axis=0)
        rounding = self.rounding("position", "velocity")
        if rounding > _SAME_INPUT:
            self.assumptions.append(f"rounding: start may be off by up to {rounding:.0e}")
        return [Finding.of("start", "1", parts, budget=_SAME_START, uncertainty=rounding)]

    def _carried(self, states: dict[str, Array | None]) -> list[Finding]:
        """Compare the particles with the bodies that carry them."""
        scene, arrays, findings = self.foreign.scene, self.foreign.arrays, list[Finding]()
        names = tuple(scene.bodies[body].name for body in self.points.body)
        trajectory = self._trajectory(states)
        own, blurs = self.points.motion(trajectory), self._blurs(trajectory)
        self.position = own[0]
        scales = (("particles", "m", 1.0), ("particle velocities", "m/s", scene.clock.frame))
        for key, carried, blur, (check, unit, scale) in zip(
            ("position", "velocity"), own, blurs, scales, strict=True
        ):
            if key in arrays and states[key] is None:
                self.not_checked[check] = "no velocities of bodies"
            elif key in arrays:
                off = np.linalg.norm(arrays[key] - carried, axis=-1)
                budget = scene.budget.gap / scale
                finding = Finding.of(check, unit, off, budget=budget, names=names, uncertainty=blur)
                findings.append(finding)
        return findings

    def _blurs(self, trajectory: Trajectory) -> tuple[float, float]:
        """Return how far rounding can take particles, and their velocities, from the bodies."""
        place, turn, drift, rate = (self.rounding(f"body/{key}") for key in STATES)
        reach = float(np.linalg.norm(self.points.offset, axis=-1).max())
        swing = 4.0 * turn * reach  # of a quaternion whose four components are rounded
        spin = float(np.linalg.norm(trajectory.angular_velocity, axis=-1).max())
        size = 2.0 * 3.0**0.5 - 1.0  # as three components of both may be rounded, not one
        position = self.rounding("position") + size * place + swing
        return position, self.rounding("velocity") + size * (drift + rate * reach) + spin * swing

    def _leave_out(self, reason: str, checks: tuple[Check, ...]) -> None:
        """Note that those of the checks that apply to the scene could not run."""
        still = self._trajectory({})[:1]
        # Where nothing moves, dry friction may hold every joint.
        speed = np.full_like(still.velocity, np.arange(1, still.velocity.shape[2] + 1)[:, None])
        place = still.position + _ALOFT
        aloft = dataclasses.replace(still, position=place, velocity=speed, angular_velocity=speed)
        record = Record(self.foreign.scene, self.batch[:1], aloft)
        self.not_checked |= {finding.check: reason for finding in audited(record, checks)}

    def _method(self) -> tuple[Method | None, float | None]:
        """Return the method and the step of the trajectories, as far as they are known."""
        origin = self.origin
        if (origin.method_order, origin.velocity_lag_s, origin.single_precision) == (None,) * 3:
            self.assumptions.append("method: unknown, so budgets are those of first order")
            return None, origin.step_s
        step = origin.step_s or self.foreign.scene.clock.frame
        order, lag = origin.method_order or 1, (origin.velocity_lag_s or 0.0) / step
        timing = f"{lag:g} steps off the frames" if lag else "at the frames"
        single = bool(origin.single_precision)
        precision = ", in single precision" if single else ""
        method = Method("told", "semi-implicit Euler", order, velocity_lag=lag, single=single)
        actual = method.order_for(self.foreign.scene)
        judged = f", judged as of order {actual} (forces have kinks)" if actual < order else ""
        self.assumptions.append(f"method: of order {order}{judged}, velocities {timing}{precision}")
        return method, step

    def _inputs(self) -> list[Finding]:
        """Compare the inputs in the file with those that seed and index give."""
        findings = []
        for key in ("force", "torque"):
            inputs = self.foreign.arrays.get(f"input/{key}")
            if inputs is None or not inputs.size:
                continue
            drawn = getattr(self.batch, key)
            deviation = np.abs(inputs - drawn).reshape(*inputs.shape[:2], -1).max(axis=2)
            scale = float(np.abs(drawn).max()) or 1.0
            rounding = self.rounding(f"input/{key}") / scale
            parts = np.pad(deviation / scale, ((0, 0), (0, 1)))[:, :, None]
            findings.append(Finding.of(key, "1", parts, budget=_SAME_INPUT, uncertainty=rounding))
        return findings

    def _errors(self) -> list[Finding]:
        """Compare the points of the first trajectories with the reference."""
        if not (rows := list(range(min(len(self.batch), _MOST_COMPARED - self.foreign.first)))):
            return []
        scene, batch = self.foreign.scene, self.batch[rows]
        solved = reference_of(scene, batch, cache=True)
        if self.foreign.total > _MOST_COMPARED:
            self.assumptions.append(
                f"reference: compared with the first {_MOST_COMPARED} trajectories only"
            )
        assert self.position is not None  # of points or of bodies, without which a file is refused
        offset = self.position[rows] - self.points.motion(solved.trajectory)[0]
        error = np.sqrt(np.mean(np.sum(offset**2, axis=-1), axis=-1))
        findings = error_findings(scene, batch, error, solved.trajectory, solved.growth)
        if all(finding.check != "error at 1 s" for finding in findings):
            self.not_checked["error at 1 s"] = (
                "needs a frame at 1 s that the reference reaches, in the interval low or medium"
            )
        if self.orientation is not None:
            turned = self.orientation[rows]
            findings.append(turn_finding(scene, turned, solved.trajectory, solved.growth))
        return findings


def _start_assumption(first: _Case, last: _Case) -> str:
    """Describe the starts, from the first trajectory to the last."""
    if not last.named:
        return "start: frame 0 of the file"
    origin, ends = first.origin, (int(first.batch.index[0]), int(last.batch.index[-1]))
    noise = "with" if origin.noise is not False else "without"
    numbers = f"{ends[0]}" if first.foreign.total == 1 else f"{ends[0]} … {ends[1]}"
    return f"start and inputs: those of seed {origin.seed}, index {numbers}, {noise} noise"


def _draw_starts(foreign: Foreign, origin: Provenance) -> Batch:
    """Draw the starts; the file may have fewer frames than the scene, but at the same times."""
    clock, own = foreign.original.clock, foreign.scene.clock
    if own.frame != clock.frame or own.steps > clock.steps:
        raise InputError(
            f"{foreign.source}: got {own.steps} steps of {own.frame:.6g} s, allowed with "
            f"--index is up to {clock.steps} of {clock.frame:g} s, over which the start's inputs "
            "are held; leave --index out, or record at the scene's frames"
        )
    noise, index = origin.noise is not False, origin.index or ()
    batch = draw_batch(foreign.original, index, seed=origin.seed or 0, noise=noise)
    return batch.truncated(own.steps)


def _unnamed(foreign: Foreign, assumptions: list[str]) -> Batch:
    """Return a batch with the inputs in the file, or with only those that the scene lists."""
    scene, count, frame = foreign.scene, foreign.count, foreign.original.clock.frame
    if scene.clock.frame != frame:
        own = f"{scene.clock.frame:.6g} s, as its times are in seconds"
        assumptions.append(f"frames: every {own}; the scene's are every {frame:g} s")
    batch = draw_batch(scene, [0], noise=False, inputs=False)[np.zeros(count, dtype=np.int64)]
    inputs = {}
    for key in ("force", "torque"):
        values = foreign.arrays.get(f"input/{key}")
        inputs[key] = getattr(batch, key) if values is None else values
        if getattr(batch, key).size:
            source = "none but what the scene lists" if values is None else "those of the file"
            assumptions.append(f"{key}s: {source}")
    return dataclasses.replace(batch, index=np.arange(count) + foreign.first, **inputs)
