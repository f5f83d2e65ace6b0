"""Exudyn's penalty contacts of spheres with each other and with the ground, one large triangle.

- Normal: a spring so stiff that an impact lasts a given number of the finest steps, and the damping
  explained below. A resting body sinks by its weight over the stiffness. The law has no restitution
  of 0. There a linear damper takes its place, critical for the mass of all bodies: lighter ones
  creep back to the surface, and nothing rebounds.
- Tangential: Coulomb's friction against the slip, isotropic; below `slip_speed` it is
  proportional to the slip.
- The solver may shorten a step so that it ends where a sphere touches down. Otherwise the spring
  would act from the start of that step, and an impact of n steps would gain or lose up to (π / n)²
  of its energy.
- The triangle has two sides and no inside: a sphere is pushed out as long as its centre is above
  the ground, and falls for ever once it is below.

An impact is a spring with a damping that grows with depth, F = k d (1 + c d'/v), where v is the
speed of the impact. Gonthier's law (`impactModel=2`) computes c from a coefficient of restitution
ε, by a formula whose actual restitution e agrees with ε within 5e-3. There is a closed form for e:
with w the speed over v, w dw/(1 + c w) is proportional to -d dd, whose integral from w = 1 to
w = -e, both at d = 0, vanishes, so that

    c (1 + e) = log((1 + c) / (1 - c e)).

It depends on neither mass, stiffness nor speed, so the adapter solves for the ε that delivers the
scene's e. The trapezoidal rule adds an error: measured at 0.3 to 8 m/s for e = 0.9332, impacts of
4, 6, 8, 12, 24 and 32 steps deliver 0.944, 0.939, 0.937, 0.935, 0.9335 and 0.9333, within 1e-3 at
every speed; for e = 1 they always deliver 1.0000.

Y. Gonthier et al., Multibody System Dynamics 11 (2004), doi:10.1023/B:MUBO.0000029392.21648.bc
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.simulate.claims import ContactLaw, ContactScales

CONTACT_LAW = ContactLaw(
    normal="penalty: a spring, and a damper that grows with depth (Gonthier)",
    restitution="a coefficient of the contact, from 0.01; a linear damper for 0",
    friction="a round cone; proportional to the slip below a given slip speed",
    mixing="none: coefficients belong to the contact",
    adapter="Each sphere meets the ground as a triangle, and other spheres directly. The stiffness "
    "makes an impact last a given number of the shortest steps. The coefficient is corrected in "
    "closed form so that the law delivers the restitution; for 0 a damper prevents any rebound, "
    "and values between 0 and 0.01 are refused. Near a contact, steps are divided so that one ends "
    "at the first touch. A sphere whose centre is below the ground or inside another sphere is a "
    "failure.",
)
Marker = Callable[[int, Array], str]

# Extent of the ground [m]; no body gets that far within a trajectory.
_FAR = 1e4
# Slower impacts, of bodies that come to rest, are damped as if they had this speed [m/s] or, if it
# is lower, the one that this acceleration makes within an impact [m/s²]. A body on stiffer ground
# chatters faster and must be damped sooner: friction of turning wheels feeds the chatter in every
# cycle.
_SLOWEST_IMPACT, _SLOWEST_GAIN = 1e-2, 20.0
# Safety factor on the path of a sphere within a frame, and on its acceleration in the last one.
_REACH = 2.0
# Smallest restitution other than 0: towards 0 the law gets ever stiffer.
_LEAST = 0.01
# From here to 1, ε and e agree within 1e-9, and the logarithms cancel.
_ELASTIC = 1.0 - 1e-3
_CHANGE = 1.0 / 3.0  # ε at which Exudyn's formula for c changes
_TOUCH_TEST = """

def outputs(kind):  # of the spheres' centres
    kind = getattr(exu.OutputVariableType, kind)
    return np.array([mbs.GetMarkerOutput(number, kind) for number in spheres])


radii, arms = np.array({radii!r}), np.array({arms!r})
one, other = np.array({pairs!r}, dtype=int).reshape(-1, 2).T
grounded = np.arange({grounded})  # spheres that may touch the ground
driven = [0.0]  # largest of the held forces over the masses
before = [None]  # velocities of the spheres a frame ago, where springs or drives pull


def gaps():  # of the spheres and the ground, then of two spheres
    place = outputs("Position")
    apart = np.linalg.norm(place[one] - place[other], axis=1)
    return np.append((place[:, 2] - radii)[grounded], apart - radii[one] - radii[other])


def may_touch(duration):  # whether a sphere can get to the ground or another within a time
    velocity = outputs("Velocity")
    pull = {gravity!r} + driven[0] + np.sum(outputs("AngularVelocity") ** 2, axis=1) * arms
    if {sprung}:
        last, before[0] = before[0], velocity
        if last is None:
            return True
        pull = np.maximum(pull, {reach!r} * np.linalg.norm(velocity - last, axis=1) / duration)
    speed = np.linalg.norm(velocity[one] - velocity[other], axis=1)
    speed = np.append(np.maximum(0.0, -velocity[grounded, 2]), speed)
    pull = np.append(pull[grounded], pull[one] + pull[other])
    return bool(np.any(gaps() < {reach!r} * duration * (speed + pull * duration)))

"""


def contact_listing(mechanism: Mechanism, scales: ContactScales, marker: Marker) -> Iterator[str]:
    """Yield lines that make `spheres`, markers at centres, and `contacts`, in the order of `gaps`.

    Args:
        mechanism: A mechanism with contact spheres.
        scales: Shortest duration of an impact, and slip above which friction is Coulomb's.
        marker: Function that writes a marker at a point of a body's native frame.
    """
    scene, radius = mechanism.scene, mechanism.sphere_radius.tolist()
    yield "spheres, contacts = [], []"
    for k, body in enumerate(mechanism.sphere_body):
        yield f"spheres.append({marker(int(body), mechanism.sphere_offset[k])})"
    if scene.ground is not None:
        corners = [[-2 * _FAR, -_FAR, 0.0], [2 * _FAR, -_FAR, 0.0], [0.0, 2 * _FAR, 0.0]]
        yield f"corners = exu.Vector3DList([np.array(corner) for corner in {corners!r}])"
        yield "plane = mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=ground))"
    for k in range(len(radius)) if scene.ground else ():
        yield from _contact("Triangle", f"spheres[{k}], plane")
        yield f"    sphereRadius={radius[k]!r}, trianglePoints=corners, includeEdges=0,"
        yield from _law("ground", mechanism, [k], scales)
    for pair in mechanism.sphere_pairs.tolist():
        yield from _contact("Sphere", ", ".join(f"spheres[{k}]" for k in pair))
        yield f"    spheresRadii={[radius[k] for k in pair]!r},"
        yield from _law("collisions", mechanism, pair, scales)
    yield _TOUCH_TEST.format(
        radii=radius,
        pairs=mechanism.sphere_pairs.tolist(),
        grounded=len(radius) if scene.ground else 0,
        arms=np.linalg.norm(mechanism.sphere_offset, axis=-1).tolist(),
        gravity=float(np.linalg.norm(scene.gravity)),
        sprung=bool(mechanism.springs or scene.servos or mechanism.compliant),
        reach=_REACH,
    )


def _contact(kind: str, markers: str) -> Iterator[str]:
    # Data of a contact: gap, slip speed, impact speed, and a number that is not used.
    yield "node = mbs.AddNode(items.NodeGenericData("
    yield "    initialCoordinates=[1.0, 0.0, 0.0, 0.0], numberOfDataCoordinates=4))"
    yield f"contacts.append(mbs.AddObject(items.ObjectContactSphere{kind}("
    yield f"    markerNumbers=[{markers}], nodeNumber=node,"


def _law(
    where: str, mechanism: Mechanism, spheres: list[int], scales: ContactScales
) -> Iterator[str]:
    """Yield the lines with the coefficients of a contact of one sphere or two."""
    law = getattr(mechanism.scene, where)
    if 0.0 < law.restitution < _LEAST:
        raise Unsupported(
            f"exudyn: {where}.restitution: got {law.restitution:g}, allowed is 0, or {_LEAST} to "
            "1: close to 0 its impact law is too stiff to integrate"
        )
    # On this spring the spheres' bodies alone bounce within `duration`. Joints only add to a body's
    # effective mass, so impacts last longer with them.
    yielding = sum(_inverse_mass(mechanism, sphere) for sphere in spheres)
    stiffness = (math.pi / scales.time) ** 2 / yielding
    yield f"    contactStiffness={stiffness!r},"
    if law.restitution:
        # `impactModel=1` would miss the restitution.
        yield f"    impactModel=2, restitutionCoefficient={coefficient(law.restitution)!r},"
        slowest = min(_SLOWEST_IMPACT, _SLOWEST_GAIN * scales.time)
        yield f"    minimumImpactVelocity={slowest!r},"
    else:
        damping = 2.0 * math.sqrt(stiffness * float(mechanism.mass.sum()))
        yield f"    impactModel=0, contactDamping={damping!r},"
    yield f"    dynamicFriction={law.friction!r},"
    yield f"    frictionProportionalZone={scales.slip!r})))"


def _inverse_mass(mechanism: Mechanism, sphere: int) -> float:
    """Return the largest inverse effective mass of a sphere's body alone, at its centre [1/kg]."""
    body = mechanism.sphere_body[sphere]
    x, y, z = mechanism.sphere_offset[sphere]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turning = cross.T @ np.linalg.solve(mechanism.inertia[body], cross)
    return float(1.0 / mechanism.mass[body] + np.linalg.eigvalsh(turning).max())


class TouchingSpheres:
    """The contact spheres of a built model."""

    def __init__(self, mechanism: Mechanism, names: Mapping[str, Any]) -> None:
        self._mbs, self._contacts = names["mbs"], names["contacts"]
        self._outputs, self._gaps = names["outputs"], names["gaps"]
        self._radius, self._pairs = mechanism.sphere_radius, mechanism.sphere_pairs
        self._grounded = len(self._radius) if mechanism.scene.ground else 0
        least = self._radius[self._pairs].min(axis=1)
        self._deepest = -np.append(self._radius[: self._grounded], least)

    def has_penetration(self) -> bool:
        """Return whether a sphere's centre is in the ground or in another sphere."""
        return bool(np.any(self._gaps() < self._deepest))

    def memory(self) -> Array:
        """Return the data of contacts in the present state, with no impact under way."""
        velocity, spin = self._outputs("Velocity"), self._outputs("AngularVelocity")
        slip_x = velocity[:, 0] - spin[:, 1] * self._radius
        slip_y = velocity[:, 1] + spin[:, 0] * self._radius
        place, (one, other) = self._outputs("Position"), self._pairs.T
        normal = place[one] - place[other]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        turning = spin * self._radius[:, None]
        slip = velocity[one] - velocity[other] - np.cross(turning[one] + turning[other], normal)
        slip -= np.vecdot(slip, normal)[:, None] * normal
        slips = np.hypot(slip_x, slip_y)[: self._grounded]
        slips = np.append(slips, np.linalg.norm(slip, axis=1))
        zeros = np.zeros_like(slips)
        return np.stack([self._gaps(), slips, zeros, zeros], axis=-1).ravel()

    def readback(self) -> dict[str, Array]:
        """Return the fields of `Readback` on contact, with the restitution that is delivered."""
        contacts = [self._mbs.GetObject(number) for number in self._contacts]
        laws = np.array([_coefficients(contact) for contact in contacts]).reshape(-1, 2)
        count, radii = self._grounded, self._radius
        on_ground = np.full((len(radii), 2), np.nan)
        if count:
            radii = np.array([contact["sphereRadius"] for contact in contacts[:count]])
            on_ground = laws[:count]
        return {
            "contact": np.column_stack([radii, on_ground]),
            "collision": laws[count:],
            "sphere": np.asarray(self._outputs("Position")),
        }


def _coefficients(contact: Mapping[str, Any]) -> tuple[float, float]:
    # `impactModel=0` is a linear damper alone.
    restitution = (
        delivered_restitution(contact["restitutionCoefficient"]) if contact["impactModel"] else 0.0
    )
    return contact["dynamicFriction"], restitution


@functools.cache
def coefficient(restitution: float) -> float:
    """Return the ε with which an impact delivers a restitution e."""
    if restitution >= _ELASTIC:
        return restitution
    damping = _root(lambda c: _excess(c, restitution), 0.5 * (1.0 - restitution), 1.0 / restitution)
    return _root(lambda value: _damping(value) - damping, 0.1 * _LEAST, 1.0)


def delivered_restitution(value: float) -> float:
    """Return the restitution that an ε delivers."""
    if value >= _ELASTIC:
        return value
    damping = _damping(value)
    return _root(lambda e: _excess(damping, e), 0.0, min(1.0, 1.0 / damping))


def _damping(value: float) -> float:
    """Return the c of an ε, as Exudyn computes it."""
    if value > _CHANGE:
        return 1.5 * (1.0 - value) * (11.0 - value) / (1.0 + 9.0 * value)
    return (1.0 - value**2) / value


def _excess(damping: float, restitution: float) -> float:
    # Kept above 0 for the logarithm; at c e = 1 the sphere never separates.
    remaining = max(1.0 - damping * restitution, 1e-300)
    return math.log1p(damping) - math.log(remaining) - damping * (1.0 + restitution)


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    from scipy.optimize import brentq  # takes long to import

    if function(low) * function(high) > 0.0:  # it lies nearer to the end than rounding shows
        return high
    return float(brentq(function, low, high, xtol=1e-15, rtol=1e-14))
