"""Campaign: adapters of other packages that go wrong in any of their duties."""

from __future__ import annotations

import dataclasses
import pickle
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
import numpy as np
import pytest
from hypothesis import strategies as st

from mbds_xsim.base import isolate
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import Conduct, Crash, Silent, Task
from mbds_xsim.dataset.generate import Request, generate
from mbds_xsim.report.catalogue import engine_rows
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Readback, Run
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.studies.tradeoff import curves_of
from mbds_xsim.studies.validate import validate_with_evidence
from tests.fuzz.campaign import fuzz

Call = Callable[..., None]
_SOUND = type(load_adapter("mujoco"))
_SCENE = msgspec.structs.replace(
    load_scene("1pendulum"),
    clock=msgspec.structs.replace(load_scene("1pendulum").clock, steps=10),
)


@dataclass(frozen=True, eq=False)
class _Point:
    """An entry point of no installed package."""

    load: Callable[[], type]
    name: str = "hostile"
    value: str = "other:Hostile"
    dist: None = None


class _Wordless(Exception):
    def __str__(self) -> str:
        raise self


_ERRORS: list[BaseException] = [
    RuntimeError("no licence\nfor this \x1b[31mhost"), SystemExit(3), KeyboardInterrupt(),
    MemoryError(), RecursionError(), StopIteration(), KeyError(()), _Wordless(),
    InputError("not today"), InputError(), OSError(28, "disk full"), AssertionError(),
]  # fmt: skip
_ODD: list[object] = [
    None, -1, 0, "", "x", b"\xff", (), {}, np.nan, -np.inf, 1e308, np.zeros(0), np.zeros((3, 2)),
    np.full((3, 11, 1, 3), np.nan), np.array([None]), object(), lambda: None, {"x": 1}, [None] * 3,
]  # fmt: skip
_CLAIMS = (
    "name", "package", "methods", "options", "sweeps", "limits", "coordinates", "contact_law",
    "smallest", "cut",
)  # fmt: skip
_ASKED = ("version", "settings", "cannot_hold", "contact_scales", "load")
_RUN = ("rollout", "readback", "close")
_MOTION = ("time", "position", "orientation", "velocity", "angular_velocity", "failures")
_READ = tuple(field.name for field in dataclasses.fields(Readback))
_PLACES = [
    *(("claim", name) for name in _CLAIMS),
    *(("asked", name) for name in _ASKED),
    *(("run", name) for name in _RUN),
    *(("motion", name) for name in _MOTION),
    *(("readback", name) for name in _READ),
    ("size", "size"),
]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Carry tasks out in this process, and keep references in a folder of their own."""
    folder = tmp_path_factory.mktemp("plugins")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MBDS_XSIM_CACHE", str(folder / "cache"))
        real = isolate.run_tasks
        for module in list(sys.modules.values()):
            if getattr(module, "run_tasks", None) is real:
                patch.setattr(module, "run_tasks", _carried_out)
        yield folder


@fuzz("plugin", where=st.sampled_from(_PLACES), what=st.sampled_from([*_ERRORS, *_ODD]))
def test_a_faulty_adapter_is_named_and_the_sound_one_has_its_result(
    place: Path, where: tuple[str, str], what: object
) -> None:
    kind, name = where
    points = {
        "hostile": _Point(lambda: _hostile(kind, name, what)),
        "mujoco": registry.registered("mbds_xsim.adapters")["mujoco"],
    }
    out = Path(tempfile.mkdtemp(dir=place))
    with mock.patch.object(registry, "registered", return_value=points):
        registry._answer.cache_clear()
        listed = {row.engine: row for row in engine_rows()}
        choice = Choice.parse()
        validation, _ = validate_with_evidence(_SCENE, choice=choice, conduct=Conduct(1))
        data = generate(
            Request((_SCENE,), choice, 3, out), workers=1, progress=Silent(), carry_out=_carried_out
        )
        curves, untried = curves_of(_SCENE, choice.engines)

    rows = {row.engine: row for row in validation.engines}
    assert listed["mujoco"].fault == ""
    assert rows["mujoco"].verdict == "pass"
    assert {count.variant: count.published for count in data.variants}["mujoco-matched"] == 3
    assert "hostile" in rows.keys() | validation.left_out.keys()
    usable = listed["hostile"].fault == "" and "hostile" in rows
    assert usable or "\n" not in listed["hostile"].fault + validation.left_out["hostile"]
    assert usable == any(curve.engine == "hostile" for curve in curves) or untried
    if kind in ("run", "motion", "readback", "size") and not _allowed(kind, name, what):
        assert rows["hostile"].verdict == "fail", rows["hostile"]
        assert all("\n" not in reason for reason in rows["hostile"].reasons)


def _allowed(kind: str, name: str, value: object) -> bool:
    """Return whether an odd value is legitimate: unused, empty, or a missing read-back."""
    unasked = ("close", "contact", "sphere", "damping")
    absent = ("joint_axis", "spring", "law", "armature", "friction", "limits", "drive", "coupling")
    unused = name in unasked and not isinstance(value, BaseException)
    empty = name in absent and isinstance(value, np.ndarray) and not value.size
    return unused or empty or (kind == "readback" and value is None)


def _carried_out(
    tasks: Sequence[Task], *, started: Call | None = None, finished: Call | None = None, **_: Any
) -> list[Any]:
    """Carry out tasks here as processes of their own would."""
    answers = []
    for number, task in enumerate(tasks):
        if started is not None:
            started(number)
        answers.append(_done(task))
        if finished is not None:
            finished(number, answers[-1])
    return answers


def _done(task: Task) -> Any:
    with mock.patch.object(isolate, "_begun", Path("/dev/null")):
        try:
            return pickle.loads(pickle.dumps(task.function(*task.arguments)))
        except InputError as error:
            return Crash(str(error), refused=True)
        except Exception as error:
            return Crash(" ".join("".join(traceback.format_exception_only(error)).split()))
        except BaseException as error:
            return Crash(f"the process crashed with {type(error).__name__}")


def _hostile(kind: str, name: str, value: object) -> type:
    """Make an adapter that is sound but for one thing: there it raises or returns an odd value."""

    def gives(*_: object) -> object:
        if isinstance(value, BaseException):
            raise value
        return value

    def load(self: Any, scene: Any, settings: Any) -> Run:
        run = _SOUND.load(self, scene, settings)
        if kind == "run":
            setattr(run, name, gives)
        elif kind == "size":
            run.size = value  # type: ignore[assignment]
        elif kind in ("motion", "readback"):
            _spoil(run, kind, **{name: value})
        return run

    body: dict[str, Any] = {"name": "hostile", "load": load}
    if kind == "claim":
        body[name] = property(gives) if isinstance(value, BaseException) else value
    elif kind == "asked":
        body[name] = gives
    return type("Hostile", (_SOUND,), body)


def _spoil(run: Run, kind: str, **odd: Any) -> None:
    rollout, readback = run.rollout, run.readback

    def moved(batch: Batch) -> Trajectory:
        return dataclasses.replace(rollout(batch), **odd)

    def read(batch: Batch) -> Readback:
        return dataclasses.replace(readback(batch), **odd)

    if kind == "motion":
        run.rollout = moved  # type: ignore[method-assign]
    else:
        run.readback = read  # type: ignore[method-assign]
