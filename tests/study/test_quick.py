"""Settings for scenes that have none stored: found quickly, kept by physics, read from files."""

from __future__ import annotations

import dataclasses
import math
import time
import warnings
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.base.isolate import HERE, Conduct, Silent
from mbds_xsim.checks.finding import Finding
from mbds_xsim.measure import quick
from mbds_xsim.measure.campaign import run_references
from mbds_xsim.measure.quick import COUNTS, fewest, searched
from mbds_xsim.measure.trial import Trial, run_trial
from mbds_xsim.scene.sampling import Starts
from mbds_xsim.scene.scene import Body, Clock, Force, Inertia, Joint, Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.choice import Choice, Matched, is_stored, settings_for
from mbds_xsim.studies.validate import validate_with_evidence
from tests.plugins import faulty

MUJOCO = registry.load_adapter("mujoco")
DART = registry.load_adapter("dart")
REFERENCE = registry.load_adapter("reference")

pytestmark = pytest.mark.usefixtures("search")


def cart_pole(name: str = "cart-pole", pull: float = 2.0) -> Scene:
    """A pole on a cart that is pushed to and fro, as a user writes it: nothing is drawn."""
    return Scene(
        name=name,
        dimension=2,
        length=1.0,
        bodies=(
            Body("cart", inertia=Inertia(1.0, (0.01, 0.01, 0.01))),
            Body("pole", inertia=Inertia(0.2, (0.017, 0.017, 0.001)), position=(0.0, 0.0, 0.5)),
        ),
        joints=(
            Joint("rail", "slider", "world", "cart", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
            Joint("pivot", "hinge", "cart", "pole", (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), rate=1.0),
        ),
        forces=(Force("cart", ((pull, 0.0, 0.0), (-pull, 0.0, 0.0)), hold=25),),
        clock=Clock(0.02, 60),
    )


def _searched(scene: Scene, engines: str, conduct: Conduct = HERE) -> dict[str, Matched]:
    choice = searched(scene, Choice.parse(engines=engines), conduct)
    return dict(choice.settings.get("matched", {}))


def test_settings_keep_the_budgets_and_cost_a_fraction_of_the_presets() -> None:
    scene = cart_pole()
    choices = _searched(scene, "mujoco,dart")

    for adapter, least in ((MUJOCO, 3.0), (DART, 10.0)):
        preset = adapter.settings(scene, "matched").substeps(scene.clock.frame)
        assert choices[adapter.name].steps_per_frame * least <= preset
    choice = Choice(("mujoco", "dart"), settings={"matched": choices})
    validation, _ = validate_with_evidence(scene, choice=choice, conduct=HERE)
    assert [row.reasons for row in validation.engines] == [(), ()]


def test_what_was_found_is_kept_by_physics_not_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    choices = _searched(cart_pole(), "mujoco")
    tried: list[str] = []

    def search(scene: Scene, *_: object) -> None:
        tried.append(scene.name)

    monkeypatch.setattr(quick, "_search", search)

    assert _searched(cart_pole("another name"), "mujoco") == choices
    assert tried == []
    _searched(cart_pole("pulled harder", pull=3.0), "mujoco")
    _searched(cart_pole("afresh"), "mujoco", Conduct(0, cache=False))
    assert tried == ["pulled harder", "afresh"]


def test_no_scene_gets_the_settings_of_another_by_its_name() -> None:
    ladder = registry.load_scene("3ladder")
    impostor = cart_pole("3ladder")

    assert is_stored(ladder, "mujoco")
    assert not is_stored(impostor, "mujoco")
    assert settings_for(impostor, MUJOCO, "matched") == MUJOCO.settings(impostor, "matched")
    assert settings_for(ladder, MUJOCO, "matched") != MUJOCO.settings(ladder, "matched")
    short = msgspec.structs.replace(ladder, clock=Clock(ladder.clock.frame, 10))
    assert is_stored(short, "mujoco")
    assert _searched(ladder, "mujoco") == {}


def test_a_smaller_budget_than_the_built_in_scene_has_is_searched_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(quick, "_search", lambda *_: Matched("RK4", 7))
    monkeypatch.setattr(quick, "run_references", lambda *_: None)
    ladder = registry.load_scene("3ladder")

    def found(energy: float) -> dict[str, Matched]:
        budget = msgspec.structs.replace(ladder.budget, energy=energy)
        return _searched(msgspec.structs.replace(ladder, budget=budget), "mujoco")

    assert found(10.0 * ladder.budget.energy) == {}
    assert found(0.1 * ladder.budget.energy) == {"mujoco": Matched("RK4", 7)}


def test_where_nothing_is_found_in_time_the_presets_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quick, "_LIMIT", -1.0)
    scene = cart_pole()
    choice = searched(scene, Choice.parse(engines="mujoco"), HERE)

    (contender,), _ = choice.contenders(scene)
    assert contender.settings == MUJOCO.settings(scene, "matched")


def test_a_method_that_chooses_its_steps_is_tried_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with faulty(tmp_path / "packages", "adapting"):
        found = _searched(cart_pole(), "adapting")["adapting"]
        choice = Choice.parse(engines="adapting", profiles="native", method="adaptive")
        ((contender,), _) = choice.contenders(cart_pole())
    scene = cart_pole()
    batch, truth = Starts().draw(scene), REFERENCE.settings(scene, "matched")
    monkeypatch.setattr("mbds_xsim.measure.trial.is_unknown", lambda _: True)
    trial = run_trial(scene, batch, "reference", truth, run_references(scene, batch, HERE), 1)

    assert found.method in MUJOCO.methods
    assert contender.settings == Settings("adaptive", scene.clock.frame)
    assert trial.passed


def test_an_engine_that_gives_no_settings_is_left_out_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quick, "_search", lambda *_: Matched("Euler", 1))
    scene, engines = cart_pole(), ("refusing", "mujoco")
    with faulty(tmp_path / "packages", "refusing"):
        choice = searched(scene, Choice(engines, named=False), HERE)
        (contender,), left_out = choice.contenders(scene)
        monkeypatch.setattr(quick, "_search", lambda *_: pytest.fail("it is refused in any case"))
        assert not _searched(scene, "mujoco,refusing")
        with pytest.raises(Unsupported) as alone:
            Choice.parse(engines="refusing").contenders(scene)
        with pytest.raises(Unsupported) as beside:
            Choice.parse(engines=engines).contenders(scene)

    reason = "refusing matched: it needs three bodies"
    assert (contender.engine, contender.settings.method) == ("mujoco", "Euler")
    assert left_out == {"refusing": reason}
    assert str(alone.value) == f"{reason}; no engine given here can"
    assert str(beside.value) == f"{reason}; use --engines mujoco"


def test_an_engine_that_cannot_be_used_is_named_after_a_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quick, "_search", lambda *_: Matched("Euler", 1))
    monkeypatch.setattr(registry, "installed_engines", lambda: ["mujoco"])
    scene = cart_pole()
    with faulty(tmp_path / "packages", "brokenly"):
        choice = searched(scene, Choice.parse(), HERE)
        _, left_out = choice.contenders(scene)

    assert choice.settings["matched"]
    assert left_out.keys() == {"brokenly"}


def test_settings_that_cannot_be_kept_are_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quick, "_search", lambda *_: Matched("Euler", 1))
    monkeypatch.setattr(quick, "run_references", lambda *_: None)
    monkeypatch.setenv("MBDS_XSIM_CACHE", "/proc/nowhere")
    told: list[str] = []
    meter = Silent()
    monkeypatch.setattr(meter, "notice", told.append)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = _searched(cart_pole(), "mujoco,dart", Conduct(0, meter=meter))

    assert found.keys() == {"mujoco", "dart"}
    (line,) = told
    assert line.startswith("settings that were found are not kept: cannot write /proc/nowhere/")


def test_a_step_or_native_settings_need_no_search() -> None:
    for choice in (
        Choice.parse(engines="mujoco", step=0.005),
        Choice.parse(engines="mujoco", profiles="native"),
    ):
        assert searched(cart_pole(), choice, HERE) is choice


@given(st.floats(-2.0, 6.0), st.integers(1, 4), st.integers(1, 30))
@settings(deadline=None)
def test_few_trials_find_about_the_fewest_steps(magnitude: float, order: int, stable: int) -> None:
    """Errors fall with the order, and below some number of steps the motion is lost."""
    tries: list[int] = []

    def excess(count: int) -> float:
        return 10.0**magnitude / count**order if count >= stable else math.inf

    def tried(count: int) -> Trial:
        tries.append(count)
        off = excess(count)
        return Trial(("off",) if off > 1.0 else (), off, 1.0, 1.0)

    steps = fewest(tried, order, time.monotonic() + 60.0)

    good = [count for count in COUNTS if excess(count) <= 0.7]
    assert len(tries) <= 9
    assert (steps is None) == (excess(COUNTS[-1]) > 1.0)
    if good:
        assert steps in good
        assert steps <= 2.6 * good[0]


def test_what_a_check_does_not_know_uses_no_share_of_its_budget() -> None:
    """Otherwise a search took finer steps than the budgets ask for."""
    figures = np.array([[[0.0], [3.0]], [[0.0], [9.0]]])
    finding = Finding.of("energy", "1", figures, budget=2.0, uncertainty=np.array([2.0, 8.5]))
    assert finding.passed.all()
    assert finding.share == 0.5
    assert dataclasses.replace(finding, uncertainty=np.zeros(2)).share == 4.5
    lost = Finding.of("energy", "1", figures * np.nan, budget=2.0)
    assert not lost.passed.any()
    assert math.isinf(lost.share)


def test_a_file_of_settings_is_used_and_names_its_engines(tmp_path: Path) -> None:
    path = tmp_path / "my.toml"
    path.write_text(
        '[mujoco]\nmethod = "RK4"\nsteps_per_frame = 3\n[mujoco.options]\nspin = false\n'
        '[mujoco.found]\nversion = "1"\n',
        encoding="utf-8-sig",
    )
    scene = cart_pole()
    choice = Choice.parse(profiles=str(path))

    (contender,), _ = choice.contenders(scene)
    assert (contender.engine, contender.profile) == ("mujoco", "matched")
    assert contender.settings.substeps(scene.clock.frame) == 3
    assert contender.settings.options == {"spin": False}
    assert searched(scene, choice, HERE) == choice
    native, matched = Choice.parse(profiles=f"native,{path}").contenders(scene)[0]
    assert (native.profile, matched.settings) == ("native", contender.settings)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (None, "there is no such file"),
        ("mujoco = 3", "Expected `object`"),
        ('[mujoco]\nmethod = "RK4"', "missing required field `steps_per_frame`"),
        ('[mujoco]\nmethod = "RK4"\nsteps_per_frame = 0', "got 0, allowed is 1 or more, below 1e"),
        (
            f'[mujoco]\nmethod = "RK4"\nsteps_per_frame = 1{400 * "0"}',
            r"my.toml: mujoco.steps_per_frame: got 10{59}, allowed is 1 or more",
        ),
        (f'[mujoco]\nmethod = "RK4"\nsteps_per_frame = 1{5000 * "0"}', "cannot be read"),
        (
            '[reference]\nmethod = "adaptive"\nsteps_per_frame = 20',
            "reference.steps_per_frame: got 20, allowed is 1, since adaptive chooses its steps",
        ),
        ('[muoco]\nmethod = "RK4"\nsteps_per_frame = 1', "no engine is called 'muoco'"),
        (
            '[mujoco]\nmethod = "RK4"\nsteps_per_frame = 1\n[mujoco.option]\nspin = false',
            "unknown field `option`",
        ),
        ("", "got no settings for any engine"),
        ("[", "cannot be read"),
    ],
)
def test_a_file_that_is_none_of_settings_is_refused(
    tmp_path: Path, text: str | None, why: str
) -> None:
    path = tmp_path / "my.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=why):
        Choice.parse(profiles=str(path))


def test_an_engine_that_the_file_does_not_have_is_told(tmp_path: Path) -> None:
    path = tmp_path / "my.toml"
    path.write_text('[mujoco]\nmethod = "RK4"\nsteps_per_frame = 3\n')
    with pytest.raises(InputError, match="no settings of dart; there are: mujoco"):
        Choice.parse(engines="dart", profiles=str(path))
    with pytest.raises(InputError, match="allowed is each name once; a file"):
        Choice.parse(profiles=f"matched,{path}")


def test_a_scene_of_which_nothing_is_drawn_runs_once_and_has_no_interval() -> None:
    scene = cart_pole()
    choice = Choice(("mujoco",), settings={"matched": {"mujoco": Matched("Euler", 1)}})
    validation, evidence = validate_with_evidence(
        scene, choice=choice, starts=Starts(4), conduct=HERE
    )

    assert validation.trajectories == (0,)
    assert len(evidence.batch) == 1
    assert validation.engines[0].reasons
    assert "(low)" not in " ".join(validation.engines[0].reasons)
    with_noise = msgspec.structs.replace(scene, noise=0.1)
    validation, _ = validate_with_evidence(with_noise, choice=choice, conduct=HERE)
    assert validation.trajectories == (0, 1, 2)
    validation, _ = validate_with_evidence(
        with_noise, choice=choice, starts=Starts(noise=False), conduct=HERE
    )
    assert validation.trajectories == (0,)
