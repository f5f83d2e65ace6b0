"""What there is, as plain rows: engines with their methods and limits, scenes with their needs."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from mbds_xsim.base.errors import EngineFaulty, EngineMissing, InputError, UnknownName
from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.scene.constraints import degrees_of_freedom
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Profile, Settings
from mbds_xsim.simulate.claims import ContactLaw, Feature, Method, features_of

_TIMEOUT = 600.0  # [s] to load a scene


class MethodRow(msgspec.Struct, frozen=True):
    """One method of an engine."""

    name: str
    family: str
    order: int
    loop_order: int
    """Order where constraints are solved beside the coordinates."""
    velocity_lag: float
    """Recorded velocities belong to (frame time + lag · step)."""
    refuses: dict[str, str]
    """What it, unlike the engine, cannot do, with the reason."""


class OptionRow(msgspec.Struct, frozen=True):
    """One option of an engine."""

    default: float | int | bool | str
    meaning: str


class EngineRow(msgspec.Struct, frozen=True):
    """One engine."""

    engine: str
    version: str
    """"not installed" where it is missing; the rest is empty then."""
    fault: str = ""
    """Why an adapter of another package cannot be used; the rest is empty then, too."""
    package: str = ""
    """Distribution that installs it."""
    coordinates: str = ""
    methods: tuple[MethodRow, ...] = ()
    options: dict[str, OptionRow] = {}
    limits: dict[str, str] = {}
    """What it cannot do, with the reason."""
    contact_law: ContactLaw | None = None
    """What contact is in it."""
    smallest: str = ""
    """Which masses and moments of inertia it holds."""


class SceneRow(msgspec.Struct, frozen=True):
    """One scene."""

    scene: str
    dimension: int
    bodies: int
    particles: int
    joints: int
    loops: int
    degrees_of_freedom: int
    needs: tuple[str, ...]
    description: str


def engine_rows() -> list[EngineRow]:
    """List all known engines, and the reference; a missing one has no methods."""
    return [_engine_row(name) for name in registry.simulator_names()]


def scene_rows() -> list[SceneRow]:
    """List the built-in scenes."""
    return [scene_row(registry.load_scene(name)) for name in registry.scene_names()]


def scene_row(scene: Scene) -> SceneRow:
    """Summarise a scene."""
    mechanism = Mechanism.of(scene)
    needs = features_of(scene)
    return SceneRow(
        scene=scene.name,
        dimension=scene.dimension,
        bodies=mechanism.body_count,
        particles=scene.particle_count,
        joints=len(mechanism.joints),
        loops=len(mechanism.loops) + len(mechanism.distances),
        degrees_of_freedom=degrees_of_freedom(mechanism),
        needs=tuple(feature.value for feature in Feature if feature in needs),
        description=scene.description,
    )


def native_text(scene: Scene, engine: str, settings: Settings, start: int | None = None) -> str:
    """Give exactly what an engine is given: a file of its own, or a script that simulates it.

    Args:
        scene: The scene.
        engine: Name of the engine.
        settings: How it steps.
        start: Number of the trajectory that it starts as; None: the scene's own start.

    Raises:
        InputError: The engine cannot represent the scene, or crashed on it.
    """
    adapter = registry.load_adapter(engine)
    adapter.check(scene, settings)
    (answer,) = run_tasks([Task(_native_text, (scene, engine, settings, start), _TIMEOUT)])
    if isinstance(answer, Crash):
        msg = f"{engine} cannot load the scene: {answer.reason}"
        raise InputError(msg)
    return str(answer)


def _native_text(scene: Scene, engine: str, settings: Settings, start: int | None) -> str:
    drawn = scene if start is not None else msgspec.structs.replace(scene, sampling=(), noise=0.0)
    with registry.load_adapter(engine).open(scene, settings) as run:
        return run.native(draw_batch(drawn, [start or 0]))


def as_profile(name: str) -> Profile:
    """Read a profile's name."""
    profiles: dict[str, Profile] = {"matched": "matched", "native": "native"}
    if name not in profiles:
        raise UnknownName.of("settings profile", name, sorted(profiles))
    return profiles[name]


def by_reason(refusals: dict[str, str]) -> dict[str, list[str]]:
    """Put features that are refused for one reason together."""
    grouped: dict[str, list[str]] = {}
    for feature, reason in refusals.items():
        grouped.setdefault(reason, []).append(feature)
    return grouped


def _engine_row(name: str) -> EngineRow:
    try:
        adapter = registry.load_adapter(name)
    except EngineFaulty as error:
        return EngineRow(name, "cannot be used", fault=str(error))
    except EngineMissing:
        return EngineRow(name, "not installed")
    return EngineRow(
        engine=name,
        version=adapter.version(),
        package=adapter.package,
        coordinates=adapter.coordinates,
        methods=tuple(_method_row(method) for method in adapter.methods.values()),
        options={key: OptionRow(o.default, o.meaning) for key, o in adapter.options.items()},
        limits=_in_words(adapter.limits),
        contact_law=adapter.contact_law,
        smallest=adapter.smallest,
    )


def _method_row(method: Method) -> MethodRow:
    return MethodRow(
        name=method.name,
        family=method.family,
        order=method.order,
        loop_order=method.order if method.loop_order is None else method.loop_order,
        velocity_lag=method.velocity_lag,
        refuses=_in_words(method.refuses),
    )


def _in_words(refusals: Mapping[Feature, str]) -> dict[str, str]:
    return {feature.value: refusals[feature] for feature in Feature if feature in refusals}
