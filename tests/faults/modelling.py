"""Faults of the model that reaches an engine: geometry, mass, gravity, springs, the ground."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import msgspec

from mbds_xsim.scene.scene import Scene

from .contact_changes import raised
from .planting import Fault

__all__ = ["MODELLING"]

Change = Callable[[Scene], Scene]


def _tilted(degrees: float) -> Change:
    """Tilt gravity about y, as a ground does that is not level."""

    def changed(scene: Scene) -> Scene:
        x, _, z = scene.gravity
        angle = math.radians(degrees)
        c, s = math.cos(angle), math.sin(angle)
        gravity = (c * x - s * z, 0.0, s * x + c * z)
        return msgspec.structs.replace(scene, gravity=gravity)

    return changed


def _part(group: str, name: str, key: str, change: Callable[[Any], Any]) -> Change:
    """Change one figure of one part, `group` being the scene's field that lists such parts."""

    def changed(scene: Scene) -> Scene:
        parts = [
            msgspec.structs.replace(part, **{key: change(getattr(part, key))})
            if getattr(part, "name", getattr(part, "body", "")) == name
            else part
            for part in getattr(scene, group)
        ]
        assert tuple(parts) != tuple(getattr(scene, group))
        return msgspec.structs.replace(scene, **{group: tuple(parts)})

    return changed


def _scaled(share: float) -> Callable[[float], float]:
    return lambda value: share * value


def _moved(*by: float) -> Callable[[Any], Any]:
    return lambda point: tuple(a + b for a, b in zip(point, by, strict=True))


def _hollow(share: float) -> Callable[[Any], Any]:
    """Scale what inertia particles have of their own."""
    return lambda particles: tuple(
        msgspec.structs.replace(each, inertia=share * each.inertia) for each in particles
    )


def _moments(*shares: float) -> Callable[[Any], Any]:
    def changed(inertia: Any) -> Any:
        moments = tuple(a * b for a, b in zip(inertia.moments, shares, strict=True))
        return msgspec.structs.replace(inertia, moments=moments)

    return changed


def _shifted_centre(*by: float) -> Callable[[Any], Any]:
    return lambda inertia: msgspec.structs.replace(inertia, com=_moved(*by)(inertia.com))


def _fault(
    name: str,
    scene: str,
    engine: str,
    checks: tuple[str, ...],
    model: Change,
    told: str,
    **more: Any,
) -> Fault:
    return Fault(name, scene, (engine,), checks, model=model, told=told, **more)


_LIMIT = ("consistency of positions", "consistency of energy")

MODELLING = (
    _fault("gravity tilted by 0.1°", "3pendulum", "exudyn", _LIMIT, _tilted(0.1), "gravity [m/s²]"),
    _fault(
        "ground tilted by 0.5°", "ballscroll", "dart", ("friction",), _tilted(0.5), "gravity [m/s²]"
    ),
    _fault(
        "anchor of a hinge 1 mm along the rod",
        "3pendulum",
        "mujoco",
        ("gap",),
        _part("joints", "joint2", "anchor", _moved(0.0, 0.0, 1e-3)),
        "anchor",
    ),
    _fault(
        "anchor of a hinge 1 mm along its axis",
        "workbench",
        "dart",
        (),
        _part("joints", "shoulder", "anchor", _moved(3e-4, 1e-3, 1e-4)),
        "anchor",
        unseen={"dart": "anchored anywhere on its axis a hinge is the same hinge"},
    ),
    _fault(
        "hinge axis turned by 0.1°",
        "workbench",
        "mujoco",
        ("angle gap", *_LIMIT),
        _part("joints", "elbow", "axis", _moved(0.0, 0.0, 2e-3)),
        "axis",
    ),
    _fault(
        "centre of mass 1 mm off",
        "workbench",
        "exudyn",
        _LIMIT,
        _part("bodies", "rotor", "inertia", _shifted_centre(1e-3, 0.0, 0.0)),
        "anchor [m] of rotor axle",
    ),
    _fault(
        "one moment of inertia 5 % large",
        "workbench",
        "mujoco",
        _LIMIT,
        _part("bodies", "forearm", "inertia", _moments(1.0, 1.05, 1.0)),
        "inertia",
    ),
    _fault(
        "spring 1 % stiff",
        "workbench",
        "exudyn",
        _LIMIT,
        _part("springs", "cart spring", "stiffness", _scaled(1.01)),
        "stiffness [N/m] of cart spring",
    ),
    _fault(
        "damper 5 % weak",
        "workbench",
        "mujoco",
        _LIMIT,
        _part("springs", "cart spring", "damping", _scaled(0.95)),
        "damping [N·s/m] of cart spring",
    ),
    _fault(
        "spring 1 mm long",
        "workbench",
        "mujoco",
        _LIMIT,
        _part("springs", "stay", "rest_length", lambda length: length + 1e-3),
        "rest length [m] of stay",
    ),
    _fault(
        "flywheel of 5 % more inertia",
        "simplecubli in flight",
        "exudyn",
        ("momentum",),
        _part("bodies", "flywheel_x", "particles", _hollow(2.0)),
        "inertia",
    ),
    _fault(
        "ground 2 mm high, under wheels",
        "particlecar",
        "exudyn",
        ("contact gap", "passivity"),
        raised(2e-3),
        "radius of contact",
    ),
    _fault(
        "centre of a wheel's sphere 3 mm ahead",
        "particlecar",
        "mujoco",
        ("wheels",),
        _part("contacts", "front_left", "center", _moved(3e-3, 0.0, 0.0)),
        "centre of contact",
    ),
)
