"""Scenes of one body whose one contact sphere meets the ground."""

from __future__ import annotations

from typing import Any

from mbds_xsim.scene.scene import Body, ContactSphere, Ground, Scene, Vector


def over_ground(body: Body, center: Vector, radius: float, ground: Ground, **more: Any) -> Scene:
    sphere = ContactSphere(body.name, center, radius)
    return Scene(body.name, (body,), 1.0, contacts=(sphere,), ground=ground, **more)
