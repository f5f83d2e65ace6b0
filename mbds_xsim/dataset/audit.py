"""Check trajectories from anywhere, and say which checks their file does not allow."""

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
from mbds_xsim.checks import Finding, Record, audited
from mbds_xsim.checks.integrity import angle_gap, finite, gap, planarity, start
from mbds_xsim.checks.passivity import penetration
from mbds_xsim.dataset.foreign import Foreign, Provenance, read_foreign
from mbds_xsim.dataset.gate import COLUMNS
from mbds_xsim.dataset.points import Points, recover
from mbds_xsim.measure.campaign import reference_of
from mbds_xsim.measure.judge import error_findings, failed_lines, finding_result
from mbds_xsim.measure.result import FindingResult
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import STATES, Batch, Trajectory
from mbds_xsim.simulate.claims import Method

_OF_POSITIONS = (finite, start, gap, angle_gap, planarity, penetration)
_OF_VELOCITIES = (
    "gap rate", "angle gap rate", "displacement", "kinematics", "velocity lag", "energy",
    "momentum", "coefficients",
)  # fmt: skip
_OF_REFERENCE = ("error at 1 s", "error growth-weighted")
_OF_CONTACT = tuple(COLUMNS)[list(COLUMNS).index("penetration") + 1 : -len(_OF_REFERENCE)]
_MOST_COMPARED = 3
_SAME_INPUT = 1e-9
_SAME_START = 1e-12


@dataclass(frozen=True)
class Audited:
    """What became of the trajectories of a file."""

    file: str
    scene: str
    verdict: str
    """"pass" or "fail", of the checks that ran."""
    trajectories: int
    steps: int
    frame_s: float
    given: tuple[str, ...]
    """Arrays that the file has."""
    taken: tuple[str, ...]
    """What was taken for what: the start, the inputs, the method, what was derived."""
    findings: tuple[FindingResult, ...]
    reasons: tuple[str, ...]
    """A line for each check that failed."""
    not_checked: dict[str, str]
    """Checks that could not run, with the reason."""

    def to_frame(self) -> Any:
        """Give a `pandas.DataFrame` with a row for each check."""
        return frame_of(self.findings)


def audit_file(path: Path, scene: Scene | None, origin: Provenance) -> Audited:
    """Check a file of trajectories.

    Args:
        path: npz, HDF5 or CSV; `docs/data-commands.md` lists names and columns.
        scene: What moves; None: what the file says.
        origin: What else is known.

    Raises:
        InputError: The file, or what is told of it, cannot be used.
    """
    found: dict[str, list[_Part]] = {}
    taken, not_checked = dict[str, None](), dict[str, str]()
    first: _Case | None = None
    for foreign in read_foreign(path, scene):
        case = _Case.of(foreign, origin)
        first = first or case
        for finding in case.findings():
            found.setdefault(finding.check, []).append(_Part.of(case.batch, finding))
        taken |= dict.fromkeys(case.taken)
        not_checked |= case.not_checked
    assert first is not None  # no trajectory is refused
    worst = [max(parts, key=lambda part: part.excess) for parts in found.values()]
    reasons = tuple(line for part in worst for line in part.lines)
    return Audited(
        file=str(path),
        scene=foreign.scene.name,
        verdict="fail" if reasons else "pass",
        trajectories=foreign.total,
        steps=foreign.steps,
        frame_s=foreign.scene.clock.frame,
        given=tuple(foreign.arrays),
        taken=(_start_taken(first, case), *taken),
        findings=tuple(map(_pooled, worst, found.values())),
        reasons=reasons,
        not_checked={name: why for name, why in not_checked.items() if name not in found},
    )


@dataclass(frozen=True)
class _Part:
    """What a check finds about some of the trajectories."""

    excess: float
    """Of the worst figure, less what the check cannot resolve."""
    result: FindingResult
    lines: list[str]
    """Why it failed."""

    @staticmethod
    def of(batch: Batch, finding: Finding) -> _Part:
        over = finding.figure[finding.worst] - finding.uncertainty[finding.worst]
        excess = float(np.nan_to_num(over, nan=np.inf))
        return _Part(excess, finding_result(batch, finding), failed_lines(batch, [finding]))


def _pooled(worst: _Part, parts: list[_Part]) -> FindingResult:
    """Give findings about some trajectories at a time as one about all of them."""
    if len(parts) == 1:
        return worst.result
    return msgspec.structs.replace(
        worst.result,
        passed=all(part.result.passed for part in parts),
        figures=tuple(figure for part in parts for figure in part.result.figures),
        note="",  # told of some trajectories alone
    )


@dataclass(eq=False)
class _Case:
    """A file with its starts and inputs; collects what was taken for granted and left out."""

    foreign: Foreign
    batch: Batch
    named: bool
    """Whether seed and index name the start."""
    origin: Provenance
    taken: list[str]
    not_checked: dict[str, str]

    @staticmethod
    def of(foreign: Foreign, origin: Provenance) -> _Case:
        """Settle starts and inputs."""
        origin = _completed(origin, foreign)
        taken: list[str] = []
        named = origin.index is not None and origin.seed is not None
        batch = _drawn(foreign, origin) if named else _unnamed(foreign, taken)
        return _Case(foreign, batch, named, origin, taken, {})

    @functools.cached_property
    def points(self) -> Points:
        """The scene's points."""
        return Points.of(self.foreign.scene)

    def rounding(self, *names: str) -> float:
        """By how much numbers of some arrays may be rounded, those that are there."""
        return max(self.foreign.rounding.get(name, 0.0) for name in names)

    def findings(self) -> list[Finding]:
        """Run every check that the file allows."""
        arrays, found = self.foreign.arrays, list[Finding]()
        points = arrays.get("position")
        if "body/position" in arrays:
            states = {key: arrays.get(f"body/{key}") for key in STATES}
            blur = self.rounding(*(f"body/{key}" for key in STATES))
            found += self._of_bodies(states, blur, self.rounding("body/orientation"))
            if points is not None:
                found.append(self._carried(points))
        elif points is not None:
            found += self._of_points(points, arrays.get("velocity"))
        if self.named:
            found += [*self._inputs(), *self._errors()]
        else:
            reason = "no --index and --seed: which start it is is not told"
            self.not_checked |= dict.fromkeys(("start", *_OF_REFERENCE), reason)
        return found

    def _of_bodies(
        self, states: dict[str, Array | None], blur: float | None, turned: float
    ) -> list[Finding]:
        """Run the checks on states of bodies, without velocities those of positions alone.

        They may be rounded by `blur`, orientations by `turned`; None: what was fitted is not held
        against the start, which the points are.
        """
        method, step = self._method()
        spread = self.origin.contact_time_s
        trajectory = self._trajectory(states)
        record = Record(self.foreign.scene, self.batch, trajectory, method, step, spread)
        if states["velocity"] is not None:
            found = audited(record)
        else:
            maybe = [check(record) for check in _OF_POSITIONS]
            found = [finding for finding in maybe if finding is not None]
            self._leave_out("no velocities")
        if blur is None:
            self.not_checked["precision"] = "bodies are fitted to the particles"
        off = {"start": blur or 0.0, "finite": turned}
        if max(off.values()) > _SAME_INPUT:
            self.not_checked["precision"] = "the numbers are float32, or have no more digits"
            self.taken.append(
                f"rounding: start and finite may be off by {max(off.values()):.0e} for it"
            )
        return [
            dataclasses.replace(one, uncertainty=one.uncertainty + off.get(one.check, 0.0))
            for one in found
            if one.check not in self.not_checked
            if one.check != "start" or (self.named and blur is not None)
        ]

    def _trajectory(self, states: dict[str, Array | None]) -> Trajectory:
        """Give the core's type; velocities that nothing looks at are those of the start."""
        whole = {key: values for key, values in states.items() if values is not None}
        for key in set(STATES) - set(whole):
            frames = (len(self.batch), self.foreign.steps + 1, *getattr(self.batch, key).shape[1:])
            whole[key] = np.broadcast_to(getattr(self.batch, key)[:, None], frames)
        failures = (None,) * len(self.batch)
        return Trajectory(self.foreign.arrays["time"], **whole, failures=failures)

    def _of_points(self, position: Array, velocity: Array | None) -> list[Finding]:
        """Fit rigid bodies to the points, and check these where the points tell all of them."""
        scene = self.foreign.scene
        fit = recover(scene, position, velocity)
        names = tuple(body.name for body in scene.bodies)
        rigid = Finding.of("rigidity", "m", fit.residual, budget=scene.budget.gap, names=names)
        if fit.undetermined:
            few = ", ".join(fit.undetermined[:3]) + (" …" if len(fit.undetermined) > 3 else "")
            reason = f"the particles do not tell how {few} turned; give body states"
            self._leave_out(reason, *_positional(scene))
            return [rigid, *self._start_of(position, velocity)]
        self.taken.append("body states: rigid bodies fitted to the particles by least squares")
        states = {key: getattr(fit, key) for key in STATES}
        return [*self._of_bodies(states, None, 0.0), rigid, *self._start_of(position, velocity)]

    def _start_of(self, position: Array, velocity: Array | None) -> list[Finding]:
        """Hold the particles at frame 0 against the start that is named."""
        if not self.named:
            return []
        drawn = self._trajectory({})
        parts = np.full((*position.shape[:2], 1), np.nan)
        pairs = zip((position, velocity), self.points.motion(drawn), strict=True)
        off = [np.abs(got[:, 0] - own[:, 0]) for got, own in pairs if got is not None]
        parts[:, 0, 0] = np.stack([each.max(axis=(1, 2)) for each in off]).max(axis=0)
        coarse = self.rounding("position", "velocity")
        return [Finding.of("start", "1", parts, budget=_SAME_START, uncertainty=coarse)]

    def _carried(self, position: Array) -> Finding:
        """Hold particles against the bodies that carry them."""
        off = np.linalg.norm(position - self._positions(), axis=-1)
        scene = self.foreign.scene
        names = tuple(scene.bodies[body].name for body in self.points.body)
        return Finding.of("particles", "m", off, budget=scene.budget.gap, names=names)

    def _leave_out(self, reason: str, *more: str) -> None:
        touching = _OF_CONTACT if self.foreign.scene.contacts else ()
        self.not_checked |= dict.fromkeys((*more, *_OF_VELOCITIES, *touching), reason)

    def _method(self) -> tuple[Method | None, float | None]:
        """What is known of how it was made."""
        origin = self.origin
        if origin.method_order is None and origin.velocity_lag_s is None:
            self.taken.append("method: unknown, so budgets are those of first order")
            return None, origin.step_s
        step = origin.step_s or self.foreign.scene.clock.frame
        order, lag = origin.method_order or 1, (origin.velocity_lag_s or 0.0) / step
        when = f"{lag:g} steps off the frames" if lag else "at the frames"
        single = bool(origin.single_precision)
        bits = ", in single precision" if single else ""
        method = Method("told", "semi-implicit Euler", order, velocity_lag=lag, single=single)
        held = method.order_for(self.foreign.scene)
        judged = f", judged as of order {held} (forces have kinks)" if held < order else ""
        self.taken.append(f"method: of order {order}{judged}, velocities {when}{bits}")
        return method, step

    def _inputs(self) -> list[Finding]:
        """Hold inputs of the file against those that seed and index give."""
        found = []
        for key in ("force", "torque"):
            given = self.foreign.arrays.get(f"input/{key}")
            if given is None or not given.size:
                continue
            drawn = getattr(self.batch, key)
            off = np.abs(given - drawn).reshape(*given.shape[:2], -1).max(axis=2)
            scale = max(1.0, float(np.abs(drawn).max()))
            rounding = self.rounding(f"input/{key}") / scale
            parts = np.pad(off / scale, ((0, 0), (0, 1)))[:, :, None]
            found.append(Finding.of(key, "1", parts, budget=_SAME_INPUT, uncertainty=rounding))
        return found

    def _errors(self) -> list[Finding]:
        """Hold some of the trajectories against the reference, by their points."""
        rows = list(range(min(len(self.batch), _MOST_COMPARED - self.foreign.first)))
        if not rows:
            return []
        scene, batch = self.foreign.scene, self.batch[rows]
        solved = reference_of(scene, batch, cache=True)
        if self.foreign.total > _MOST_COMPARED:
            self.taken.append(
                f"reference: compared with the first {_MOST_COMPARED} trajectories only"
            )
        apart = self._positions()[rows] - self.points.motion(solved.trajectory)[0]
        error = np.sqrt(np.mean(np.sum(apart**2, axis=-1), axis=-1))
        found = error_findings(scene, batch, error, solved.trajectory, solved.growth)
        if all(finding.check != "error at 1 s" for finding in found):
            self.not_checked["error at 1 s"] = (
                "needs a frame at 1 s that the reference knows, of an interval low or medium"
            )
        return found

    def _positions(self) -> Array:
        """Give the points, from the bodies where these are given."""
        arrays = self.foreign.arrays
        if "body/position" not in arrays:
            return arrays["position"]
        states = {key: arrays.get(f"body/{key}") for key in STATES}
        return self.points.motion(self._trajectory(states))[0]


def _positional(scene: Scene) -> list[str]:
    """Checks of positions that apply to a scene, but for those that particles allow, too."""
    mechanism = Mechanism.of(scene)
    applies = {
        "gap": mechanism.joints or mechanism.distances,
        "angle gap": any(joint.kind != "ball" for joint in mechanism.joints),
        "planarity": scene.dimension < 3,
        "penetration": scene.contacts,
    }
    return [name for name, does in applies.items() if does]


def _completed(origin: Provenance, foreign: Foreign) -> Provenance:
    """Add what the file says where the user says nothing; of numbers those of its trajectories."""
    first, total = foreign.first, foreign.total
    said = {key: value for key, value in vars(origin).items() if value is not None}
    if origin.index is not None:
        if len(origin.index) != total:
            msg = (
                f"--index: got {len(origin.index)} numbers, allowed for {foreign.source} are "
                f"{total}, one a trajectory"
            )
            raise InputError(msg)
        said["index"] = origin.index[first : first + foreign.count]
    elif len(given := foreign.said.get("index", range(foreign.count))) != foreign.count:
        msg = f"{foreign.source}: index: got {len(given)} numbers, allowed is one a trajectory"
        raise InputError(msg)
    default = {} if origin.index is None else {"seed": 0}
    return Provenance(**(default | foreign.said | said))


def _start_taken(first: _Case, last: _Case) -> str:
    """Say which starts they are, from the first trajectory to the last."""
    if not last.named:
        return "start: frame 0 of the file"
    origin, ends = first.origin, (int(first.batch.index[0]), int(last.batch.index[-1]))
    noise = "with" if origin.noise is not False else "without"
    numbers = f"{ends[0]}" if first.foreign.total == 1 else f"{ends[0]} … {ends[1]}"
    return f"start and inputs: those of seed {origin.seed}, index {numbers}, {noise} noise"


def _drawn(foreign: Foreign, origin: Provenance) -> Batch:
    """Draw the starts; the file may have fewer frames, but the same ones."""
    clock, own = foreign.asked.clock, foreign.scene.clock
    if own.frame != clock.frame or own.steps > clock.steps:
        msg = (
            f"{foreign.source}: got {own.steps} steps of {own.frame:.6g} s, allowed for a start "
            f"that --index names are up to {clock.steps} of {clock.frame:g} s, over which its "
            "inputs are held; leave --index away, or record at the scene's frames"
        )
        raise InputError(msg)
    noise, index = origin.noise is not False, origin.index or ()
    batch = draw_batch(foreign.asked, index, seed=origin.seed or 0, noise=noise)
    return batch.truncated(own.steps)


def _unnamed(foreign: Foreign, taken: list[str]) -> Batch:
    """Give the file's own start, its inputs, or none but those that the scene lists."""
    scene, count = foreign.scene, foreign.count
    batch = draw_batch(scene, [0], noise=False, inputs=False)
    batch = batch[np.zeros(count, dtype=np.int64)]
    inputs = {}
    for key in ("force", "torque"):
        given = foreign.arrays.get(f"input/{key}")
        inputs[key] = getattr(batch, key) if given is None else given
        if getattr(batch, key).size:
            what = "none but what the scene lists" if given is None else "those of the file"
            taken.append(f"{key}s: {what}")
    return dataclasses.replace(batch, index=np.arange(count), **inputs)
