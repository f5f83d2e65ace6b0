"""What contact means in each engine: measured, engine by engine, at each profile."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable

import msgspec
import numpy as np

from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.base.text import counted
from mbds_xsim.measure.running import ProgressSink
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Profile
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.claims import ContactLaw
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.simulate.timed import simulate
from mbds_xsim.studies.contact.bench import ContactBench, ContactFigure
from mbds_xsim.studies.contact.friction import friction
from mbds_xsim.studies.contact.impacts import energy, impacts, limits, rest

_SCENE = "balldrop"
_REPEATS = 3


def cost(engine: str, profile: Profile) -> list[ContactFigure]:
    """Time one trajectory, set-up apart, by one core that may have other work."""
    bench, scene = ContactBench(engine, profile, _SCENE), load_scene(_SCENE)
    batch = draw_batch(scene, [1], noise=False)
    runs = [simulate(scene, batch, engine, bench.settings) for _ in range(_REPEATS)]
    spent = np.array([run.rollout_s for run in runs]) / scene.clock.duration
    return [bench.measured("cost of a simulated second", "s", spent, runs[0].trajectory)]


# The longest first, which leaves no core without work at the end.
_PARTS: dict[str, Callable[[str, Profile], list[ContactFigure]]] = {
    "impacts": impacts,
    "rest": rest,
    "friction": friction,
    "energy": energy,
    "limits": limits,
    "cost": cost,
}


class Missing(msgspec.Struct, frozen=True):
    """A part of the study that an engine did not come through."""

    engine: str
    profile: Profile
    part: str
    reason: str


class ContactStudy(msgspec.Struct, frozen=True):
    """All that was measured."""

    versions: dict[str, str]
    """Of the engines, in the order of the tables."""
    profiles: tuple[Profile, ...]
    laws: dict[str, ContactLaw]
    """What each adapter says of its engine's contact."""
    figures: tuple[ContactFigure, ...]
    missing: tuple[Missing, ...]
    command: str
    machine: str
    wall_s: float

    def find(self, engine: str, profile: str, quantity: str, **at: float) -> list[ContactFigure]:
        """List figures of a quantity under some conditions."""
        return [
            m
            for m in self.figures
            if (m.engine, m.profile, m.quantity) == (engine, profile, quantity)
            and at.items() <= m.at.items()
        ]


def study_contact(
    choice: Choice, *, progress: ProgressSink, workers: int | None = None, command: str = ""
) -> ContactStudy:
    """Measure every engine at every profile, each part in a process of its own.

    Args:
        choice: Engines and profiles; methods and steps are those of the profiles.
        progress: Where progress is told.
        workers: Processes at a time; all cores when left out.
        command: What is told to make the study again.
    """
    begin = time.perf_counter()
    work = [
        (engine, profile, part)
        for part in _PARTS
        for profile in choice.profiles
        for engine in choice.engines
    ]
    progress.begin(len(work))
    answers = run_tasks(
        [Task(_PARTS[part], (engine, profile), choice.limit) for engine, profile, part in work],
        workers=workers,
        finished=lambda place, _: progress.advance(f"{work[place][0]}: {work[place][2]}"),
    )
    adapters = {engine: registry.load_adapter(engine) for engine in choice.engines}
    laws = {engine: adapter.contact_law for engine, adapter in adapters.items()}
    told = list(zip(work, answers, strict=True))
    return ContactStudy(
        versions={engine: adapter.version() for engine, adapter in adapters.items()},
        profiles=choice.profiles,
        laws={engine: law for engine, law in laws.items() if law is not None},
        figures=tuple(m for _, part in told if not isinstance(part, Crash) for m in part),
        missing=(
            *(Missing(*w, part.reason) for w, part in told if isinstance(part, Crash)),
            *(
                Missing(engine, profile, "the study", why)
                for engine, why in choice.faulty.items()
                for profile in choice.profiles
            ),
        ),
        command=command,
        machine=f"{platform.machine()}, {counted(os.cpu_count(), 'core')}, {platform.system()}",
        wall_s=time.perf_counter() - begin,
    )
