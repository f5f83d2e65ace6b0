"""Public functions of `import mbds_xsim`: the commands, taking and returning Python values.

Input that cannot be used raises `InputError` with the line that the command would print.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import check_ending, check_writable, path_of
from mbds_xsim.base.isolate import LIMIT, Conduct
from mbds_xsim.scene.sampling import Starts
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.choice import Choice

if TYPE_CHECKING:
    from mbds_xsim.dataset.audit import Audited
    from mbds_xsim.dataset.generate import Generated
    from mbds_xsim.dataset.verify import Verified
    from mbds_xsim.measure.result import Evidence, Validation
    from mbds_xsim.studies.tradeoff import Tradeoff

_MOST_STARTS = 10_000
_LARGEST_INDEX = 10**15 - 1  # as on the command line
_MOST_ROLLOUTS, _LONGEST = 1000, 1e7  # of a trade-off, as there


def load_scene(scene: Any) -> Scene:
    """Load a scene from a built-in name, a family with a size, or a path; return a `Scene` as is.

    Raises:
        InputError: There is no such scene, or its file is wrong; the text says where.
    """
    match scene:
        case Scene():
            return scene
        case str() | Path():
            return registry.load_scene(str(scene))
    raise InputError(f"scene: got {scene!r}, allowed is a Scene, a name or the path of a file")


def validate(
    scene: Scene | str | Path,
    *,
    engines: str | Iterable[str] = (),
    settings: str | Path | Iterable[str | Path] = "matched",
    trajectories: int = 1,
    seed: int = 0,
    method: str | None = None,
    step: float | None = None,
    noise: bool = True,
    inputs: bool = True,
    cache: bool = True,
    workers: int | None = None,
    limit: float = LIMIT,
    page: str | Path | None = None,
) -> Validation:
    """Run a scene in all engines, check every trajectory, and report which engines to trust.

    Args:
        scene: Scene to validate: the scene itself, its name, or its file.
        engines: One name or several; all installed ones when empty.
        settings: "matched", "native", the path of a settings file, or several.
        trajectories: Number of starts in each of the intervals low, medium and high.
        seed: Seed of starts and inputs.
        method: Integration method to use; needs a single engine.
        step: Step [s], a divisor of the frame interval.
        noise: Whether random forces act.
        inputs: Whether drawn inputs act: wind, drives.
        cache: Whether stored reference solutions may be used.
        workers: Number of processes; all cores by default. 0 works in this process, without limit.
        limit: Time limit of each process that runs an engine [s].
        page: File to write a self-contained page into.

    Raises:
        InputError: An argument cannot be used.
    """
    from mbds_xsim.studies.validate import validate_with_evidence

    trajectories = _whole("trajectories", trajectories, 1, _MOST_STARTS)
    seed = _whole("seed", seed, 0)
    _check(workers, limit, noise=noise, inputs=inputs, cache=cache)
    target = None if page is None else path_of("page", page)
    if target is not None:
        check_writable(target, "page")
        check_ending(target, "page")
    word = None if method is None else str(method)
    choice = Choice.parse(engines=engines, profiles=settings, method=word, step=step, limit=limit)
    validation, evidence = validate_with_evidence(
        load_scene(scene),
        choice=choice,
        starts=Starts(trajectories, seed, noise, inputs),
        conduct=Conduct(workers, cache),
        command="mbds_xsim.validate",
    )
    if target is not None:
        _write_page(target, validation, evidence)
    return validation


def _write_page(page: Path, validation: Validation, evidence: Evidence) -> None:
    from mbds_xsim.report.files import write_reports
    from mbds_xsim.studies.validate.present import present

    report = present(validation, evidence)
    write_reports([report], report.title, html=page)


def generate(
    scenes: Scene | str | Path | Iterable[Scene | str | Path],
    out: str | Path,
    *,
    engines: str | Iterable[str] = (),
    settings: str | Path | Iterable[str | Path] = "matched",
    trajectories: int = 15_000,
    seed: int = 0,
    noise: bool = True,
    workers: int | None = None,
    limit: float = LIMIT,
) -> Generated:
    """Make data sets: simulate, check every trajectory, publish those that pass.

    A call with the same arguments continues after an interruption.

    Args:
        scenes: One or several: scenes, their names, or their files.
        out: Folder of the data, made if needed.
        engines: One name or several; all installed ones when empty.
        settings: "matched" (certified), "native" (uncertified), the path of a settings file, or
            several.
        trajectories: Number of trajectories to draw; rejected ones are not replaced.
        seed: Seed of starts and inputs.
        noise: Whether random forces act.
        workers: Number of processes; all cores by default.
        limit: Time limit of each shard [s].

    Raises:
        InputError: An argument cannot be used.
    """
    from mbds_xsim.dataset.generate import Request
    from mbds_xsim.dataset.generate import generate as run

    trajectories = _whole("trajectories", trajectories, 1)
    seed = _whole("seed", seed, 0)
    _check(workers, limit, noise=noise)
    single = isinstance(scenes, str) or not isinstance(scenes, Iterable)
    several: Any = (scenes,) if single else scenes
    loaded = tuple(map(load_scene, several))
    if not loaded:
        raise InputError("scenes: got none, allowed are scenes, their names, or their files")
    choice = Choice.parse(engines=engines, profiles=settings, limit=limit)
    request = Request(loaded, choice, trajectories, path_of("--out", out), seed, noise)
    return run(request, workers=workers)


def audit(
    file: str | Path,
    scene: Scene | str | Path | None = None,
    *,
    index: str | int | Iterable[int] | None = None,
    seed: int | None = None,
    noise: bool | None = None,
    order: int | None = None,
    step: float | None = None,
    velocity_lag: float | None = None,
    contact_time: float | None = None,
) -> Audited:
    """Check trajectories from any source: another engine, a lab, a learned model.

    Args:
        file: npz, CSV or HDF5; docs/data-commands.md lists names and columns.
        scene: Scene that moves; by default the one that the file names.
        index: Numbers of the starts in the order of the file, as 3, "0-9,15" or [0, 1]; the motion
            is compared with them.
        seed: Seed of those starts.
        noise: Whether their random forces acted.
        order: Order of the method that made it; 1 by default.
        step: Integration step [s]; the frame interval by default.
        velocity_lag: Lag of the velocities [s]: they belong to frame time + lag.
        contact_time: Time over which an impact is spread [s].

    Raises:
        InputError: The file, or what is stated about it, cannot be used.
    """
    from mbds_xsim.dataset.audit import audit_file
    from mbds_xsim.dataset.foreign import SHORTEST_STEP, Provenance

    if noise is not None:
        _check(noise=noise)
    origin = Provenance(
        index=None if index is None else _numbers(index),
        seed=None if seed is None else _whole("seed", seed, 0),
        noise=noise,
        step_s=_seconds("step", step, SHORTEST_STEP),
        method_order=None if order is None else _whole("order", order, 1),
        velocity_lag_s=_seconds("velocity_lag", velocity_lag),
        contact_time_s=_seconds("contact_time", contact_time, 0.0),
    )
    return audit_file(path_of("file", file), None if scene is None else load_scene(scene), origin)


def verify(path: str | Path, *, seed: int | None = None, workers: int | None = None) -> Verified:
    """Check a data file, or a folder of them, again from its own contents alone.

    Args:
        path: Path of the file or folder.
        seed: Seed that chooses the trajectories to simulate again; unpredictable by default.
        workers: Number of processes; all cores by default.

    Raises:
        InputError: There is nothing to check.
    """
    from mbds_xsim.dataset.verify import verify as run

    _check(workers)
    seed = None if seed is None else _whole("seed", seed, 0)
    return run(path_of("path", path), seed=seed, conduct=Conduct(workers))


def tradeoff(
    scene: Scene | str | Path,
    *,
    engines: str | Iterable[str] = (),
    starts: int = 3,
    seed: int = 0,
    limit: float = 30.0,
    workers: int | None = None,
    fresh: bool = False,
) -> Tradeoff:
    """Measure speed against accuracy of engines on a scene.

    Args:
        scene: Scene to simulate: the scene itself, its name, or its file.
        engines: One name or several; all installed ones and the reference if empty.
        starts: Number of starts, drawn from the medium interval.
        seed: Seed of starts and inputs.
        limit: Longest rollout of one start [s]; points that would take longer are only listed.
        workers: Number of processes at a time; one per core if None, only this one for 0.
        fresh: Whether points that were measured earlier are measured again.

    Raises:
        InputError: An argument cannot be used.
    """
    from mbds_xsim.studies.tradeoff.study import tradeoff_with_rows

    starts = _whole("starts", starts, 1, _MOST_ROLLOUTS)
    seed = _whole("seed", seed, 0)
    _check(workers, limit, 0.1, _LONGEST, fresh=fresh)
    choice = Choice.parse(engines=engines, also=(registry.REFERENCE,))
    return tradeoff_with_rows(
        load_scene(scene),
        choice=choice,
        starts=starts,
        seed=seed,
        limit=limit,
        conduct=Conduct(workers, fresh=fresh),
        command="mbds_xsim.tradeoff",
    )[0]


def _numbers(index: str | int | Iterable[int]) -> tuple[int, ...]:
    """Read the numbers of starts."""
    from mbds_xsim.dataset.read import parse_numbers

    if isinstance(index, str):
        return tuple(parse_numbers(index, "--index"))
    if isinstance(index, np.ndarray):
        index = index.ravel().tolist()
    indices = index if isinstance(index, Iterable) else (index,)
    return tuple(_whole("index", number, 0, _LARGEST_INDEX) for number in indices)


def _seconds(name: str, value: object, least: float | None = None) -> float | None:
    if value is None:
        return None
    name = name.replace("_", "-")  # as on the command line
    if not isinstance(value, int | float | np.integer | np.floating) or isinstance(value, bool):
        raise InputError(f"--{name}: got {value!r}, allowed is a number [s]")
    try:
        seconds = float(value)
    except OverflowError:  # a whole number beyond all floats
        seconds = math.inf
    if not math.isfinite(seconds):
        raise InputError(f"--{name}: got {seconds}, allowed is a finite number [s]")
    if least is not None and seconds < least:
        raise InputError(f"--{name}: got {value!r}, allowed is {least:g} or more [s]")
    return seconds


def _check(
    workers: int | None = None,
    limit: object = LIMIT,
    least: float = 1.0,
    most: float = math.inf,
    **flags: object,
) -> None:
    """Refuse bad arguments; a flag may not be another value that Python takes for true."""
    if workers is not None:
        _whole("workers", workers, 0)
    if not isinstance(limit, int | float | np.integer) or not least <= limit <= most:
        allowed = f"{least:g} or more" if most == math.inf else f"{least:g} to {most:g}"
        raise InputError(f"--limit: got {limit!r}, allowed is {allowed} [s]")
    for name, value in flags.items():
        if not isinstance(value, bool | np.bool_):
            raise InputError(f"--{name}: got {value!r}, allowed is True or False")


def _whole(name: str, value: object, least: int, most: int | None = None) -> int:
    if (
        not isinstance(value, int | np.integer)
        or isinstance(value, bool)
        or value < least
        or (most is not None and value > most)
    ):
        allowed = f"{least} or more" if most is None else f"{least} to {most}"
        raise InputError(f"--{name}: got {value!r}, allowed is a whole number, {allowed}")
    return int(value)
