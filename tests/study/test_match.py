"""The search for matched settings: the fewest steps, verified, written so that they are used."""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import HERE, Crash
from mbds_xsim.measure import quick as bisect
from mbds_xsim.measure.campaign import run_references
from mbds_xsim.measure.quick import COUNTS, Search
from mbds_xsim.measure.trial import Trial, failed_trial, run_trial
from mbds_xsim.report.files import to_markdown
from mbds_xsim.scene.budget import Budget
from mbds_xsim.scene.sampling import Starts, draw_batch
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.choice import Choice, settings_for
from mbds_xsim.simulate.simulator import EngineMethod
from mbds_xsim.studies.match import Match, MatchedSettings, matched_toml, present
from mbds_xsim.studies.match import search as study
from mbds_xsim.studies.match.search import match
from tests import plugins
from tests.command_line import CommandLine

_OUTSIDE = """
from mbds_xsim_adapters.mujoco import MuJoCo

class Outside(MuJoCo):
    name = "outside"
"""


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def scene() -> Scene:
    """A smooth scene, cut short."""
    return msgspec.structs.replace(registry.load_scene("2pendulum"), clock=Clock(0.02, 30))


def _match(scene: Scene, engines: str = "mujoco,exudyn") -> Match:
    return match(
        scene,
        choice=Choice.parse(engines=engines),
        starts=Starts(),
        held_out=1,
        conduct=HERE,
        command="mbds-xsim match",
    )


@given(st.integers(0, len(COUNTS)))
def test_the_fewest_steps_are_found_in_few_trials(threshold: int) -> None:
    search, trials = Search(), 0

    while (count := search.next) is not None:
        search.tell(count, COUNTS.index(count) >= threshold)
        trials += 1

    assert search.smallest == (COUNTS[threshold] if threshold < len(COUNTS) else None)
    assert trials <= 13


def test_what_fails_later_gives_way_to_the_next_shorter_step() -> None:
    search = Search(counts=(1, 2, 3))
    search.tell(1, True)

    search.refuse(1)
    assert (search.next, search.smallest) == (None, 2)
    search.refuse(2)
    search.refuse(3)
    assert search.smallest is None


def test_settings_found_hold_and_fewer_steps_do_not(scene: Scene) -> None:
    result = _match(scene)

    assert [engine.engine for engine in result.engines] == ["mujoco", "exudyn"]
    for engine in result.engines:
        assert engine.meets_budget, engine.reasons
        place = COUNTS.index(engine.steps_per_frame)
        assert _passes(scene, engine, engine.steps_per_frame)
        assert place == 0 or not _passes(scene, engine, COUNTS[place - 1])
    assert result.engines[0].method == "RK4"
    assert result.engines[0].steps_per_frame <= 4


@pytest.mark.parametrize(("drawn", "held_out"), [(True, 1), (False, 0)])
def test_starts_are_held_out_where_there_are_several(
    scene: Scene, drawn: bool, held_out: int
) -> None:
    scene = scene if drawn else msgspec.structs.replace(scene, sampling=(), noise=0.0)

    result = _match(scene, "mujoco")

    assert result.held_out == held_out
    said = "1 held-out start of each interval" if drawn else "the only start, with which"
    assert all(said in text for text in (matched_toml(result), to_markdown([present(result)])))


def _passes(scene: Scene, matched: MatchedSettings, count: int) -> bool:
    """Return whether steps are enough on the starts of the search and on the held-out ones."""
    settings = Settings(matched.method, scene.clock.frame / count, matched.options)
    batches = [draw_batch(scene, range(3), seed=seed) for seed in (0, 1)]
    return all(
        run_trial(
            scene,
            batch,
            matched.engine,
            settings,
            run_references(scene, batch, HERE),
            3,
        ).passed
        for batch in batches
    )


def test_where_no_step_is_good_enough_the_best_is_told(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bisect.Search, "__init__", _few_counts)
    strict = msgspec.structs.replace(scene, budget=Budget(error_1s=1e-15, error=1e-15))

    (best,) = _match(strict, "mujoco").engines

    assert not best.meets_budget
    assert "error" in best.reasons[0]
    assert (best.method, best.steps_per_frame) == ("RK4", 4)
    assert best.cost_ratio is None
    table = tomllib.loads(matched_toml(_match(strict, "mujoco")))["mujoco"]
    assert table["found"]["meets_budget"] is False
    assert table["found"]["reason"] == best.reasons[0]


def _few_counts(search: Search, counts: tuple[int, ...] = (1, 4)) -> None:
    search.counts, search.failed, search.passed, search.closed = counts, -1, None, False


def test_what_is_found_is_not_dearer_than_the_settings_in_use(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the search tries only too many steps, the settings in use win."""
    frame = scene.clock.frame
    monkeypatch.setattr(bisect.Search, "__init__", _dear_counts)
    monkeypatch.setattr(study, "settings_for", lambda *_: Settings("RK4", frame / 7))

    (chosen,) = _match(scene, "mujoco").engines
    assert chosen.meets_budget
    assert (chosen.method, chosen.steps_per_frame) == ("RK4", 7)


def _dear_counts(search: Search, counts: tuple[int, ...] = (80,)) -> None:
    _few_counts(search, counts)


@pytest.mark.parametrize(
    ("excesses", "given_up"),
    [((6.8,), False), ((6.8, 6.7), True), ((6.8, 5.0), False), ((1.3, 1.3), False)],
)
def test_a_method_that_shorter_steps_do_not_mend_is_given_up(
    excesses: tuple[float, ...], given_up: bool
) -> None:
    candidate = study._Candidate(EngineMethod("pybullet", "semi-implicit-euler", own_options={}))
    for count, excess in enumerate(excesses):
        candidate.proofs[count] = Trial(("wheels",), excess, 1.0, 1.0)

    assert study._stuck(candidate) == given_up


def test_the_best_effort_breaks_the_fewest_checks_and_costs_the_least_of_those(
    scene: Scene,
) -> None:
    frame = scene.clock.frame
    used = Settings("semi-implicit-euler", frame / 40)
    candidate = study._Candidate(
        EngineMethod("pybullet", used.method, own_options={}, counts=(40,))
    )
    for count, excess, reasons in (
        (1, 3.0, ("wheels: far", "contact gap: far")),
        (10, 6.2, ("wheels: far", "wheels: farther")),
        (40, 6.0, ("wheels: far",)),
    ):
        candidate.proofs[count] = Trial(reasons, excess, 0.1 * count, 0.1 * count)
    proof = study._Field(scene, draw_batch(scene, range(3)), None, 1.0, HERE)  # type: ignore[arg-type]

    best = study._Contest(proof, proof, [candidate], used, candidate.proofs[40]).best_effort()

    assert (best.steps_per_frame, best.meets_budget) == (10, False)


def test_what_nearly_keeps_the_budgets_is_better_than_what_is_lost(scene: Scene) -> None:
    used = Settings("RK4", scene.clock.frame)
    candidate = study._Candidate(EngineMethod("mujoco", "RK4", own_options={}, counts=(1, 2)))
    near = Trial(("error at 1 s: 2 mm", "gap: 1.1 µm"), 1.2, 0.01, 0.01)
    candidate.proofs = {1: near, 2: failed_trial(Crash("no answer within 300 s", timed_out=True))}
    proof = study._Field(scene, draw_batch(scene, range(3)), None, 1.0, HERE)  # type: ignore[arg-type]

    best = study._Contest(proof, proof, [candidate], used, near).best_effort()

    assert (best.steps_per_frame, best.reasons) == (1, near.reasons)


@pytest.mark.parametrize(
    ("name", "rigid", "steps", "enough", "limit"),
    [
        ("balldrop", "pybullet", 60, 200, "error before the first impact"),
        ("balldrop", "dart", 60, 200, "error before the first impact"),
        ("simplecubli", "dart", 100, 320, "turn in flight"),
        ("simplecubli", "pybullet", 100, 320, "turn in flight"),
    ],
)
def test_settings_that_keep_the_budgets_and_break_a_limit_of_contact_are_refused(
    name: str, rigid: str, steps: int, enough: int, limit: str
) -> None:
    scene = msgspec.structs.replace(registry.load_scene(name), clock=Clock(0.02, 30))
    batch = draw_batch(scene, range(3), seed=2)
    reference = run_references(scene, batch, HERE)
    options = settings_for(scene, registry.load_adapter(rigid), "matched").options

    def tried(count: int) -> tuple[str, ...]:
        settings = Settings("semi-implicit-euler", scene.clock.frame / count, options)
        return run_trial(scene, batch, rigid, settings, reference, 0).reasons

    assert [reason.partition(":")[0] for reason in tried(steps)] == [limit]
    assert tried(enough) == ()


def test_the_file_is_what_settings_are_read_from(scene: Scene) -> None:
    result = _match(scene, "mujoco")
    before = '[dart]\nmethod = "semi-implicit-euler"\nsteps_per_frame = 20\n'

    tables = tomllib.loads(matched_toml(result, before))

    assert tables["dart"] == {"method": "semi-implicit-euler", "steps_per_frame": 20}
    mujoco = tables["mujoco"]
    assert mujoco["method"] == result.engines[0].method
    assert mujoco["steps_per_frame"] == result.engines[0].steps_per_frame
    assert mujoco["found"]["trajectories"] == 3
    assert mujoco["found"]["version"] == registry.load_adapter("mujoco").version()
    with pytest.raises(InputError, match="--out"):
        matched_toml(result, "[dart")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["teapot"], "teapot has no place among the built-in scenes"),
        (["teapot", "--out", "a.toml"], "no scene is called 'teapot'"),
        (["7pendulum"], "say where to write with --out"),
        (["5pendulum", "6pendulum", "--out", "a.toml"], "got 2 scenes for one file"),
        (["5pendulum", "--engines", "ode", "--out", "a.toml"], "no engine is called 'ode'"),
        (["5pendulum", "--out", "."], "--out: cannot write ."),
        (["5pendulum", "--held-out", "0"], "--held-out"),
    ],
)
def test_bad_input_is_one_line(words: list[str], said: str, run: CommandLine, here: Path) -> None:
    assert said in run("match", *words).refusal
    assert not list(here.glob("*.toml"))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"[dart", "cannot be read"),
        (b"\xff", "--out: a.toml is there and cannot be read"),
        (b"name = 'a'\nlength = 0.5\n[[bodies]]\n", "no file of settings: it has 'length'"),
    ],
)
def test_what_is_no_file_of_settings_is_refused_before_the_search(
    content: bytes, said: str, run: CommandLine, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (here / "a.toml").write_bytes(content)
    monkeypatch.setattr(study, "match", lambda *_, **__: pytest.fail("it is searched"))

    assert said in run("match", "5pendulum", "--engines", "mujoco", "--out", "a.toml").refusal
    assert (here / "a.toml").read_bytes() == content


def test_what_is_stored_writes_the_same_file_again_and_scenes_count_once(
    run: CommandLine, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["match", "5pendulum", "5pendulum", "--engines", "mujoco", "--out", "a.toml"]
    monkeypatch.setattr("sys.argv", ["mbds-xsim", *words, "--html=a.html"])

    def refused(scene: Scene, *, command: str, **_: object) -> None:
        raise InputError(f"{scene.name}: {command}")

    monkeypatch.setattr(study, "match", refused)
    assert run(*words).refusal.strip().endswith(f"5pendulum: mbds-xsim {' '.join(words)}")
    assert not list(here.iterdir())


def test_settings_of_another_packages_engine_stand_in_its_own_package(
    run: CommandLine, tmp_path: Path
) -> None:
    folder = tmp_path / "outside"
    (folder / "their_settings").mkdir(parents=True)
    (folder / "their_settings/6pendulum.toml").write_text(
        "[outside]\nmethod = 'Euler'\nsteps_per_frame = 7\n"
        "[mujoco]\nmethod = 'Euler'\nsteps_per_frame = 3\n"
    )
    engines, shipped = {"outside": "outside:Outside"}, {"outside": "their_settings"}
    with plugins.installed(folder, {"outside": _OUTSIDE}, engines, matched=shipped):
        message = run("match", "6pendulum", "--engines", "outside").refusal
        scene = registry.load_scene("6pendulum")
        theirs, ours = (
            settings_for(scene, registry.load_adapter(name), "matched")
            for name in ("outside", "mujoco")
        )

    assert "outside is another package's engine" in message
    assert (theirs.method, theirs.substeps(scene.clock.frame)) == ("Euler", 7)
    assert ours.method == "RK4"


@pytest.mark.parametrize("name", registry.scene_names())
def test_matched_settings_are_of_the_engines_own_stepping(name: str) -> None:
    """A step of the toolkit on an engine's dynamics says nothing about the engine.

    Pinocchio steps nothing itself.
    """
    for engine in set(registry.installed_engines()) - {"pinocchio"}:
        adapter = registry.load_adapter(engine)
        method = settings_for(registry.load_scene(name), adapter, "matched").method
        assert adapter.methods[method].own, f"{engine} on {name}"


def test_an_engine_that_the_toolkit_steps_is_left_out_by_name(scene: Scene) -> None:
    curves, left_out = study.searched_curves(
        scene, Choice.parse(engines="reference,mujoco"), options=False
    )

    assert {curve.engine for curve in curves} == {"mujoco"}
    assert "this toolkit steps it" in left_out["reference"]
    with pytest.raises(InputError, match="no engine can be matched on 2pendulum: reference does"):
        study.searched_curves(scene, Choice.parse(engines="reference"), options=False)


def test_adaptive_methods_have_no_steps_to_search(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    adapter = registry.load_adapter("reference")
    own = {name: dataclasses.replace(one, own=True) for name, one in adapter.methods.items()}
    monkeypatch.setattr(type(adapter), "methods", own)

    choice = Choice.parse(engines="reference,mujoco")
    curves, left_out = study.searched_curves(scene, choice, options=True)

    assert {curve.engine for curve in curves} == {"mujoco"}
    assert {f"reference {name}" for name in own} <= set(left_out)
    assert all("is adaptive" in left_out[f"reference {name}"] for name in own)


def test_the_search_leaves_the_toolkits_stepping_out(scene: Scene) -> None:
    (chosen,) = _match(scene, "dart").engines
    assert chosen.method == "semi-implicit-euler"
