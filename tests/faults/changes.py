"""Changes of the scene, the settings and the inputs that reach an engine."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.scene import Body, Inertia, Scene
from mbds_xsim.scene.state import Batch

from .planting import Change

Figure = Callable[[Any], Any]


def options(**values: float | str) -> Change:
    """Set options of an adapter."""
    return Change(settings=lambda old: dataclasses.replace(old, options={**old.options, **values}))


def changed(**changes: Figure) -> Figure:
    """Change fields of a scene or of one of its tables, each by a function of the right value."""
    return lambda old: msgspec.structs.replace(
        old, **{key: change(getattr(old, key)) for key, change in changes.items()}
    )


def gravity(value: float) -> Change:
    """Give the scene another gravity [m/s²]."""
    return Change(model=changed(gravity=lambda _: (0.0, 0.0, -value)), told="gravity [m/s²]")


def tilted(degrees: float) -> Change:
    """Tilt gravity about y, as on ground that is not level."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))

    def turned(pull: Any) -> Any:
        return c * pull[0] - s * pull[2], 0.0, s * pull[0] + c * pull[2]

    return Change(model=changed(gravity=turned), told="gravity [m/s²]")


def ground(key: str, change: Figure) -> Change:
    """Give the ground another coefficient."""
    return Change(model=changed(ground=changed(**{key: change})), told=f"{key} of")


def collisions(key: str, change: Figure) -> Change:
    """Give collisions another coefficient."""
    return Change(model=changed(collisions=changed(**{key: change})), told=f"{key} of a collision")


def bare(scene: Scene) -> Scene:
    """Leave all contact out."""
    return msgspec.structs.replace(scene, contacts=(), ground=None, collisions=None)


def part(group: str, name: str, change: Figure, told: str) -> Change:
    """Change one part of a scene.

    Args:
        group: The scene's field that lists such parts.
        name: Name of the part or of its body; empty for all of them.
        change: Function of the right part that returns the wrong one.
        told: See `Change`.
    """

    def each(parts: Any) -> Any:
        of = [getattr(one, "name", getattr(one, "body", "")) for one in parts]
        assert not name or name in of
        return tuple(
            change(one) if name in ("", other) else one
            for one, other in zip(parts, of, strict=True)
        )

    return Change(model=changed(**{group: each}), told=told)


def flipped(name: str) -> Change:
    """Flip the axis of a joint."""
    return part("joints", name, changed(axis=scaled(-1, -1, -1)), f"axis of {name}")


def radius(change: Figure) -> Change:
    """Change the radius of every contact sphere."""
    return part("contacts", "", changed(radius=change), "radius of contact")


def particles(name: str, told: str, **changes: Figure) -> Change:
    """Change figures of each particle of a body."""

    def each(old: Any) -> Any:
        return tuple(map(changed(**changes), old))

    return part("bodies", name, changed(particles=each), told)


def heavier(name: str, share: float) -> Change:
    """Make the particles of a body heavier by a share of their mass."""
    return particles(name, f"mass [kg] of {name}", mass=scaled(1 + share))


def stouter(name: str, share: float) -> Change:
    """Give a body more inertia, by a share of its largest moment, and no more mass."""

    def more(old: Any) -> Any:
        places = np.array([particle.position for particle in old])
        spread = np.sum((places - places.mean(axis=0)) ** 2, axis=0)
        added = share * float(spread.sum() - spread.min()) / len(places)
        return tuple(changed(inertia=lambda inertia: inertia + added)(one) for one in old)

    return part("bodies", name, changed(particles=more), "inertia")


def thick_rods(scene: Scene) -> Scene:
    """Double the inertia of rods about themselves."""

    def thicken(body: Body) -> Body:
        (particle,) = body.particles
        moments = (particle.inertia, particle.inertia, 2.0 * particle.inertia)
        inertia = Inertia(particle.mass, moments, com=particle.position)
        return msgspec.structs.replace(body, particles=(), inertia=inertia)

    return msgspec.structs.replace(scene, bodies=tuple(map(thicken, scene.bodies)), edges=())


def scaled(*shares: float) -> Figure:
    """Scale a number, or each of several by a share of its own."""
    if len(shares) == 1:
        return lambda value: shares[0] * value
    return lambda values: tuple(a * b for a, b in zip(values, shares, strict=True))


def moved(*by: float) -> Figure:
    """Move a point."""
    return lambda point: tuple(a + b for a, b in zip(point, by, strict=True))


def times(*shares: float) -> Callable[[Array], Array]:
    """Scale arrays, or each of their components by a share of its own."""
    return lambda values: np.array(shares) * values


def force(change: Callable[[Array], Array]) -> Change:
    """Change the forces on bodies."""
    return Change(inputs=lambda batch: dataclasses.replace(batch, force=change(batch.force)))


def torque(change: Callable[[Array], Array]) -> Change:
    """Change the torques of hinges."""
    return Change(inputs=lambda batch: dataclasses.replace(batch, torque=change(batch.torque)))


def late_inputs(batch: Batch) -> Batch:
    """Apply each frame's inputs one frame late; the first frame has its own."""
    late = np.maximum(np.arange(batch.steps) - 1, 0)
    return dataclasses.replace(batch, force=batch.force[:, late], torque=batch.torque[:, late])


def without_inputs(frame: int) -> Change:
    """Leave the inputs of a frame out."""

    def changed(batch: Batch) -> Batch:
        inputs: dict[str, Any] = {"force": batch.force.copy(), "torque": batch.torque.copy()}
        for values in inputs.values():
            values[:, frame : frame + 1] = 0.0  # a slice: a start alone has no frames
        return dataclasses.replace(batch, **inputs)

    return Change(inputs=changed)


def early(values: Array) -> Array:
    """Give each frame the values of the next."""
    return np.concatenate([values[:, 1:], values[:, -1:]], axis=1)


def kicked(forces: Array) -> Array:
    """Push a ball of 1 kg up for a frame by twice its weight [N], so that it hops."""
    pushed = forces.copy()
    pushed[:, 10:11, 0, 2] += 2.0 * 9.81
    return pushed


def in_body_frames(batch: Batch) -> Batch:
    """Treat forces in W as forces in the frames that bodies start with."""
    turned = rotation.rotate(batch.orientation[:, None], batch.force)
    return dataclasses.replace(batch, force=turned)


def swapped_start(batch: Batch) -> Batch:
    """Take xyzw for wxyz."""
    return dataclasses.replace(batch, orientation=np.roll(batch.orientation, 1, axis=-1))


def started(**by: float) -> Change:
    """Start slightly off the drawn start."""
    return Change(
        inputs=lambda batch: dataclasses.replace(
            batch, **{key: getattr(batch, key) + value for key, value in by.items()}
        ),
        told="start",
    )
