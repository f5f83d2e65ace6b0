"""Matched settings for scenes without stored ones: a short search, cached by scene physics.

The whole search of an engine is one task: its preset method, then its others, from few steps per
frame to many, until a start of each interval meets all budgets with a margin.
The study `match` searches longer, compares methods and verifies on starts of another seed.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.base.isolate import Conduct, Crash, Task, run_tasks
from mbds_xsim.base.versions import CHECKS
from mbds_xsim.measure.campaign import run_references
from mbds_xsim.measure.outcome import ReferenceOutcome
from mbds_xsim.measure.trial import Trial, run_trial
from mbds_xsim.reference import cache as disk
from mbds_xsim.scene.sampling import Starts
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, fingerprint
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Adapter, Settings
from mbds_xsim.simulate.choice import MATCHED, Choice, Matched, is_stored

_VERSION = 3
"""Version of the search, to be raised when it finds different settings."""
_LIMIT = 60.0
"""Time limit of an engine's search [s]."""
_GRACE = 120.0
"""Additional time limit of the last trial [s]."""
_SPARE = 0.7
"""Share of each budget that the starts of the search may use; other starts will use more."""
_AIM = 0.5
_WASTED = 0.2
"""Share of the budgets below which a trial with fewer steps is worthwhile."""
_LEAST = 1e-3
_NEAR = 2.0
"""Factor above a failed number of steps within which a further trial gains nothing."""
_LEAP = 6.0
"""Factor by which the number of steps rises after a motion was lost."""


def searched(scene: Scene, choice: Choice, conduct: Conduct) -> Choice:
    """Return a choice with matched settings for every engine without stored ones for the scene.

    Stored ones do not count if the scene has a smaller budget than the built-in one of its name.
    Engines for which none are found in time, or that cannot simulate the scene, keep their presets,
    or what is stored.
    Settings found earlier are taken from the cache, if `conduct` allows it.
    """
    if MATCHED not in choice.profiles or choice.step is not None or choice.method is not None:
        return choice
    keys = {name: _key(scene, registry.load_adapter(name)) for name in _without(scene, choice)}
    if choice.named and _refuses(scene, choice, [n for n in choice.engines if n not in keys]):
        return choice
    settings = {
        name: entry for name in keys if conduct.cache and (entry := _load(keys[name])) is not None
    }
    missing = [name for name in keys if name not in settings]
    if missing:
        batch = Starts().draw(scene)
        conduct.meter.begin(len(missing))
        conduct.meter.doing(f"settings of {', '.join(missing)}")
        reference = run_references(scene, batch, conduct)
        unkept: list[InputError] = []

        def finished(place: int, answer: Matched | Crash | None) -> None:
            name = missing[place]
            conduct.meter.advance(f"settings of {name}")
            if isinstance(answer, Matched):
                settings[name] = answer
                if conduct.cache and not unkept:
                    try:
                        _store(keys[name], answer)
                    except InputError as error:
                        unkept.append(error)
                        conduct.meter.notice(f"settings that were found are not kept: {error}")

        tasks = [
            Task(_search, (scene, batch, reference, name), _LIMIT + _GRACE) for name in missing
        ]
        run_tasks(tasks, workers=conduct.workers, finished=finished)
    if not settings:
        return choice
    matched = {**choice.settings.get(MATCHED, {}), **settings}
    return dataclasses.replace(choice, settings={**choice.settings, MATCHED: matched})


def check_able(scene: Scene, choice: Choice) -> None:
    """Raise Unsupported if engines cannot simulate a scene, whatever settings a search finds."""
    free = _without(scene, choice) if MATCHED in choice.profiles else []
    others = [name for name in choice.engines if name not in free]
    if (choice.named or not free) and _refuses(scene, choice, others):
        choice.contenders(scene)  # raises


def _without(scene: Scene, choice: Choice) -> list[str]:
    """List the engines that lack settings for the scene but have a method for it."""
    matched = choice.settings.get(MATCHED, {})
    return [
        name
        for name in choice.engines
        if name not in matched
        and not _serves(scene, name)
        and _methods(scene, registry.load_adapter(name))
    ]


def _serves(scene: Scene, engine: str) -> bool:
    """Return whether settings are stored for an engine and the scene, at budgets no larger."""
    if not is_stored(scene, engine):
        return False
    stored, own = registry.load_scene(scene.name).budget, scene.budget
    return all(getattr(stored, key) <= getattr(own, key) for key in own.__struct_fields__)


def _refuses(scene: Scene, choice: Choice, engines: Sequence[str]) -> bool:
    """Whether one of the engines cannot simulate the scene: `Choice.contenders` will say so."""
    try:
        dataclasses.replace(choice, engines=tuple(engines)).contenders(scene)
    except Unsupported:
        return True
    return False


def _methods(scene: Scene, adapter: Adapter) -> list[Settings]:
    """List settings to try: the preset, then the engine's own other methods with its options."""
    try:
        preset = adapter.settings(scene, "matched")
    except Unsupported:  # `Choice.contenders` says why
        return []
    names = dict.fromkeys([preset.method, *adapter.methods])
    candidates = []
    for name in names:
        settings = Settings(name, scene.clock.frame, preset.options)
        try:
            adapter.check(scene, settings)
        except Unsupported:
            continue
        if adapter.methods[name].own:
            candidates.append(settings)
    return candidates


def _search(scene: Scene, batch: Batch, reference: ReferenceOutcome, engine: str) -> Matched | None:
    """Find the fewest steps of the first method that meets the budgets; None if none does."""
    deadline = time.monotonic() + _LIMIT
    adapter = registry.load_adapter(engine)
    for settings in _methods(scene, adapter):

        def attempt(count: int, settings: Settings = settings) -> Trial:
            finer = dataclasses.replace(settings, step=scene.clock.frame / count)
            return run_trial(scene, batch, engine, finer, reference, len(batch))

        method = adapter.methods[settings.method]
        if method.adaptive:  # it chooses its steps, so that there is one setting to try
            steps = 1 if attempt(1).passed else None
        else:
            order = 1 if scene.contacts else method.order_for(scene)
            steps = fewest(attempt, order, deadline)
        if steps is not None:
            return Matched(settings.method, steps, dict(settings.options))
    return None


def fewest(attempt: Callable[[int], Trial], order: int, deadline: float) -> int | None:
    """Find about the fewest steps per frame that pass with a margin, in few trials.

    The next number of steps is predicted from the last trial's figures and the order with which
    errors fall. If time is up, a number that just passed is better than none.

    Args:
        attempt: Function that tries a number of steps per frame.
        order: Order of the method.
        deadline: Time of `time.monotonic` after which no trial starts [s].
    """
    count, failed, passed, spare, pace = 1, 0, math.inf, math.inf, 0.0
    while time.monotonic() + pace * count < deadline:
        begin = time.monotonic()
        trial = attempt(count)
        pace = (time.monotonic() - begin) / count
        passed = min(passed, count) if trial.passed else passed
        if trial.passed and trial.excess <= _SPARE:
            spare = count
            if trial.excess >= _WASTED:
                break
        else:
            failed = count
        between = [n for n in COUNTS if failed < n < spare]
        if not between or spare <= _NEAR * failed:
            break
        count = min(between, key=lambda n: abs(math.log(n / _predicted(count, trial, order))))
    steps = min(spare, passed) if math.isinf(spare) else spare
    return None if math.isinf(steps) else int(steps)


def _predicted(count: int, trial: Trial, order: int) -> float:
    """Predict the steps per frame that use half of the budgets, at most `_LEAP`² times `count`."""
    if not math.isfinite(trial.excess):
        return _LEAP * count
    share = max(trial.excess, _LEAST) / _AIM
    return count * min(share ** (1.0 / order), _LEAP**2)


def _key(scene: Scene, adapter: Adapter) -> str:
    """Return an entry's key, made of everything that decides it."""
    versions = [_VERSION, CHECKS, adapter.version(), adapter.revision]
    decisive = [versions, fingerprint(scene), scene.budget, adapter.name]
    encoded = msgspec.json.encode([*decisive, adapter.settings(scene, "matched").options])
    return hashlib.sha256(b"matched" + encoded).hexdigest()


def _load(key: str) -> Matched | None:
    entry = disk.load(key)
    return None if entry is None else msgspec.json.decode(entry["settings"].tobytes(), type=Matched)


def _store(key: str, settings: Matched) -> None:
    disk.write(key, {"settings": np.frombuffer(msgspec.json.encode(settings), dtype=np.uint8)})


COUNTS = (
    1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64, 80, 100, 128, 160, 200, 250, 320,
    400, 500, 640, 800, 1000, 1200, 1600, 2000,
)  # fmt: skip
"""Numbers of steps per frame to try."""

_STRIDE = 3
"""Places by which the search moves up: about a doubling."""


@dataclass
class Search:
    """Search for the smallest of rising counts that passes, if all larger ones pass too."""

    counts: Sequence[int] = COUNTS
    failed: int = -1
    """Place of the largest count that failed."""
    passed: int | None = None
    """Place of the smallest count that passed."""
    closed: bool = False
    """Whether larger counts are ruled out."""

    @property
    def next(self) -> int | None:
        """Count to try next; None when the search is over."""
        if self.passed is None:
            if self.closed or self.failed == len(self.counts) - 1:
                return None
            up = self.failed + (_STRIDE if self.failed >= 0 else 1)
            return self.counts[min(up, len(self.counts) - 1)]
        if self.passed - self.failed <= 1:
            return None
        return self.counts[(self.passed + self.failed) // 2]

    @property
    def smallest(self) -> int | None:
        """Smallest count that passed: the answer, once the search is over."""
        return None if self.passed is None else self.counts[self.passed]

    def tell(self, count: int, passed: bool) -> None:
        """Record whether a count passed."""
        place = self.counts.index(count)
        if passed:
            self.passed = place
        else:
            self.failed = place

    def refuse(self, count: int) -> None:
        """Record that a passed count fails after all: the next larger count is the answer."""
        place = self.counts.index(count)
        self.failed = place
        self.passed = place + 1 if place + 1 < len(self.counts) else None
