"""Contact spheres on the ground: Exudyn's sphere on one large triangle, a penalty contact.

- Normal: a spring so stiff that an impact lasts a given number of the finest steps, and the
  damping of the next paragraph. What rests sinks by its weight over the stiffness. That law has no
  restitution of 0, for which a linear damper takes its place, critical for the mass of all bodies:
  what is lighter creeps back to the surface, and nothing rebounds.
- Tangential: Coulomb's friction against the slip, isotropic; below `slip_speed` it is
  proportional to the slip.
- The solver is let shorten a step so that it ends where a sphere touches down. Otherwise the
  spring acts from the start of that step, and an impact gains or loses up to (π / n)² of its
  energy where it lasts n steps.
- The triangle has two sides and no inside: a sphere is pushed out as long as its centre is above
  the ground, and falls for ever once it is below.

An impact is a spring with a damping that grows with depth, F = k d (1 + c d'/v), where v is the
speed of the impact. Gonthier's law (`impactModel=2`) takes c from a coefficient of
restitution ε, by a formula that fits what comes out to ε within 5e-3. What does come out has a
closed form: with w the speed over v, w dw/(1 + c w) is in proportion to -d dd, whose integral
from w = 1 to w = -e, both at d = 0, vanishes, so that

    c (1 + e) = log((1 + c) / (1 - c e)).

It knows neither mass, stiffness nor speed, so here the ε is found that delivers the scene's e.

The trapezoidal rule adds to it: measured at 0.3 to 8 m/s, of e = 0.9332 impacts that
last 4, 6, 8, 12, 24 and 32 steps deliver 0.944, 0.939, 0.937, 0.935, 0.9335 and 0.9333, within
1e-3 at every speed, and of e = 1 always 1.0000.

Y. Gonthier et al., Multibody System Dynamics 11 (2004), doi:10.1023/B:MUBO.0000029392.21648.bc
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.simulate.claims import ContactLaw

CONTACT_LAW = ContactLaw(
    normal="penalty: a spring, and a damper that grows with depth (Gonthier)",
    restitution="a coefficient of the contact, from 0.01; a linear damper for 0",
    friction="a round cone; in proportion to the slip below a slip speed",
    mixing="none: coefficients belong to the contact",
    adapter="Sphere and triangle contacts, one a sphere, as stiff as makes an impact last a given "
    "number of the finest steps. The coefficient is corrected, in closed form, for what the law "
    "delivers; one of 0 is a damper so strong that nothing rebounds, and one between 0 and 0.01 is "
    "refused. Near the ground steps are divided and end where a sphere touches down. A sphere "
    "with its centre below the ground is a failure, as the triangle has no inside.",
)
"""What contact is in the engine."""
Marker = Callable[[int, Array], str]

# No body gets as far within a trajectory; the ground ends there [m].
_FAR = 1e4
# Slower impacts, of what comes to rest, are damped as if they had this speed [m/s], or the one that
# this acceleration makes within an impact [m/s²]. What rests on stiffer ground trembles faster and
# must be damped in fewer seconds: friction of turning wheels feeds the trembling in every cycle.
_SLOWEST_IMPACT, _SLOWEST_GAIN = 1e-2, 20.0
# How far a sphere may get within a frame, in lengths of its path under gravity alone.
_REACH = 2.0
# Smallest restitution: the law has none of 0, and gets stiff on the way there.
_LEAST = 0.01
# From here to 1 both agree within 1e-9, and the logarithms cancel.
_ELASTIC = 1.0 - 1e-3
_CHANGE = 1.0 / 3.0
_REACHING = """

def outputs(kind):  # of the spheres' centres
    kind = getattr(exu.OutputVariableType, kind)
    return np.array([mbs.GetMarkerOutput(number, kind) for number in spheres])


def gaps():  # heights of the spheres' lowest points
    return outputs("Position")[:, 2] - {radii!r}


def may_touch(duration):  # whether a sphere can get to the ground within a time
    speed = np.maximum(0.0, -outputs("Velocity")[:, 2])
    pull = {gravity!r} + np.sum(outputs("AngularVelocity") ** 2, axis=1) * {arms!r}
    return bool(np.any(gaps() < {reach!r} * duration * (speed + pull * duration)))

"""


@dataclass(frozen=True)
class PenaltyContact:
    """How hard the ground is."""

    duration: float
    """Shortest time that an impact lasts [s]."""
    slip_speed: float
    """Slip from which on friction is Coulomb's [m/s]."""


def contact_listing(mechanism: Mechanism, contact: PenaltyContact, marker: Marker) -> Iterator[str]:
    """Lines that make `spheres`, markers at the centres, and `contacts`, one a sphere.

    Args:
        mechanism: With contact spheres.
        contact: How hard the ground is.
        marker: Writes a marker at a point of a body's native frame.
    """
    ground = mechanism.scene.ground
    assert ground is not None
    if 0.0 < ground.restitution < _LEAST:
        msg = (
            f"exudyn: ground.restitution: got {ground.restitution:g}, allowed is 0, or {_LEAST} to "
            "1: its law of impact gets too stiff to be integrated on the way to 0"
        )
        raise Unsupported(msg)
    corners = [[-2 * _FAR, -_FAR, 0.0], [2 * _FAR, -_FAR, 0.0], [0.0, 2 * _FAR, 0.0]]
    yield f"corners = exu.Vector3DList([np.array(corner) for corner in {corners!r}])"
    yield "plane = mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=ground))"
    yield "spheres, contacts = [], []"
    for k, body in enumerate(mechanism.sphere_body):
        yield f"spheres.append({marker(int(body), mechanism.sphere_offset[k])})"
        # Gap, speed of the slip and of the impact, and one that is not used.
        yield "node = mbs.AddNode(items.NodeGenericData("
        yield "    initialCoordinates=[1.0, 0.0, 0.0, 0.0], numberOfDataCoordinates=4))"
        yield "contacts.append(mbs.AddObject(items.ObjectContactSphereTriangle("
        yield f"    markerNumbers=[spheres[{k}], plane], nodeNumber=node,"
        yield f"    sphereRadius={float(mechanism.sphere_radius[k])!r}, trianglePoints=corners,"
        stiffness = _stiffness(mechanism, k, contact.duration)
        yield f"    contactStiffness={stiffness!r},"
        if ground.restitution:
            # Model 1 misses the restitution.
            yield f"    impactModel=2, restitutionCoefficient={coefficient(ground.restitution)!r},"
            slowest = min(_SLOWEST_IMPACT, _SLOWEST_GAIN * contact.duration)
            yield f"    minimumImpactVelocity={slowest!r},"
        else:
            damping = 2.0 * math.sqrt(stiffness * float(mechanism.mass.sum()))
            yield f"    impactModel=0, contactDamping={damping!r},"
        yield f"    dynamicFriction={ground.friction!r},"
        yield f"    frictionProportionalZone={contact.slip_speed!r}, includeEdges=0)))"
    yield _REACHING.format(
        radii=mechanism.sphere_radius.tolist(),
        arms=np.linalg.norm(mechanism.sphere_offset, axis=-1).tolist(),
        gravity=float(np.linalg.norm(mechanism.scene.gravity)),
        reach=_REACH,
    )


def _stiffness(mechanism: Mechanism, sphere: int, duration: float) -> float:
    """Of a spring on which the sphere's body alone bounces in a time [N/m].

    Joints only add to the mass that a body turns against a push, so impacts last longer.
    """
    body = mechanism.sphere_body[sphere]
    x, y, z = mechanism.sphere_offset[sphere]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turning = cross.T @ np.linalg.solve(mechanism.inertia[body], cross)
    lightest = 1.0 / (1.0 / mechanism.mass[body] + np.linalg.eigvalsh(turning).max())
    return float(lightest * (math.pi / duration) ** 2)


class TouchingSpheres:
    """The contact spheres of a model that is built."""

    def __init__(self, mechanism: Mechanism, names: Mapping[str, Any]) -> None:
        self._mbs, self._contacts = names["mbs"], names["contacts"]
        self._outputs, self._gaps = names["outputs"], names["gaps"]
        self._radius = mechanism.sphere_radius

    def sunk(self) -> bool:
        """Whether the centre of a sphere is in the ground."""
        return bool(np.any(self._gaps() < -self._radius))

    def memory(self) -> Array:
        """What the contacts' nodes hold where they know of no impact, from the state as it is."""
        velocity, spin = self._outputs("Velocity"), self._outputs("AngularVelocity")
        slip_x = velocity[:, 0] - spin[:, 1] * self._radius
        slip_y = velocity[:, 1] + spin[:, 0] * self._radius
        none = np.zeros_like(slip_x)
        return np.stack([self._gaps(), np.hypot(slip_x, slip_y), none, none], axis=-1).ravel()

    def centers(self) -> Array:
        """In W as the model stands [m], shape (sphere, 3)."""
        return np.asarray(self._outputs("Position"))

    def coefficients(self) -> Array:
        """Radius, friction and the restitution that is delivered, shape (sphere, 3)."""
        contacts = [self._mbs.GetObject(number) for number in self._contacts]
        return np.array(
            [
                (
                    contact["sphereRadius"],
                    contact["dynamicFriction"],
                    # Model 0 has a damper alone.
                    delivered(contact["restitutionCoefficient"]) if contact["impactModel"] else 0.0,
                )
                for contact in contacts
            ]
        )


@functools.cache
def coefficient(restitution: float) -> float:
    """Give the ε with which an impact comes back at e times its speed."""
    if restitution >= _ELASTIC:
        return restitution
    damping = _root(lambda c: _rest(c, restitution), 0.5 * (1.0 - restitution), 1.0 / restitution)
    return _root(lambda value: _damping(value) - damping, 0.1 * _LEAST, 1.0)


def delivered(value: float) -> float:
    """Give the restitution that comes of an ε."""
    if value >= _ELASTIC:
        return value
    damping = _damping(value)
    return _root(lambda e: _rest(damping, e), 0.0, min(1.0, 1.0 / damping))


def _damping(value: float) -> float:
    """c of an ε, as Exudyn computes it."""
    if value > _CHANGE:
        return 1.5 * (1.0 - value) * (11.0 - value) / (1.0 + 9.0 * value)
    return (1.0 - value**2) / value


def _rest(damping: float, restitution: float) -> float:
    # Below e for log1p's sake; at c e = 1 the sphere takes for ever to leave.
    left = max(1.0 - damping * restitution, 1e-300)
    return math.log1p(damping) - math.log(left) - damping * (1.0 + restitution)


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    from scipy.optimize import brentq  # takes long to import

    return float(brentq(function, low, high, xtol=1e-15, rtol=1e-14))
