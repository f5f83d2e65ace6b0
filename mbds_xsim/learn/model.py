"""What a learned model is, and how it predicts trajectories of a scene that it can represent."""

from __future__ import annotations

import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import chdir, contextmanager, redirect_stdout, suppress
from dataclasses import replace
from typing import Any, ClassVar, Literal, Self, final

import torch
from torch import Tensor, nn

from mbds_xsim.base.errors import InputError, Unsupported, check_name
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import HISTORY, KnownInputs, Motions, Sample, Start
from mbds_xsim.simulate.registry import registered

Change = Literal["acceleration", "displacement"]

Symmetry = Literal["shift", "turn"]
SYMMETRIES: tuple[Symmetry, ...] = ("shift", "turn")
"""Motions of the whole under which predictions move along: to elsewhere, about the vertical."""

_GROUP = "mbds_xsim.models"
"""Entry points of models; docs/add-a-model.md."""
TRIVIAL = ("hold", "constant_velocity", "constant_acceleration")
"""What every model must beat."""
_BATCH = 512
_NODES = 4096
"""At a time on a CPU: the tensors of more leave its caches, and are so large that each is made of
pages new from the system, which makes rows dearer."""
_PUSHED = 0.5
"""Of the windows, those that go on for a frame more; so half of a batch are true ones."""


class LearnedModel(nn.Module, ABC):
    """A model of one scene. What it carries from frame to frame is a tensor, one row a trajectory.

    A subclass is made of graph, statistics and settings; its parameters are drawn from torch's
    global generator then.
    """

    tracks: ClassVar[Mapping[str, Any]] = {}
    """Hyper-parameters by track: `paper`, `native`, `lite`, `native+`; none where there is nothing
    to set. The last is the smallest, and what is taken where a profile's is not there."""
    dtype: ClassVar[torch.dtype] = torch.float32
    """Of what it is given, and of its parameters if `in_precision` does not say otherwise."""
    needs_bodies: ClassVar[bool] = False
    """Whether starts must have the bodies' states."""
    symmetries: ClassVar[frozenset[Symmetry]] = frozenset()
    """Motions of the whole that it does not learn, but keeps by the way it is made."""
    mixes: ClassVar[bool] = False
    """Whether its networks may compute in bfloat16: not where they carry positions."""

    @abstractmethod
    def __init__(self, graph: Graph, statistics: Statistics, settings: Any) -> None:
        super().__init__()
        self.graph = graph

    def in_precision(self) -> Self:
        """Bring parameters and constants to the precision that the model computes in."""
        return self.to(self.dtype)

    @abstractmethod
    def begin(self, start: Start) -> Tensor:
        """Give the state at the last known frame, shape (batch, …)."""

    @abstractmethod
    def advance(self, state: Tensor, inputs: KnownInputs) -> Tensor:
        """Give the state a frame later; inputs are those over the frame to come."""

    @abstractmethod
    def positions(self, state: Tensor) -> Tensor:
        """Give the particles' positions in W [m], shape (batch, particle, 3)."""

    @abstractmethod
    def loss(self, sample: Sample, generator: torch.Generator) -> Tensor:
        """Give what training minimises, a mean over the batch; the CPU's generator is for noise."""


class PointModel(LearnedModel):
    """A model that sees the last positions and gives an acceleration or a displacement."""

    change: ClassVar[Change]
    """What `predict` gives: second or first differences of positions [m]."""

    @abstractmethod
    def predict(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        """Give the change to the next frame [m], shape (batch, particle, 3).

        From positions, oldest first [m], (batch, 6, particle, 3), and inputs over the frame to
        come.
        """

    @final
    def begin(self, start: Start) -> Tensor:
        return start.history

    @final
    def advance(self, state: Tensor, inputs: KnownInputs) -> Tensor:
        displacement, wanted = self.predict(state, inputs), state[:, -1].shape
        if displacement.shape != wanted:  # which sums would not refuse
            msg = f"predict gave the shape {tuple(displacement.shape)}, needed is {tuple(wanted)}"
            raise ValueError(msg)
        if self.change == "acceleration":  # semi-implicit Euler in units of frames
            displacement = state[:, -1] - state[:, -2] + displacement
        # Where the scene does not move, positions are known and the networks are not asked.
        after = state[:, -1] + displacement * self.graph.moving.to(state)
        return torch.cat([state[:, 1:], after[:, None]], dim=1)

    @final
    def positions(self, state: Tensor) -> Tensor:
        return state[:, -1]


class FlowModel(LearnedModel):
    """A model that gives the time derivative of coordinates of its own."""

    substeps: int
    """Steps of the classical Runge-Kutta method in a frame."""

    @abstractmethod
    def derivative(self, state: Tensor, inputs: KnownInputs) -> Tensor:
        """Give the state's time derivative [1/s], of the state's shape."""

    @final
    def advance(self, state: Tensor, inputs: KnownInputs) -> Tensor:
        step = self.graph.frame_s / self.substeps
        for _ in range(self.substeps):
            state = runge_kutta(lambda at, _: self.derivative(at, inputs), state, step)
        return state


def runge_kutta(
    derivative: Callable[[Tensor, float], Tensor], state: Tensor, step: float
) -> Tensor:
    """Take a step [s] of the classical method of fourth order.

    The derivative is given a state and the time since the step began [s].
    """
    first = derivative(state, 0.0)
    second = derivative(state + 0.5 * step * first, 0.5 * step)
    third = derivative(state + 0.5 * step * second, 0.5 * step)
    fourth = derivative(state + step * third, step)
    return state + step / 6.0 * (first + 2.0 * (second + third) + fourth)


def model_names() -> list[str]:
    """Names of all models that packages register, the trivial ones last."""
    names = sorted(registered(_GROUP))
    return sorted(names, key=lambda name: name in TRIVIAL)


def trainable() -> list[str]:
    """Names of the models that have something to learn; without those that cannot be loaded."""
    found = []
    for name in model_names():
        with suppress(InputError):
            found += [name] if load_model(name).tracks else []
    return found


@contextmanager
def of_another_package() -> Iterator[None]:
    """Stay in this folder and in this process, whatever a package's code does.

    What it prints is none of a command's output, which may be read by a machine.
    """
    try:
        with chdir(os.curdir), redirect_stdout(sys.stderr):
            yield
    except SystemExit as error:
        raise RuntimeError(f"it exits with {error.code!r}") from error


def load_model(name: str) -> type[LearnedModel]:
    """Find a model by name.

    Raises:
        UnknownName: No package registers it.
        InputError: What a package registers by that name is no model, or fails on import.
    """
    points = registered(_GROUP)
    check_name("model", name, model_names())
    try:
        with of_another_package():
            kind = points[name].load()
    except Exception as error:  # another package's code
        told = " ".join(f"{type(error).__name__}: {error}".split())
        msg = f"the model {name} cannot be used: {told}; repair or uninstall {points[name].value}"
        raise InputError(msg) from error
    if lack := _lack(kind):
        raise InputError(f"the model {name} cannot be used: {points[name].value} {lack}")
    model: type[LearnedModel] = kind
    return model


def _lack(kind: Any) -> str:
    """Say what a class lacks to be a model; "" of one that is."""
    if not (isinstance(kind, type) and issubclass(kind, LearnedModel)):
        return "is no LearnedModel"
    tracks: Any = kind.tracks  # another package's, which may be anything
    if not isinstance(tracks, Mapping):
        return f"has no tracks by name, but {tracks!r}"
    bare = [track for track, settings in tracks.items() if not hasattr(settings, "recipe")]
    return f"has no recipe in its track {bare[0]}" if bare else ""


def track_of(name: str, track: str | None = None, usual: str = "") -> str:
    """Give a model's track: the one asked for, else a usual one that it has, else its last.

    The last of a model's tracks is the smallest; "" of a model without any. UnknownName where
    there is no such model, InputError where it has no such track.
    """
    tracks = load_model(name).tracks
    if track is not None and tracks and track not in tracks:
        msg = f"--track: got {track!r}, allowed for {name} is {', '.join(tracks)}"
        raise InputError(msg)
    return track or (usual if usual in tracks else ["", *tracks][-1])


def build(
    name: str, graph: Graph, statistics: Statistics, *, track: str | None = None, seed: int = 0
) -> LearnedModel:
    """Make an untrained model: the same seed makes the same parameters.

    Of its track `native`, or the last, where none is named; errors are those of `track_of`.

    Raises:
        Unsupported: It cannot represent the scene, or fails on it and is another package's.
    """
    kind, track = load_model(name), track_of(name, track, "native")
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        try:
            with of_another_package():
                return kind(graph, statistics, kind.tracks.get(track)).in_precision()
        except Exception as error:
            if isinstance(error, InputError) or kind.__module__.startswith("mbds_xsim."):
                raise
            told = " ".join(f"{type(error).__name__}: {error}".split())
            msg = f"{kind.__module__}:{kind.__name__} fails on scene {graph.scene.name!r}: {told}"
            raise Unsupported(msg) from error


def refusal(name: str, graph: Graph, *, track: str | None = None) -> str:
    """Say why a model cannot represent a scene; "" where it can."""
    try:
        build(name, graph, Statistics.of_nothing(), track=track)
    except Unsupported as error:
        return str(error)
    return ""


def rollout(
    model: LearnedModel, motions: Motions, *, steps: int | None = None, batch: int = _BATCH
) -> Tensor:
    """Predict trajectories from their first `HISTORY` frames on, so many frames or all of them.

    Returns:
        Positions behind frame `HISTORY` [m], shape (trajectory, frame, particle, 3); not a number
        from where a prediction failed: to be counted, never dropped.

    Raises:
        InputError: There are not so many frames, or the model needs the bodies' states.
    """
    most = motions.frame_count - HISTORY
    steps = most if steps is None else steps
    if not 1 <= steps <= most:
        msg = f"steps: got {steps}, allowed is 1 to {most}"
        raise InputError(msg)
    if model.needs_bodies and motions.body is None:
        msg = "this model starts from the bodies' states; read the motions with bodies=True"
        raise InputError(msg)
    parts = []
    with torch.no_grad():
        for k in range(0, len(motions), batch):
            rows = torch.arange(k, min(k + batch, len(motions)), device=motions.position.device)
            sample = motions.sample(rows, HISTORY - 1, steps)
            parts.append(roll(model, sample.start, sample.inputs))
    return torch.cat(parts)


def roll(model: LearnedModel, start: Start, inputs: KnownInputs) -> Tensor:
    """Predict frame by frame from what is known, under the inputs of all frames to come.

    Returns:
        Positions [m], shape (batch, frame, particle, 3). A row that is not finite at a frame stays
        so, and the others go on undisturbed.
    """
    block = len(start)
    if start.history.device.type == "cpu":
        block = max(1, _NODES // model.graph.node_count)
    parts = range(0, len(start), block)
    return torch.cat(
        [go_on(model, model.begin(start[k : k + block]), inputs[k : k + block]) for k in parts]
    )


def go_on(model: LearnedModel, state: Tensor, inputs: KnownInputs) -> Tensor:
    """Do as `roll` does from states of the model's own, all rows at once."""
    first = state
    alive = torch.ones(len(state), dtype=torch.bool, device=state.device)
    frames = []
    for frame in range(inputs.torque.shape[1]):
        state = model.advance(state, inputs.at(frame))
        alive = alive & state.flatten(1).isfinite().all(1)
        # Solvers refuse numbers that are none: failed rows are kept at their start, unseen.
        state = torch.where(_like(alive, state), state, first)
        positions = model.positions(state)
        frames.append(torch.where(_like(alive, positions), positions, torch.nan))
    return torch.stack(frames, dim=1)


def _like(flags: Tensor, values: Tensor) -> Tensor:
    return flags.reshape(-1, *[1] * (values.dim() - 1))


def pushed(model: PointModel, sample: Sample) -> Sample:
    """Let half of a batch go on from the model's own prediction, half of these again, and so on.

    So it learns to correct what it does: what a model gets wrong, such as a rod's length, is in no
    data, and may grow from frame to frame. The more frames to come, the farther; the last of them
    is learned from. No gradient passes through the predictions. Source: Brandstetter, Worrall and
    Welling, "Message passing neural PDE solvers", ICLR 2022, section 3.1, there one frame of all
    windows; what more are worth is in docs/train.md.

    Returns:
        The windows, with one frame to come: what follows the predictions, or the last known frame.
    """
    history, inputs = sample.start.history, sample.inputs
    age = torch.zeros(len(history), dtype=torch.int64, device=history.device)
    with torch.no_grad():
        for frame in range(sample.position.shape[1] - 1):
            count = round(_PUSHED ** (frame + 1) * len(history))
            if not count:  # a small batch
                break
            ahead = model.advance(history[:count], inputs[:count, frame])
            history = torch.cat([ahead, history[count:]])
            age[:count] += 1
    row = torch.arange(len(age), device=age.device)
    return Sample(
        start=replace(sample.start, history=history),
        inputs=inputs[row, age][:, None],
        position=sample.position[row, age][:, None],
        velocity=sample.velocity[row, age][:, None],
    )


class Hold(PointModel):
    """Everything stays where it is. The loss is the mean squared error [m²]."""

    symmetries: ClassVar[frozenset[Symmetry]] = frozenset(SYMMETRIES)
    change: ClassVar[Change] = "displacement"

    def __init__(self, graph: Graph, statistics: Statistics, settings: None) -> None:
        super().__init__(graph, statistics, settings)

    def predict(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        del inputs
        return torch.zeros_like(history[:, -1])

    def loss(self, sample: Sample, generator: torch.Generator) -> Tensor:
        del generator
        after = self.positions(self.advance(sample.start.history, sample.inputs.at(0)))
        return ((after - sample.position[:, 0]) ** 2).sum(-1).mean()


class ConstantVelocity(Hold):
    """Every particle goes on as it last did."""

    change: ClassVar[Change] = "acceleration"


class ConstantAcceleration(ConstantVelocity):
    """Every particle goes on accelerating as it last did."""

    def predict(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        del inputs
        return history[:, -1] - 2.0 * history[:, -2] + history[:, -3]
