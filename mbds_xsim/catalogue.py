"""What there is, as plain rows: engines with their methods and limits, scenes with their needs."""

from __future__ import annotations

import msgspec

from mbds_xsim import registry
from mbds_xsim.constraints import degrees_of_freedom
from mbds_xsim.engine import Feature, Profile, features_of
from mbds_xsim.errors import EngineMissing, UnknownName
from mbds_xsim.matched import settings_for
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.sampling import draw_batch
from mbds_xsim.scene import Scene

__all__ = ["EngineRow", "SceneRow", "engine_rows", "native_text", "scene_row", "scene_rows"]


class EngineRow(msgspec.Struct, frozen=True):
    """One engine."""

    engine: str
    version: str
    """"not installed" where it is missing."""
    coordinates: str
    methods: dict[str, str]
    """Name to family and order."""
    limits: dict[str, str]
    """What it cannot do, with the reason; a method's own limits as "method: feature"."""


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
    """List all known engines; a missing one has no methods."""
    return [_engine_row(name) for name in registry.engine_names()]


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


def native_text(scene: Scene, engine: str, profile: str) -> str:
    """Give exactly what an engine is given for the scene's first trajectory."""
    adapter = registry.load_adapter(engine)
    settings = settings_for(scene, adapter, as_profile(profile))
    with adapter.open(scene, settings) as run:
        run.readback(draw_batch(scene, [0]))
        return run.native()


def as_profile(name: str) -> Profile:
    """Read a profile's name."""
    profiles: dict[str, Profile] = {"matched": "matched", "native": "native"}
    if name not in profiles:
        raise UnknownName.of("settings profile", name, sorted(profiles))
    return profiles[name]


def _engine_row(name: str) -> EngineRow:
    try:
        adapter = registry.load_adapter(name)
    except EngineMissing:
        return EngineRow(name, "not installed", "", {}, {})
    limits = {feature.value: reason for feature, reason in adapter.limits.items()}
    for method in adapter.methods.values():
        for feature, reason in method.refuses.items():
            limits[f"{method.name}: {feature.value}"] = reason
    return EngineRow(
        engine=name,
        version=adapter.version(),
        coordinates=adapter.coordinates,
        methods={m.name: f"{m.family}, order {m.order}" for m in adapter.methods.values()},
        limits=limits,
    )
