"""Cost and error of trained models on the starts of a trade-off, next to the engines.

A model has no step, so it is a point, not a curve. It is given the first frames of the starts
that the engines simulated. Its time covers the frames that it predicts: for one trajectory alone,
and as each trajectory's share of a batch.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence

import msgspec

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import USUAL, Conduct
from mbds_xsim.learn.simulator import LearnedSimulator
from mbds_xsim.learn.trained import TrainedModel
from mbds_xsim.learn.window import HISTORY
from mbds_xsim.measure.runner import machine
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import fingerprint
from mbds_xsim.simulate import registry
from mbds_xsim.studies.tradeoff import AT_ONCE, BATCH, Measurement, ModelResult, Tradeoff
from mbds_xsim.studies.tradeoff.bench import StartBench, references
from mbds_xsim.studies.tradeoff.curves import point_of
from mbds_xsim.studies.tradeoff.study import explore

_LIMIT = 600.0  # longest rollout of one start [s]


def with_models(
    study: Tradeoff,
    scene: Scene,
    models: Sequence[TrainedModel],
    *,
    conduct: Conduct = USUAL,
    command: str = "",
) -> tuple[Tradeoff, list[Measurement]]:
    """Measure models on the starts of a study; return the study with them, and their rows.

    Models of other scenes are left out, and the result says so. `command` replaces the study's.

    Raises:
        InputError: The study is of another scene, no model is of this scene, or the reference ends
            too early to give models their first frames.
    """
    matching, left_out = models_of(scene, models)
    bench = _bench(study, scene, conduct)
    quiet = draw_batch(scene, study.trajectories, seed=study.seed, noise=False)
    simulators = [
        LearnedSimulator.of(m, f"{m.run} {m.variant}", variation=batch, together=n, quiet=quiet)
        for m in matching
        for batch, n in (("", 1), (BATCH, AT_ONCE))
    ]
    by_curve = explore(bench, simulators)
    rows = [list(itertools.chain.from_iterable(points)) for points in by_curve]
    extended = msgspec.structs.replace(
        study,
        models=tuple(map(_result, matching, rows[::2], rows[1::2])),
        left_out=study.left_out | left_out,
        command=command or study.command,
        versions=study.versions | {"torch": registry.package_version("torch")},
    )
    return extended, list(itertools.chain.from_iterable(rows))


def models_of(
    scene: Scene, models: Sequence[TrainedModel]
) -> tuple[list[TrainedModel], dict[str, str]]:
    """Return the models of a scene (InputError if none), and why others are left out."""
    matching = [model for model in models if _is_of(model, scene)]
    others = Counter(model.scene.name for model in models if model not in matching)
    left_out = {
        f"models of {name}": f"{count} trained on {name}, not on this {scene.name} or its frames"
        for name, count in others.items()
    }
    if not matching:
        reasons = "; ".join(left_out.values())
        msg = f"no trained models of {scene.name}: {reasons}; name the folder of its models"
        raise InputError(msg)
    return matching, left_out


def _bench(study: Tradeoff, scene: Scene, conduct: Conduct) -> StartBench:
    """Solve the references of a study's starts.

    Raises InputError if the study is of another scene or a reference ends too early.
    """
    if study.fingerprint != fingerprint(scene):
        msg = f"the stored trade-off of {study.scene} is not of {scene.name} as it is now"
        raise InputError(f"{msg}; measure the engines anew, without --onto")
    starts = draw_batch(scene, study.trajectories, seed=study.seed)
    truths = references(scene, starts, conduct)
    if min(truth.horizon for truth in truths) < HISTORY * scene.clock.frame * (1 - 1e-9):
        msg = f"{scene.name}: the reference ends within the {HISTORY} frames of a model's start"
        raise InputError(msg)
    return StartBench(scene, starts, truths, study.seed, _LIMIT, conduct)


def _result(
    model: TrainedModel, alone: list[Measurement], batched: list[Measurement]
) -> ModelResult:
    return ModelResult(
        model=model.kind,
        training=model.run,
        variant=model.variant,
        engines=model.engines,
        source=str(model.named),
        known_frames=HISTORY,
        at_once=AT_ONCE,
        alone=point_of(alone),
        batched=point_of(batched),
        train_wall_s=_number(model, "wall_s"),
        train_cpu_s=_number(model, "cpu_s"),
        train_steps=_number(model, "steps"),
        train_trajectories=_number(model, "train_trajectories"),
        train_device=model.facts.get("device", ""),
        machine=machine(),
    )


def _number(model: TrainedModel, fact: str) -> float | None:
    return float(model.facts[fact]) if model.facts.get(fact) else None


def _is_of(model: TrainedModel, scene: Scene) -> bool:
    """Return whether a model was trained on this scene; the number of frames may differ."""
    own = msgspec.structs.replace(model.scene, clock=scene.clock)
    return model.scene.clock.frame == scene.clock.frame and fingerprint(own) == fingerprint(scene)
