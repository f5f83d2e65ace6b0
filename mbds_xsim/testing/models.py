"""The suite every learned model must pass: the model declares, the suite measures.

Use it in a test file of your own, with a fixture that returns the registered name of your model:

    from mbds_xsim.testing.models import ModelContract

    class TestMyModel(ModelContract):
        @pytest.fixture
        def name(self):
            return "mine"

Motions are the reference's: no engine is needed.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from mbds_xsim.base import rotation
from mbds_xsim.dataset.points import Points
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import (
    SYMMETRIES,
    LearnedModel,
    Symmetry,
    build,
    load_model,
    refusal,
    rollout,
    track_of,
)
from mbds_xsim.learn.model_file import read_model, save_model
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import KnownInputs, Motions
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.registry import PAPER_SCENES, load_scene
from mbds_xsim.testing.cases import CASES

_ROWS = 6
_AHEAD = 4
_FRAMES = 30
_TURN = 0.7  # rad, about the vertical
_SHIFT = (0.3, -0.2, 0.0)  # lengths of the scene
_SAME = {torch.float32: 5e-5, torch.float64: 1e-9}  # over the largest displacement of a frame
_LESSONS = 30  # training steps
_HUGE = 1e30


class ModelContract:
    """Tests of a learned model, one for each way in which models go wrong."""

    @pytest.fixture
    def name(self) -> str:
        """Name the model; every subclass overrides this."""
        msg = "give your suite a fixture `name` with the name that your model is registered by"
        raise NotImplementedError(msg)

    def test_each_scene_is_represented_or_refused_in_a_line(self, name: str) -> None:
        """At least one of the paper's scenes can be learned."""
        graphs = [Graph.of(load_scene(scene)) for scene in PAPER_SCENES]
        refusals = [refusal(name, graph) for graph in graphs]
        assert "" in refusals, f"{name} refuses every scene: {refusals}"
        assert not any("\n" in words for words in refusals)

    def test_tracks_say_how_to_train(self, name: str) -> None:
        """Hyper-parameters have one type, and each a recipe; or there is nothing to learn."""
        tracks = load_model(name).tracks
        assert len({type(settings) for settings in tracks.values()}) <= 1
        for track, settings in tracks.items():
            assert settings.recipe.rate > 0, f"{name}, {track}: no recipe"

    def test_rows_do_not_touch_each_other(self, name: str) -> None:
        """A row does not depend on the others, even if one of them is lost."""
        motions = _motions(name)
        model = _built(name, motions)
        together = rollout(model, motions, steps=_AHEAD)
        alone = rollout(model, motions[2:3], steps=_AHEAD)
        assert together.shape == (_ROWS, _AHEAD, motions.graph.particle_count, 3)
        assert together.isfinite().all()
        assert _off(alone, together[2:3], motions) < _SAME[model.dtype]

        lost = dataclasses.replace(motions, position=motions.position.clone())
        lost.position[0] *= _HUGE
        if motions.body is not None:
            lost = dataclasses.replace(lost, body=motions.body.clone())
            assert lost.body is not None
            lost.body[0, ..., 7:] *= _HUGE
        others = rollout(model, lost, steps=_AHEAD)[1:]
        assert _off(others, together[1:], motions) < _SAME[model.dtype]

    def test_a_seed_makes_one_model_and_one_motion(self, name: str) -> None:
        """Parameters and predictions agree to the last bit, whatever was drawn before."""
        motions = _motions(name)
        torch.rand(7)
        first, second = (_built(name, motions, seed=3) for _ in range(2))
        for one, two in zip(first.parameters(), second.parameters(), strict=True):
            assert torch.equal(one, two)
        assert torch.equal(*(rollout(m, motions, steps=_AHEAD) for m in (first, second)))

    @pytest.mark.parametrize("symmetry", SYMMETRIES)
    def test_declared_symmetries_hold_and_no_others(self, name: str, symmetry: Symmetry) -> None:
        """Before any training, a body that nothing holds shows which symmetries are built in."""
        scene = next(case.scene for case in CASES if case.name == "tumbling")
        if refusal(name, Graph.of(scene)):
            pytest.skip(f"{name} cannot represent a free body")
        motions = _motions(name, scene)
        model = _built(name, motions)
        moved = rollout(model, _moved(motions, symmetry), steps=_AHEAD)
        wanted = _moving(rollout(model, motions, steps=_AHEAD), symmetry, motions.graph.length)
        off = _off(moved, wanted, motions)
        holds, declared = off < _SAME[model.dtype], symmetry in model.symmetries
        assert holds == declared, (
            f"{name} {'declares' if declared else 'does not declare'} {symmetry!r}; moved starts "
            f"are predicted {off:.2g} of the motion off moved predictions"
        )

    def test_it_is_read_back_from_its_file_with_all_it_needs(
        self, name: str, tmp_path: Path
    ) -> None:
        """A model read back predicts the same, to the last bit."""
        motions = _motions(name)
        model, statistics = _built(name, motions, seed=3), Statistics.of(motions)
        settings = model.tracks.get(track_of(name))
        save_model(tmp_path / "model.pt", model, name, settings, statistics, seed="3")
        again, facts = read_model(tmp_path / "model.pt")
        assert facts == {"seed": "3"}
        assert torch.equal(*(rollout(m, motions, steps=_AHEAD) for m in (model, again)))

    def test_it_learns(self, name: str) -> None:
        """The loss, a mean over the batch with gradients, falls on windows kept aside."""
        motions = _motions(name)
        model = _built(name, motions)
        if not model.tracks:
            assert not list(model.parameters()), f"{name}: nothing says how to learn"
            return
        recipe = model.tracks[track_of(name)].recipe
        horizon = max(2, recipe.horizon)
        windows = motions.draw(64, torch.Generator().manual_seed(7), horizon)
        loss = model.loss(windows, torch.Generator().manual_seed(8))
        assert loss.shape == ()
        optimiser = torch.optim.Adam(model.parameters(), lr=1e-3)
        draws = torch.Generator().manual_seed(9)
        for _ in range(_LESSONS):
            optimiser.zero_grad()
            model.loss(motions.draw(16, draws, horizon), draws).backward()  # type: ignore[no-untyped-call]
            optimiser.step()
        assert model.loss(windows, torch.Generator().manual_seed(8)) < loss


def _built(name: str, motions: Motions, seed: int = 0) -> LearnedModel:
    statistics = Statistics.of(motions)
    return build(name, motions.graph, statistics, track=track_of(name), seed=seed).eval()


def _motions(name: str, scene: Scene | None = None) -> Motions:
    """Return the reference's motions of a scene, or of the first that the model can represent."""
    if scene is None:
        names = ("2pendulum", *PAPER_SCENES)
        graphs = (Graph.of(load_scene(candidate)) for candidate in names)
        scene = next(g.scene for g in graphs if not refusal(name, g))
    return motions_of(load_model(name), scene)


def motions_of(
    kind: type[LearnedModel], scene: Scene, *, rows: int = _ROWS, frames: int = _FRAMES
) -> Motions:
    """Return the reference's motions of a scene's first starts, as a kind of model gets them.

    Random forces are among the known inputs, so that only the scene is left to learn.
    """
    batch, points = draw_batch(scene, range(rows)).truncated(frames), Points.of(scene)
    truth, graph = solve(scene, batch), Graph.of(scene)
    position, velocity = (
        graph.embed(torch.from_numpy(values).to(kind.dtype), rest=rest)
        for values, rest in zip(points.motion(truth), (None, 0.0), strict=True)
    )
    states = (truth.position, truth.orientation, truth.velocity, truth.angular_velocity)
    return Motions(
        graph=graph,
        split="train",
        index=batch.index,
        position=position,
        velocity=velocity,
        inputs=KnownInputs(
            *(torch.from_numpy(array).to(kind.dtype) for array in (batch.force, batch.torque))
        ),
        body=torch.from_numpy(np.concatenate(states, axis=-1)) if kind.needs_bodies else None,
    )


def _moved(motions: Motions, symmetry: Symmetry) -> Motions:
    """Return the same motions shifted, or turned about the vertical."""
    length = motions.graph.length
    body = motions.body
    if body is not None:
        turned = rotation.multiply(_quaternion(symmetry), body[..., 3:7].numpy())
        parts = [
            _moving(body[..., :3], symmetry, length),
            torch.from_numpy(turned),
            *(_turned(body[..., k : k + 3], symmetry) for k in (7, 10)),
        ]
        body = torch.cat(parts, dim=-1)
    inputs = dataclasses.replace(motions.inputs, force=_turned(motions.inputs.force, symmetry))
    return dataclasses.replace(
        motions,
        position=_moving(motions.position, symmetry, length),
        velocity=_turned(motions.velocity, symmetry),
        inputs=inputs,
        body=body,
    )


def _moving(places: Tensor, symmetry: Symmetry, length: float) -> Tensor:
    shift = torch.tensor(_SHIFT).to(places) * length
    return places + shift if symmetry == "shift" else _turned(places, symmetry)


def _turned(vectors: Tensor, symmetry: Symmetry) -> Tensor:
    matrix = torch.from_numpy(rotation.matrix(_quaternion(symmetry))).to(vectors)
    return vectors @ matrix.T


def _quaternion(symmetry: Symmetry) -> np.ndarray:
    angle = _TURN if symmetry == "turn" else 0.0
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])


def _off(predicted: Tensor, wanted: Tensor, motions: Motions) -> float:
    """Return the largest distance, over the largest displacement of a frame."""
    moved = motions.position.diff(dim=1).norm(dim=-1).max()
    return float((predicted - wanted).norm(dim=-1).max() / moved)
