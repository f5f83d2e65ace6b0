"""Training learns, stops when it should, goes on as if never interrupted, and sees no test."""

import math
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
import torch
from torch import Tensor
from torch.nn.functional import dropout

from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.read import Dataset
from mbds_xsim.learn import recipe
from mbds_xsim.learn.gns import GNS, GNSSettings
from mbds_xsim.learn.model import build, load_model
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.train import CurvePoint, Training, check_identity, train
from mbds_xsim.learn.window import KnownInputs, Motions, Sample
from tests.learn.models import squared_error

Data = Callable[..., Dataset]
RECIPE = recipe.Recipe(rate=3e-3, batch=16, schedule=recipe.Plateau(patience=0, factor=0.5))
SHORT = recipe.Profile(steps=40, every=10, windows=8, horizon=3, until_level=False)


@pytest.fixture(scope="module")
def parts(data: Data) -> tuple[Motions, Motions]:
    file = data("2pendulum", trajectories=100)
    return Motions.of(file, "train"), Motions.of(file, "validation")


class _Dropping(GNS):
    """GNS whose dropout is on in training, and off in validation."""

    def forward(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        assert self.training == torch.is_grad_enabled()
        return dropout(super().forward(history, inputs), 0.3, self.training)


def _model(motions: Motions, kind: type[GNS] = GNS) -> GNS:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        settings = GNSSettings(width=24, steps=2, noise=1e-3, loss="l1")
        return kind(motions.graph, Statistics.of(motions), settings)


def _same(first: dict[str, Tensor], second: dict[str, Tensor]) -> bool:
    return all(torch.equal(value, second[key]) for key, value in first.items())


def test_it_beats_the_trivial_models(data: Data) -> None:
    file = data("1pendulum", trajectories=400)
    training, test = Motions.of(file, "train"), Motions.of(file, "test")
    model = _model(training)
    profile = msgspec.structs.replace(SHORT, steps=400, every=100, windows=64, horizon=10)
    adam = recipe.Recipe(rate=3e-3, batch=64, schedule=recipe.Plateau())
    train(model, training, Motions.of(file, "validation"), adam, profile)
    learned = squared_error(model, test, steps=10)[:, -1].mean()
    for name in ("hold", "constant_velocity", "constant_acceleration"):
        trivial = build(name, test.graph, Statistics.of(training))
        error = squared_error(trivial, test, steps=10)[:, -1].mean()
        assert learned < 0.5 * error


@pytest.mark.parametrize("kind", [GNS, _Dropping])
def test_an_interrupted_run_goes_on_to_the_same_bits(
    kind: type[GNS], parts: tuple[Motions, Motions], scratch: Path
) -> None:
    whole, halted = (_model(parts[0], kind) for _ in range(2))
    curve = train(whole, *parts, RECIPE, SHORT).curve

    def halt(training: Training) -> None:
        if training.curve[-1].step == 30:
            raise KeyboardInterrupt

    path = scratch / "run.pt"
    with pytest.raises(KeyboardInterrupt):
        train(halted, *parts, RECIPE, SHORT, checkpoint=path, tell=halt)
    fresh = _model(parts[0], kind)
    steps: list[int] = []
    spent = torch.load(path, weights_only=True)["wall_s"]

    def note(training: Training) -> None:
        steps.append(training.curve[-1].step)

    resumed = train(fresh, *parts, RECIPE, SHORT, checkpoint=path, tell=note)
    assert steps == [40]
    assert resumed.curve == curve
    assert resumed.wall_s > spent > 0
    assert _same(whole.state_dict(), fresh.state_dict())


def test_on_a_cpu_no_gpu_is_started(
    parts: tuple[Motions, Motions], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Keeping the state of their random numbers starts all GPUs, and several with a warning."""
    once, model = recipe.Profile(1, every=1, windows=1, horizon=1), _model(parts[0])
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_rng_state", lambda *_: pytest.fail("a GPU is started"))

    train(model, *parts, RECIPE, once)
    build("gns", parts[0].graph, Statistics.of(parts[0]))


def test_a_finished_run_is_not_run_again(parts: tuple[Motions, Motions], scratch: Path) -> None:
    path = scratch / "run.pt"
    first, again = _model(parts[0]), _model(parts[0])
    train(first, *parts, RECIPE, SHORT, checkpoint=path)
    reports: list[Training] = []
    train(again, *parts, RECIPE, SHORT, checkpoint=path, tell=reports.append)
    assert reports == []
    assert _same(first.state_dict(), again.state_dict())


def test_a_checkpoint_of_another_run_is_refused(
    parts: tuple[Motions, Motions], scratch: Path
) -> None:
    path = scratch / "run.pt"
    train(_model(parts[0]), *parts, RECIPE, SHORT, checkpoint=path)
    with pytest.raises(InputError, match="a checkpoint of another seed; name another place"):
        train(_model(parts[0]), *parts, RECIPE, SHORT, checkpoint=path, seed=1)
    other = msgspec.structs.replace(SHORT, steps=80)
    with pytest.raises(InputError, match="of another profile, data;"):
        train(_model(parts[0]), *parts, RECIPE, other, checkpoint=path, identity={"data": "other"})
    path.write_bytes(b"no checkpoint")
    with pytest.raises(InputError, match="remove it to start over"):
        train(_model(parts[0]), *parts, RECIPE, SHORT, checkpoint=path)


def test_a_refusal_names_what_was_changed_added_and_removed() -> None:
    stated = {"model": '{"width": 64, "depth": 2}'}
    own = {"model": '{"width": 32, "noise": 0.1}'}
    told = r"\(width 64, now 32; depth 2, now absent; noise absent, now 0.1\)"
    with pytest.raises(InputError, match=told):
        check_identity(Path("run.pt"), "a checkpoint", stated, own)


@pytest.mark.parametrize("name", ["gns", "sgnn", "hgnn"])
def test_only_networks_that_carry_no_positions_are_mixed(data: Data, name: str) -> None:
    kind = load_model(name)
    file = data("2pendulum", trajectories=100)
    training, validation = (
        Motions.of(file, split, bodies=kind.needs_bodies, dtype=kind.dtype)
        for split in ("train", "validation")
    )
    states = []
    for mixed in (False, True):
        model = build(name, training.graph, Statistics.of(training), track="lite")
        profile = msgspec.structs.replace(SHORT, steps=2, every=2, mixed_precision=mixed)
        train(model, training, validation, kind.tracks["lite"].recipe, profile)
        states.append(model.state_dict())
    assert all(bool(value.isfinite().all()) for value in states[1].values())
    assert _same(*states) != kind.mixes


@pytest.mark.slow
def test_compiled_networks_learn_the_same(parts: tuple[Motions, Motions]) -> None:
    """Loss and gradients agree if networks are traced as for a GPU and run on a CPU."""
    counters = pytest.importorskip("torch._dynamo.utils").counters  # its import takes seconds
    sample = parts[0].draw(8, torch.Generator().manual_seed(0), 1)
    results = []
    for compiled in (False, True):
        model = _model(parts[0])
        if compiled:
            recipe.compile_networks(model, backend="aot_eager")
        loss = model.loss(sample, torch.Generator().manual_seed(0))
        torch.autograd.backward(loss)
        results.append([loss.detach(), *(p.grad for p in model.parameters() if p.grad is not None)])
    assert counters["frames"]["ok"] >= 1
    for eager, traced in zip(*results, strict=True):
        torch.testing.assert_close(traced, eager)


def test_seeds_decide(parts: tuple[Motions, Motions]) -> None:
    first, same, other = (_model(parts[0]) for _ in range(3))
    for model, seed in ((first, 0), (same, 0), (other, 1)):
        train(model, *parts, RECIPE, SHORT, seed=seed)
    assert _same(first.state_dict(), same.state_dict())
    assert not _same(first.state_dict(), other.state_dict())


def test_divergence_ends_the_run_with_the_best_parameters(parts: tuple[Motions, Motions]) -> None:
    model = _model(parts[0])
    before = {key: value.clone() for key, value in model.state_dict().items()}
    wild = recipe.Recipe(rate=1e14, batch=8)
    training = train(model, *parts, wild, SHORT)
    assert training.ended == "diverged"
    assert training.curve[-1].step < SHORT.steps
    state = model.state_dict()
    assert all(bool(value.isfinite().all()) for value in state.values())
    assert _same(before, state)


def test_a_step_without_a_gradient_is_skipped_where_the_recipe_says_so(
    parts: tuple[Motions, Motions], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    loss = GNS.loss

    def broken(model: GNS, sample: Sample, generator: torch.Generator) -> Tensor:
        calls.append(model)
        return loss(model, sample, generator) * (torch.inf if len(calls) in (5, 23) else 1.0)

    monkeypatch.setattr(GNS, "loss", broken)
    clipped = msgspec.structs.replace(RECIPE, clip=1.0, skip=True)
    training = train(_model(parts[0]), *parts, clipped, SHORT)
    assert (training.ended, training.skipped) == ("steps", 2)
    assert all(point.loss < 10.0 for point in training.curve)
    assert training.best.error < training.curve[0].error
    calls.clear()
    clipped = msgspec.structs.replace(RECIPE, clip=1.0)
    assert train(_model(parts[0]), *parts, clipped, SHORT).ended == "diverged"


def test_only_training_and_validation_are_let_in(
    parts: tuple[Motions, Motions], data: Data
) -> None:
    test = Motions.of(data("2pendulum"), "test")
    with pytest.raises(InputError, match="got the part 'test'"):
        train(_model(parts[0]), parts[0], test, RECIPE, SHORT)
    with pytest.raises(InputError, match="allowed here is 'train'"):
        train(_model(parts[0]), parts[1], parts[1], RECIPE, SHORT)


def test_it_stops_where_the_last_fifth_improved_too_little(
    parts: tuple[Motions, Motions],
) -> None:
    level = msgspec.structs.replace(SHORT, steps=10_000, every=2, until_level=True, least=5)
    frozen = recipe.Recipe(rate=1e-12, batch=2)
    training = train(_model(parts[0]), *parts, frozen, level)
    assert training.ended == "level"
    assert training.curve[-1].step == level.every * level.least
    assert abs(training.last_improvement) < level.improvement


def test_improvement_is_that_of_the_last_fifth(parts: tuple[Motions, Motions]) -> None:
    errors = (8.0, 6.0, 5.0, 4.0, 3.0)
    curve = [CurvePoint(10 * k + 10, 1.0, error, 1e-3) for k, error in enumerate(errors)]
    assert Training(_model(parts[0]), curve).last_improvement == pytest.approx(0.25)
    exploded = [CurvePoint(10 * k + 10, 1.0, math.inf, 1e-3) for k in range(5)]
    assert Training(_model(parts[0]), exploded).last_improvement == 1.0


def test_rates_follow_their_schedules(parts: tuple[Motions, Motions]) -> None:
    decay = recipe.Recipe(rate=1e-2, batch=2, schedule=recipe.Decay(tenth=20, floor=1e-3))
    rates = [point.rate for point in train(_model(parts[0]), *parts, decay, SHORT).curve]
    assert rates[1] == pytest.approx(1e-3 + 9e-3 * 0.1 ** (19 / 20))
    still = recipe.Recipe(rate=1e-13, batch=2, schedule=recipe.Plateau(patience=1, factor=0.5))
    longer = msgspec.structs.replace(SHORT, steps=80)
    rates = [point.rate for point in train(_model(parts[0]), *parts, still, longer).curve]
    assert rates[0] == 1e-13
    assert rates[-1] < 1e-13
    assert set(rates) <= {1e-13 * 0.5**k for k in range(8)}


def test_a_cosine_ends_with_the_run_however_long_it_is(parts: tuple[Motions, Motions]) -> None:
    adam = recipe.Recipe(rate=1e-3, batch=2, schedule=recipe.Cosine())
    for steps in (20, 40):
        profile = msgspec.structs.replace(SHORT, steps=steps, every=steps // 2)
        curve = train(_model(parts[0]), *parts, adam, profile).curve
        # A point has the rate of the step before it.
        angles = [math.pi * (point.step - 1) / steps for point in curve]
        expected = [0.5e-3 * (1.0 + math.cos(angle)) for angle in angles]
        assert [point.rate for point in curve] == pytest.approx(expected)
    assert recipe.Cosine().at(1e-3, 40, 40) == 0.0


def test_a_run_that_ends_when_level_has_no_cosine_to_end(parts: tuple[Motions, Motions]) -> None:
    """The run does not end before its rate has fallen far: validation wavers at a high one."""
    still = recipe.Recipe(rate=1e-13, batch=2, schedule=recipe.Cosine())
    level = msgspec.structs.replace(SHORT, steps=10_000, every=2, until_level=True, least=5)
    training = train(_model(parts[0]), *parts, still, level)
    falls = -round(math.log(recipe.SETTLED, 1 / recipe.WITHOUT_END.factor))
    rates = [
        1e-13 * recipe.WITHOUT_END.factor**k
        for k in range(falls)
        for _ in range(recipe.WITHOUT_END.patience + 1)
    ]
    assert training.ended == "level"
    assert [point.rate for point in training.curve] == [rates[0], *rates]


@pytest.mark.parametrize("name", recipe.PROFILES)
@pytest.mark.parametrize("steps", [7, 1000, 3000])
def test_a_run_of_exactly_so_many_steps_is_validated_often_enough(name: str, steps: int) -> None:
    profile = recipe.PROFILES[name].of_exactly(steps)
    assert (profile.steps, profile.until_level) == (steps, False)
    assert profile.every <= recipe.PROFILES[name].every
    assert profile.every == 1 or steps // profile.every >= profile.least


def test_smoke_is_short() -> None:
    assert (
        recipe.PROFILES["smoke"].steps
        < recipe.PROFILES["lite"].steps
        < recipe.PROFILES["paper"].steps
    )
