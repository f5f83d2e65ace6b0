"""What a way of putting a mechanism into Exudyn must tell, and the loads that all ways share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.joint_space import BodyStates
from mbds_xsim.mechanism import WORLD_INDEX, Mechanism, PointPair

__all__ = ["HEAD", "Held", "Model", "inertia_text", "loads_listing", "springs_listing"]

Array = NDArray[np.float64]

# Exudyn wants names that no other item has, so the scene's names are comments.
HEAD = """\
import exudyn as exu
import exudyn.itemInterface as items
import numpy as np
from exudyn.utilities import RigidBodyInertia, TreeLink

container = exu.SystemContainer()
mbs = container.AddSystem()
ground = mbs.CreateGround()
bodies, joints, frames, springs, forces, torques = [], [], [], [], [], []"""


@dataclass(frozen=True, eq=False)
class Held:
    """Mass properties as Exudyn holds them, in native frames, body by body."""

    mass: Array
    """[kg], shape (body,)."""
    inertia: Array
    """About the centre of mass [kg·m²], shape (body, 3, 3)."""
    com: Array
    """From the body's marker in `frames` [m], shape (body, 3): nil if all is well."""
    gravity: Array
    """Acting on each body [m/s²], shape (body, 3)."""


class Model(Protocol):
    """A mechanism in Exudyn's terms.

    `names` are those that the listing leaves behind, among them `mbs` and, body by body, `frames`:
    markers at the centres of mass, parallel to the native frames.
    """

    def statements(self) -> Iterator[str]:
        """Lines that build the model, after `HEAD`."""

    def graphics(self) -> Iterator[str]:
        """Lines that give bodies something to be seen by, where the engine draws nothing."""

    def marker(self, body: int, point: Array) -> str:
        """Write a marker at a point of a body's native frame, parallel to it."""

    def from_bodies(self, bodies: BodyStates) -> tuple[Array, Array]:
        """Coordinates and velocities of body states, each of shape (…, coordinate)."""

    def to_bodies(self, coordinates: Array, velocities: Array) -> BodyStates:
        """Body states of coordinates and velocities."""

    def held(self, names: Mapping[str, Any]) -> Held:
        """Read mass properties back."""

    def anchors(self, names: Mapping[str, Any], com: Array, turn: Array) -> Array:
        """Anchors in the parent and in the child, in W as the bodies are, shape (joint, 2, 3)."""

    def joint_axes(self, names: Mapping[str, Any], turn: Array) -> Array:
        """Axes of hinges and sliders in W, with the bodies' rotations (body, 3, 3) as they are."""


def springs_listing(mechanism: Mechanism, ends: Callable[[PointPair], str]) -> Iterator[str]:
    """Lines that make `springs`, their ends as the model writes them."""
    for spring in mechanism.springs:
        yield (
            f"springs.append(mbs.CreateSpringDamper({ends(spring)}, "
            f"referenceLength={spring.length!r}, stiffness={spring.stiffness!r}, "
            f"damping={spring.damping!r}))"
        )


def loads_listing(mechanism: Mechanism) -> Iterator[str]:
    """Lines that make `forces`, one a body, and `torques`, pairs (child, parent) of a hinge."""
    for k in range(mechanism.body_count):
        yield f"forces.append(mbs.CreateForce(itemNumber=frames[{k}]))"
    for joint in mechanism.hinges:
        # The axis is fixed in both bodies, so loads in their frames turn with it.
        pair = ", ".join(
            f"mbs.CreateTorque(itemNumber=frames[{end}], bodyFixed=True)"
            if end != WORLD_INDEX
            else "None"
            for end in (joint.child, joint.parent)
        )
        yield f"torques.append(({pair}))"


def inertia_text(mass: float, inertia: Array, com: Array) -> str:
    """Write mass properties; the tensor is about the centre of mass."""
    return (
        f"RigidBodyInertia(mass={float(mass)!r}, inertiaTensor=np.array({inertia.tolist()!r}), "
        f"com=np.array({com.tolist()!r}), inertiaTensorAtCOM=True)"
    )
