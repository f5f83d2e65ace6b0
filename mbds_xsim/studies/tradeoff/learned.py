"""Trained models beside the engines of a trade-off: what they cost, and how far they are off.

A model has no step: it is a point, not a curve. It is shown the first frames of the starts that
the engines have simulated, and its time is that of the frames that it predicts: alone, and in a
batch, each trajectory its share.
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
from mbds_xsim.studies.tradeoff import AT_ONCE, BATCH, Learned, Measurement, Tradeoff
from mbds_xsim.studies.tradeoff.bench import StartBench, references
from mbds_xsim.studies.tradeoff.curves import point_of
from mbds_xsim.studies.tradeoff.study import explore

_LIMIT = 600.0  # of one start [s]


def with_models(
    study: Tradeoff,
    scene: Scene,
    models: Sequence[TrainedModel],
    *,
    conduct: Conduct = USUAL,
    command: str = "",
) -> tuple[Tradeoff, list[Measurement]]:
    """Measure models on the starts of a study, and put them into it; their rows come beside it.

    Models of other scenes are left out, and the result says so. The command is that of the whole.

    Raises:
        InputError: The study is of another scene, or none of the models is of this one, or no
            reference is known that could give them their first frames.
    """
    able, left_out = models_of(scene, models)
    bench = _bench(study, scene, conduct)
    quiet = draw_batch(scene, study.trajectories, seed=study.seed, noise=False)
    found = explore(
        bench,
        [
            LearnedSimulator.of(
                model,
                f"{model.run} {model.variant}",
                variation=variation,
                together=together,
                quiet=quiet,
            )
            for model in able
            for variation, together in (("", 1), (BATCH, AT_ONCE))
        ],
    )
    rows = [list(itertools.chain.from_iterable(points)) for points in found]
    measured = msgspec.structs.replace(
        study,
        models=tuple(map(_learned, able, rows[::2], rows[1::2])),
        left_out=study.left_out | left_out,
        command=command or study.command,
        versions=study.versions | {"torch": registry.package_version("torch")},
    )
    return measured, list(itertools.chain.from_iterable(rows))


def models_of(
    scene: Scene, models: Sequence[TrainedModel]
) -> tuple[list[TrainedModel], dict[str, str]]:
    """Find the models of a scene (InputError: none), and say which were trained on others."""
    able = [model for model in models if _is_of(model, scene)]
    others = Counter(model.scene.name for model in models if model not in able)
    left_out = {
        f"models of {name}": f"{count} trained on {name}, not on this {scene.name} or its frames"
        for name, count in others.items()
    }
    if not able:
        reasons = "; ".join(left_out.values())
        msg = f"no trained models of {scene.name}: {reasons}; name the folder of its models"
        raise InputError(msg)
    return able, left_out


def _bench(study: Tradeoff, scene: Scene, conduct: Conduct) -> StartBench:
    """Solve the starts of a study.

    InputError where the study is of another scene, or the reference ends too early.
    """
    if study.fingerprint != fingerprint(scene):
        msg = f"the stored trade-off of {study.scene} is not of {scene.name} as it is now"
        raise InputError(f"{msg}; measure the engines anew, without --onto")
    starts = draw_batch(scene, study.trajectories, seed=study.seed)
    solved = references(scene, starts, conduct)
    if min(truth.horizon for truth in solved) < HISTORY * scene.clock.frame * (1 - 1e-9):
        msg = f"{scene.name}: the reference ends within the {HISTORY} frames of a model's start"
        raise InputError(msg)
    return StartBench(scene, starts, solved, study.seed, _LIMIT, conduct)


def _learned(model: TrainedModel, alone: list[Measurement], batched: list[Measurement]) -> Learned:
    return Learned(
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
    """Whether it was trained on this scene, be it over fewer frames."""
    own = msgspec.structs.replace(model.scene, clock=scene.clock)
    return model.scene.clock.frame == scene.clock.frame and fingerprint(own) == fingerprint(scene)
