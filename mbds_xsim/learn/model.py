"""Base classes of learned models, and rollouts: predicted trajectories of a scene."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, ClassVar, Literal, Self, final

import torch
from torch import Tensor

from mbds_xsim.base.errors import InputError, Unsupported, check_name
from mbds_xsim.learn.graph import Graph, check_edges
from mbds_xsim.learn.layers import TensorModule
from mbds_xsim.learn.plugins import in_a_line, located_in, of_another_package
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import HISTORY, KnownInputs, Motions, Sample, Start
from mbds_xsim.simulate.registry import registered

Change = Literal["acceleration", "displacement"]

Symmetry = Literal["shift", "turn"]
SYMMETRIES: tuple[Symmetry, ...] = ("shift", "turn")
"""Symmetries that a model can have: horizontal shifts of the scene, turns about the vertical."""

_GROUP = "mbds_xsim.models"
"""Entry-point group of models; see docs/add-a-model.md."""
TRIVIAL = ("hold", "constant_velocity", "constant_acceleration")
"""Baselines without parameters, which every model must beat."""
_BATCH = 512
_NODES = 4096
"""Largest number of nodes at a time on a CPU. Larger tensors do not fit its caches, and each is
allocated from new pages of the system, which makes rows more expensive."""
_PUSHED = 0.5
"""Fraction of the windows that go on for one more frame, so half of a batch is recorded data."""


class LearnedModel(TensorModule, ABC):
    """Learned model of one scene. Its state is a tensor with one row per trajectory.

    A subclass is constructed from graph, statistics and settings; its initial parameters are drawn
    from torch's global generator.
    """

    tracks: ClassVar[Mapping[str, Any]] = {}
    """Hyper-parameters by track: `paper`, `native`, `lite`, `native+`; empty if nothing can be set.
    The last track is the smallest, and the fallback for a model that lacks a profile's track."""
    dtype: ClassVar[torch.dtype] = torch.float32
    """Precision of the model's inputs, and of its parameters unless `in_precision` differs."""
    needs_bodies: ClassVar[bool] = False
    """Whether starts must have the bodies' states."""
    symmetries: ClassVar[frozenset[Symmetry]] = frozenset()
    """Symmetries that hold by construction and need not be learned."""
    needs_edges: ClassVar[bool] = False
    """Whether it sees only by the graph's edges what joins bodies."""
    mixes: ClassVar[bool] = False
    """Whether its networks may compute in bfloat16; False if they carry positions."""
    revision: ClassVar[int] = 0
    """Number to raise in a change that gives trained parameters another meaning."""

    @abstractmethod
    def __init__(self, graph: Graph, statistics: Statistics, settings: Any) -> None:
        super().__init__()
        self.graph = graph

    def in_precision(self) -> Self:
        """Convert parameters and constants to the precision in which the model computes."""
        return self.to(self.dtype)

    @abstractmethod
    def begin(self, start: Start) -> Tensor:
        """Return the state at the last known frame, shape (batch, …)."""

    @abstractmethod
    def advance(self, state: Tensor, inputs: KnownInputs) -> Tensor:
        """Return the state one frame later, given the inputs over that frame."""

    @abstractmethod
    def positions(self, state: Tensor) -> Tensor:
        """Return the positions of the particles in W [m], shape (batch, particle, 3)."""

    @abstractmethod
    def loss(self, sample: Sample, generator: torch.Generator) -> Tensor:
        """Return the training loss, a mean over the batch; the CPU's generator is for noise."""


class PointModel(LearnedModel):
    """Model that predicts an acceleration or a displacement from the last positions."""

    change: ClassVar[Change]
    """Output of `predict`: second (acceleration) or first differences of positions [m]."""

    @abstractmethod
    def predict(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        """Return the change to the next frame [m], shape (batch, particle, 3).

        `history` has the last positions, oldest first [m], shape (batch, 6, particle, 3); `inputs`
        are those over the frame to come.
        """

    @final
    def begin(self, start: Start) -> Tensor:
        return start.history

    @final
    def advance(self, state: Tensor, inputs: KnownInputs) -> Tensor:
        displacement, shape = self.predict(state, inputs), state[:, -1].shape
        if displacement.shape != shape:  # broadcasting would hide it
            msg = f"predict gave the shape {tuple(displacement.shape)}, needed is {tuple(shape)}"
            raise ValueError(msg)
        if self.change == "acceleration":  # semi-implicit Euler in units of frames
            displacement = state[:, -1] - state[:, -2] + displacement
        # Along axes in which the scene does not move, the network's output is ignored.
        after = state[:, -1] + displacement.to(state.dtype) * self.graph.moving.to(state)
        return torch.cat([state[:, 1:], after[:, None]], dim=1)

    @final
    def positions(self, state: Tensor) -> Tensor:
        return state[:, -1]


class FlowModel(LearnedModel):
    """Model that predicts the time derivative of its own coordinates."""

    substeps: int
    """Number of classical Runge-Kutta steps per frame."""

    @abstractmethod
    def derivative(self, state: Tensor, inputs: KnownInputs) -> Tensor:
        """Return the time derivative of the state [1/s], in the state's shape."""

    @final
    def advance(self, state: Tensor, inputs: KnownInputs) -> Tensor:
        step = self.graph.frame_s / self.substeps
        for _ in range(self.substeps):
            state = runge_kutta(lambda at, _: self.derivative(at, inputs), state, step)
        return state


def runge_kutta(
    derivative: Callable[[Tensor, float], Tensor], state: Tensor, step: float
) -> Tensor:
    """Take a step [s] of the classical fourth-order Runge-Kutta method.

    The derivative receives a state and the time since the step began [s].
    """
    first = derivative(state, 0.0)
    second = derivative(state + 0.5 * step * first, 0.5 * step)
    third = derivative(state + 0.5 * step * second, 0.5 * step)
    fourth = derivative(state + step * third, step)
    return state + step / 6.0 * (first + 2.0 * (second + third) + fourth)


def model_names() -> list[str]:
    """Return the names of all models that packages register, the trivial ones last."""
    names = sorted(registered(_GROUP))
    return sorted(names, key=lambda name: name in TRIVIAL)


def trainable() -> list[str]:
    """Return the names of the models that can be trained, without those that fail to load."""
    names = []
    for name in model_names():
        with suppress(InputError):
            names += [name] if load_model(name).tracks else []
    return names


def load_model(name: str) -> type[LearnedModel]:
    """Find a model's class by name.

    Raises:
        UnknownName: No package registers it.
        InputError: The object registered by that name is not a model, or fails on import.
    """
    points = registered(_GROUP)
    check_name("model", name, model_names())
    try:
        with of_another_package():
            kind = points[name].load()
    except Exception as error:  # another package's code
        place = points[name].value
        msg = f"the model {name} cannot be used: {in_a_line(error)}; repair or uninstall {place}"
        raise InputError(msg) from error
    if lack := _lack(kind):
        raise InputError(f"the model {name} cannot be used: {points[name].value} {lack}")
    model: type[LearnedModel] = kind
    return model


def _lack(kind: Any) -> str:
    """Return what a class lacks to be a model, or "" if it is one."""
    if not (isinstance(kind, type) and issubclass(kind, LearnedModel)):
        return "is no LearnedModel"
    tracks: Any = kind.tracks  # from another package: may be anything
    if not isinstance(tracks, Mapping):
        return f"has no tracks by name, but {tracks!r}"
    missing = [track for track, settings in tracks.items() if not hasattr(settings, "recipe")]
    return f"has no recipe in its track {missing[0]}" if missing else ""


def track_of(name: str, track: str | None = None, usual: str = "") -> str:
    """Return a model's track: the one asked for, else the usual one if it exists, else the last.

    The last of a model's tracks is the smallest; a model without tracks has "". Raises UnknownName
    for an unknown model, InputError for a track that the model does not have.
    """
    tracks = load_model(name).tracks
    if track is not None and tracks and track not in tracks:
        raise InputError(f"--track: got {track!r}, allowed for {name} is {', '.join(tracks)}")
    return track or (usual if usual in tracks else ["", *tracks][-1])


def build(
    name: str, graph: Graph, statistics: Statistics, *, track: str | None = None, seed: int = 0
) -> LearnedModel:
    """Build an untrained model; the same seed gives the same parameters.

    The default track is `native`, or else the last one; errors are those of `track_of`.

    Raises:
        Unsupported: It cannot represent the scene, or is another package's and fails on it.
    """
    kind, track = load_model(name), track_of(name, track, "native")
    if kind.needs_edges:
        check_edges(graph.scene)
    with torch.random.fork_rng([]):
        torch.default_generator.manual_seed(seed)
        try:
            with located_in(kind), of_another_package():
                return kind(graph, statistics, kind.tracks.get(track)).in_precision()
        except Exception as error:
            if isinstance(error, InputError) or kind.__module__.startswith("mbds_xsim."):
                raise
            msg = f"{kind.__module__}:{kind.__name__} fails on scene {graph.scene.name!r}: "
            raise Unsupported(msg + in_a_line(error)) from error


def refusal(name: str, graph: Graph, *, track: str | None = None) -> str:
    """Return why a model cannot represent a scene, or "" if it can."""
    try:
        build(name, graph, Statistics.of_nothing(), track=track)
    except Unsupported as error:
        return str(error)
    return ""


def rollout(
    model: LearnedModel, motions: Motions, *, steps: int | None = None, batch: int = _BATCH
) -> Tensor:
    """Predict `steps` frames (default: all) of trajectories from their first `HISTORY` frames.

    Returns:
        Positions in these frames [m], shape (trajectory, frame, particle, 3); NaN from the frame
        on at which a prediction failed: failures are to be counted, never dropped.

    Raises:
        InputError: There are too few frames, or the model needs the bodies' states.
    """
    most = motions.frame_count - HISTORY
    steps = most if steps is None else steps
    if not 1 <= steps <= most:
        raise InputError(f"steps: got {steps}, allowed is 1 to {most}")
    if model.needs_bodies and motions.body is None:
        msg = "this model starts from the bodies' states; read the motions with bodies=True"
        raise InputError(msg)
    parts = []
    with torch.no_grad():
        for k in range(0, len(motions), batch):
            rows = torch.arange(k, min(k + batch, len(motions)), device=motions.position.device)
            sample = motions.sample(rows, HISTORY - 1, steps)
            parts.append(roll(model, sample.start, sample.inputs))
    return torch.cat(parts or [motions.position[:, HISTORY : HISTORY + steps]])


def roll(model: LearnedModel, start: Start, inputs: KnownInputs) -> Tensor:
    """Predict frame by frame from known starts, under the inputs of all frames to come.

    Returns:
        Positions [m], shape (batch, frame, particle, 3). A row that is not finite at a frame is
        NaN from there on; the other rows are not affected.
    """
    block = len(start)
    if start.history.device.type == "cpu":
        block = max(1, _NODES // model.graph.node_count)
    parts = [slice(k, k + block) for k in range(0, len(start), block)]
    with located_in(type(model)):
        return torch.cat([go_on(model, model.begin(start[k]), inputs[k]) for k in parts])


def go_on(model: LearnedModel, state: Tensor, inputs: KnownInputs) -> Tensor:
    """Predict as `roll` does, but from the model's own states and with all rows at once."""
    first = state
    alive = torch.ones(len(state), dtype=torch.bool, device=state.device)
    frames = []
    for frame in range(inputs.torque.shape[1]):
        state = model.advance(state, inputs.at(frame))
        alive = alive & state.flatten(1).isfinite().all(1)
        # Solvers reject NaN: failed rows are reset to their start, and their output is hidden.
        state = torch.where(_like(alive, state), state, first)
        positions = model.positions(state)
        frames.append(torch.where(_like(alive, positions), positions, torch.nan))
    return torch.stack(frames, dim=1)


def _like(flags: Tensor, values: Tensor) -> Tensor:
    return flags.reshape(-1, *[1] * (values.dim() - 1))


def pushed(model: PointModel, sample: Sample) -> Sample:
    """Advance half of a batch by the model's own prediction, half of these again, and so on.

    This teaches the model to correct its own errors: a wrong length of a rod, for example, is in
    no data and may grow from frame to frame. Windows with n frames to come are advanced by up to
    n − 1 of them. No gradient passes through the predictions. Source: Brandstetter, Worrall and
    Welling, "Message passing neural PDE solvers", ICLR 2022, section 3.1, which advances all
    windows by one frame; docs/research-notes.md has the gain by more frames.

    Returns:
        Windows with one frame to come: the one after the predictions or the last known frame.
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
    """Baseline in which nothing moves. The loss is the mean squared error [m²]."""

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
    """Baseline in which every particle keeps its last velocity."""

    change: ClassVar[Change] = "acceleration"


class ConstantAcceleration(ConstantVelocity):
    """Baseline in which every particle keeps its last acceleration."""

    def predict(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        del inputs
        return history[:, -1] - 2.0 * history[:, -2] + history[:, -3]
