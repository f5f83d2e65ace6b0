"""Which settings a trade-off chart tries: engine × method × option × steps a frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

from mbds_xsim.base.errors import Unsupported
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Adapter, Settings
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.claims import features_of
from mbds_xsim.simulate.simulator import NATIVE, EngineMethod
from mbds_xsim.studies.tradeoff.rows import AT_ONCE, BATCH

COUNTS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""Steps a frame that a method is tried at."""
DIGITS = (5, 6, 7, 8, 9, 10, 11, 12)
"""Of the tolerances that an adaptive method is tried at."""
SPAN = 100
"""A method is tried up to so many steps a frame whatever comes of it: two decades of steps."""
_THIN = (2, 5, 20)  # steps a frame at which a changed option is tried


def curves_of(scene: Scene, engines: Sequence[str]) -> tuple[list[EngineMethod], dict[str, str]]:
    """List the curves of a scene's chart.

    The options in use are those of the engine's matched settings, for all of its methods. They
    are changed for the matched method only, and where an option belongs to certain methods.

    Returns:
        The curves, and the methods left out as "engine method", each with the reason.
    """
    curves: list[EngineMethod] = []
    left_out: dict[str, str] = {}
    for name in engines:
        adapter = registry.load_adapter(name)
        try:
            matched = settings_for(scene, adapter, "matched")
        except Unsupported as error:
            left_out[name] = str(error)
            continue
        for method in adapter.methods:
            curve = _curve(scene, adapter, matched, method)
            if refusal := curve.refusal(scene):
                left_out[f"{name} {method}"] = refusal
            elif curve.digits:
                curves += [curve, dataclasses.replace(curve, variation=BATCH, together=AT_ONCE)]
            else:
                curves += [curve, *_variations(scene, adapter, curve, matched.method)]
        curves += _native(scene, adapter)
    return curves, left_out


def _curve(scene: Scene, adapter: Adapter, matched: Settings, method: str) -> EngineMethod:
    """Give a method at the matched options, and at steps or tolerances."""
    if adapter.methods[method].adaptive:
        return EngineMethod(adapter.name, method, given={}, counts=DIGITS, digits=True)
    counts = _counts(scene, matched, method)
    return EngineMethod(adapter.name, method, given=dict(matched.options), counts=counts)


def _counts(scene: Scene, matched: Settings, method: str) -> tuple[int, ...]:
    """Take the matched steps a frame in, so that the chart shows what is published."""
    own = {matched.substeps(scene.clock.frame)} if method == matched.method else set()
    return tuple(sorted(own | set(COUNTS)))


def _variations(
    scene: Scene, adapter: Adapter, base: EngineMethod, preferred: str
) -> Iterator[EngineMethod]:
    """Change one option at a time."""
    needs = features_of(scene)
    for option, sweep in adapter.sweeps.items():
        acts = base.method in (sweep.methods or (preferred,))
        if not acts or (sweep.needs and not sweep.needs & needs):
            continue
        usual = base.options(scene)
        used = usual.get(option, adapter.options[option].default)
        for value in sweep.values:
            if value != used:
                yield dataclasses.replace(
                    base,
                    variation=f"{option} = {value}",
                    given={**usual, option: value},
                    counts=_THIN,
                )


def _native(scene: Scene, adapter: Adapter) -> Iterator[EngineMethod]:
    try:
        settings = adapter.settings(scene, "native")
        adapter.check(scene, settings)
    except Unsupported:
        return
    if adapter.methods[settings.method].adaptive:  # on the curve, at the digits of its own
        return
    count = settings.substeps(scene.clock.frame)
    yield EngineMethod(
        adapter.name, settings.method, variation=NATIVE, given=dict(settings.options),
        counts=(count,), profile="native",
    )  # fmt: skip
