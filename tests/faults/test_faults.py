"""Every planted fault fails the engine that has it, by a fitting check, and no other."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from mbds_xsim.measure.result import EngineResult, Validation
from mbds_xsim.simulate import registry

from .bench import ENGINES, able, checked, told
from .faults import FAULTS
from .planting import Fault, share
from .scenes import SCENES

pytestmark = pytest.mark.slow

_PLANTED = [(fault, engine) for fault in FAULTS for engine in fault.engines]
_SEEN = [
    pytest.param(fault, engine, id=f"{fault.name}, {engine}")
    for fault, engine in _PLANTED
    if engine not in fault.unseen
]
_UNSEEN = [
    pytest.param(fault, engine, id=f"{fault.name}, {engine}")
    for fault, engine in _PLANTED
    if engine in fault.unseen
]
_TOLD = [
    pytest.param(fault, engine, id=f"{fault.name}, {engine}")
    for fault, engine in _PLANTED
    if fault.change.told and engine not in fault.untold
]


@pytest.fixture(scope="module", autouse=True)
def _all_engines_and_references_of_this_run(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[None]:
    missing = set(ENGINES) - set(registry.installed_engines())
    if missing and not os.environ.get("MBDS_XSIM_MUST_RUN"):
        pytest.skip(f"not installed: {', '.join(sorted(missing))}")
    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "sound"
    share(folder / "simulations")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MBDS_XSIM_CACHE", str(folder))
        yield


@pytest.mark.parametrize("scene", SCENES)
def test_without_a_fault_every_engine_passes(scene: str) -> None:
    validation = checked(scene, readback=True)

    assert {row.engine: row.reasons for row in validation.engines} == dict.fromkeys(able(scene), ())
    assert validation.verdict == "pass"
    assert validation.odd_one_out is None


@pytest.mark.parametrize(("fault", "faulty"), _SEEN)
def test_the_motion_shows_a_fault(fault: Fault, faulty: str) -> None:
    validation = checked(fault.scene, fault, faulty)

    assert [row.engine for row in validation.engines if row.verdict == "fail"] == [faulty]
    failed = {finding.check for finding in _row(validation, faulty).findings if not finding.passed}
    assert failed & set(fault.checks), failed
    named = validation.odd_one_out
    assert named == f"{faulty} matched" or (named is None and not fault.odd)


@pytest.mark.parametrize(("fault", "faulty"), _TOLD)
def test_reading_the_model_back_tells_a_fault(fault: Fault, faulty: str) -> None:
    lines = told(fault.scene, fault, faulty)

    assert any(line.startswith(fault.change.told) for line in lines), lines


@pytest.mark.parametrize(("fault", "faulty"), _UNSEEN)
def test_what_is_said_to_be_unseen_is(fault: Fault, faulty: str) -> None:
    """A fault that a check sees belongs to those that must be seen."""
    assert checked(fault.scene, fault, faulty).verdict == "pass"


def _row(validation: Validation, engine: str) -> EngineResult:
    return next(row for row in validation.engines if row.engine == engine)
