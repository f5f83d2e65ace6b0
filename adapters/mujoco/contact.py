"""Contact spheres on the ground and on each other, and the time until one can touch.

A contact of MuJoCo has a normal row, a spring and damper, and two tangential rows limited by a
friction cone. All are tied to the semi-implicit Euler step h:

- Normal: see `impact_law`. A resting body hardly sinks, whatever the spring, because MuJoCo's
  softness is one of accelerations: a hardness d leaves it 1 − d of gravity. With d near 1 a body on
  several spheres rattles: each bears all or nothing, on either side of a depth of 0, as rounding
  decides. The loads of a car, and with them its friction, then do not converge. With 0.5 they do.
- Tangential: a damping 1/h stops the slip within one step unless friction reaches its cone's edge.
- MuJoCo solves normal and tangential rows as one convex problem, whose solution lifts a body by μ
  times its slip: sliding spheres hop. With `impratio` near 0 the tangential rows are too soft to
  matter there. The `noslip` solver, which keeps the normal forces, then finds friction without any
  softness.

https://mujoco.readthedocs.io/en/stable/computation/index.html

MuJoCo has no coefficient of restitution. The damping of a = −b v − k r is calibrated by repeating
the engine's own steps: a sphere hits the ground at speed 1 at many phases of the step, and the
damping is found that makes its mean rebound speed e. All figures are in units of the step and the
impact speed, so one calibration holds for all speeds, masses and steps, as long as gravity adds
little during an impact.

An impact of a single step needs no calibration: b = (1 + e)/h turns v into −e v at once. But it
settles the normal impulse before friction acts, which is right only where the two do not interact.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np

from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.base.xml import numbers
from mbds_xsim.scene.collisions import Collisions
from mbds_xsim.scene.fixed import fixed_spheres
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism
from mbds_xsim.scene.scene import Ground
from mbds_xsim.simulate.claims import ContactLaw

CONTACT_LAW = ContactLaw(
    normal="soft: a spring and damper on accelerations (solref, solimp), in one convex problem",
    restitution="no coefficient: set by the damper",
    friction="a pyramid or a round cone (elliptic), softened; lifts sliding bodies",
    mixing="the larger friction; explicit pairs state their own",
    adapter="Spheres and ground are explicit pairs with the pair's friction. Native settings do no "
    "more and ignore restitution. Matched settings divide the steps near a contact and calibrate "
    "the damper on the engine's own steps so that it delivers the restitution; the cone is "
    "elliptic, and friction is left to the `noslip` solver, which does not lift sliding bodies. "
    "Friction that it would lose is refused on heavy bodies; where joints leave only one line to "
    "slip along, contact at the start is refused, and a later touch ends the trajectory. If all "
    "bodies are balls, an impact is a single step. Contacts of wheels are half as hard; otherwise "
    "their loads would rattle.",
)

_GROUND = "ground"
HARDEST = 0.9999
"""MuJoCo's hardest contact (the d of solimp)."""
# Softness of the normal row over that of the tangential rows in the cone.
_SOFT_CONE = 1e-9
_NOSLIP_ITERATIONS = 100
# A tighter tolerance uses up all iterations and changes nothing.
_NOSLIP_TOLERANCE = 1e-9
# Safety factor on the path of a sphere within a time, over the straight one.
_REACH = 2.0
_FAR = 1e9  # gap of what cannot touch [m]
# Slower spheres are at rest [m/s].
_TINY = 1e-150
# Stiffness k h² of the spring that lifts a sphere at rest in the ground, if an impact is a single
# step. A rebound gains this share, so it is small.
_LIFT = 1e-5
_PHASES = 400
# A damping of 1 takes the whole velocity in a step.
_STRONGEST = 1.0
_MOST_STEPS = 2000


@dataclass(frozen=True)
class Impact:
    """Duration and hardness of an impact."""

    step: float
    """Step of the semi-implicit Euler method [s]; 0 leaves MuJoCo's default contact."""
    count: int
    """Number of steps that an impact lasts."""
    hardness: float = HARDEST
    """Share of an acceleration into the ground that a contact takes, whatever its depth."""


def add_contacts(
    root: Element, bodies: dict[int, Element], mechanism: Mechanism, impact: Impact
) -> None:
    """Add the plane, the spheres and their pairs; geoms that are in no pair never touch."""
    scene, masks = mechanism.scene, {"contype": "0", "conaffinity": "0"}
    if not scene.contacts:
        return
    if scene.ground is not None:
        # The first geom of the world. A plane is a half-space: nothing gets behind it.
        SubElement(bodies[WORLD_INDEX], "geom", masks, name=_GROUND, type="plane", size="0 0 1")
    contact = SubElement(root, "contact")
    for k, body in enumerate(mechanism.sphere_body):
        SubElement(
            bodies[int(body)],
            "geom",
            masks,
            name=_name(k),
            type="sphere",
            size=repr(float(mechanism.sphere_radius[k])),
            pos=numbers(mechanism.sphere_offset[k]),
        )
        if scene.ground is not None:
            _add_pair(contact, (_GROUND, _name(k)), scene.ground, impact)
    hard = dataclasses.replace(impact, hardness=HARDEST)
    for one, other in mechanism.sphere_pairs.tolist():
        assert scene.collisions is not None
        _add_pair(contact, (_name(one), _name(other)), scene.collisions, hard)


def _add_pair(
    contact: Element, geoms: tuple[str, str], law: Ground | Collisions, impact: Impact
) -> None:
    response = _law(law.restitution, impact) if impact.step else {}
    pair = SubElement(contact, "pair", response, geom1=geoms[0], geom2=geoms[1])
    # Two tangential coefficients; no torsion and rolling in condim 3. A coefficient of 0
    # would be raised to 1e-5.
    pair.set("condim", "3" if law.friction else "1")
    pair.set("friction", numbers((law.friction, law.friction, 0, 0, 0)))


def cone_options(impact: Impact) -> dict[str, str]:
    """Return the engine's options that go with the impact law."""
    if not impact.step:
        return {}
    return {
        # The default is a pyramid, which is not isotropic.
        "cone": "elliptic",
        "impratio": repr(_SOFT_CONE),
        "noslip_iterations": str(_NOSLIP_ITERATIONS),
        "noslip_tolerance": repr(_NOSLIP_TOLERANCE),
    }


class SphereGeoms:
    """The contact spheres of a compiled model."""

    def __init__(self, model: Any, mechanism: Mechanism) -> None:
        names = [_name(k) for k in range(len(mechanism.sphere_body))]
        self._geoms = np.array([model.geom(name).id for name in names], dtype=np.int64)
        self._bodies = model.geom_bodyid[self._geoms]
        # A slice is quicker to take, if there is one.
        contiguous = len(names) > 0 and np.all(np.diff(self._geoms) == 1)
        self._places = slice(self._geoms[0], self._geoms[-1] + 1) if contiguous else self._geoms
        self._roots = model.body_rootid[self._bodies]
        self._radius = model.geom_size[self._geoms, 0].copy()
        self._grounded = mechanism.scene.ground is not None
        # Contact with the ground, whose steps are less accurate, cannot move what is fixed.
        self._lowered = self._radius.copy()
        self._lowered[fixed_spheres(mechanism.scene)] = -_FAR
        self._one, self._other = mechanism.sphere_pairs.T
        self._reach = self._radius[self._one] + self._radius[self._other]
        self._gravity, self._load = model.opt.gravity.tolist(), 0.0
        self.free = not (mechanism.joints or mechanism.distances or mechanism.springs)
        from_com = np.linalg.norm(
            model.geom_pos[self._geoms] - model.body_ipos[self._bodies], axis=1
        )
        self._carriers = [
            (int(body), int(model.body_rootid[body]), float(from_com[self._bodies == body].max()))
            for body in np.unique(self._bodies)
        ]

    def set_load(self, model: Any, force: Array) -> None:
        """Allow for held forces on MuJoCo's bodies without the world [N], shape (…, body, 3)."""
        pulls = np.linalg.norm(force, axis=-1) / model.body_mass[1:]
        self._load = float(pulls.max(initial=0.0))

    def gaps(self, model: Any, data: Any) -> tuple[Array, float]:
        """Return the gaps of spheres to the ground, if any, then of pairs [m]; and the smallest.

        Brings positions up to date.
        """
        mujoco.mj_kinematics(model, data)
        gap = data.geom_xpos[self._places, 2] - self._lowered
        if len(self._one):
            centre = data.geom_xpos[self._places]
            separation = centre[self._one] - centre[self._other]
            pair_gap = np.sqrt(np.vecdot(separation, separation)) - self._reach
            gap = np.concatenate([gap, pair_gap]) if self._grounded else pair_gap
        return gap, float(np.minimum.reduce(gap))

    def time_aloft(
        self, model: Any, data: Any, gap: Array, low: float, least: float, enough: float
    ) -> float:
        """Return a time in which no sphere can reach the ground or another [s].

        It is 0 if the time is less than `least`. If a rough lower bound is `enough`, that is
        returned.
        """
        # The lowest sphere alone mostly decides; at rest, even without its speed.
        factor = 2.0 if len(self._one) else 1.0
        pull = math.hypot(*self._gravity) + factor * self._load
        if low < _REACH * least * pull * least:
            return 0.0
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        lowest = int(gap.argmin())
        speed = self._speed(data, lowest)
        if low < _REACH * least * (speed + pull * least):
            return 0.0
        pull = pull if self.free else max(pull, factor * self._bend(model, data))
        fastest = self._fastest(data) * factor
        if (rough := _time(low, fastest, pull)) >= enough:
            return rough
        first = _time(low, speed, pull)
        # A gap wider than the fastest possible path until then cannot close before the lowest.
        others = np.flatnonzero(gap < _REACH * first * (fastest + pull * first)).tolist()
        times = (_time(float(gap[k]), self._speed(data, k), pull) for k in others if k != lowest)
        return min([first, *times])

    def _bend(self, model: Any, data: Any) -> float:
        """Return a bound on spheres' accelerations under present joint and drive loads [m/s²]."""
        mujoco.mj_forward(model, data)
        mujoco.mj_rnePostConstraint(model, data)
        pulls = []
        for body, root, reach in self._carriers:
            p, q, r, u, v, w = data.cvel[body].tolist()
            a, b, c, x, y, z = data.cacc[body].tolist()  # relative to free fall: -g at rest
            x, y, z = (value + g for value, g in zip((x, y, z), self._gravity, strict=True))
            arm = reach + math.dist(data.xipos[body].tolist(), data.subtree_com[root].tolist())
            spin = math.hypot(p, q, r)
            along = math.hypot(x, y, z) + math.hypot(a, b, c) * arm
            pulls.append(along + spin * (math.hypot(u, v, w) + spin * arm))
        return max(pulls)

    def _fastest(self, data: Any) -> float:
        """Return a bound on the speed of all spheres [m/s]."""
        speeds = []
        for body, root, reach in self._carriers:
            p, q, r, u, v, w = data.cvel[body].tolist()
            arm = reach + math.dist(data.xipos[body].tolist(), data.subtree_com[root].tolist())
            speeds.append(math.hypot(u, v, w) + math.hypot(p, q, r) * arm)
        return max(speeds)

    def _speed(self, data: Any, gap: int) -> float:
        """Return a bound on the speed at which a gap closes [m/s]."""
        if (pair := gap - self._grounded * len(self._geoms)) < 0:
            return self._own_speed(data, gap)
        ends = (self._one[pair], self._other[pair])
        return sum(self._own_speed(data, int(sphere)) for sphere in ends)

    def _own_speed(self, data: Any, sphere: int) -> float:
        p, q, r, u, v, w = data.cvel[self._bodies[sphere]].tolist()
        x, y, z = data.geom_xpos[self._geoms[sphere]].tolist()
        a, b, c = data.subtree_com[self._roots[sphere]].tolist()
        x, y, z = x - a, y - b, z - c
        return math.hypot(u + q * z - r * y, v + r * x - p * z, w + p * y - q * x)

    def trees(self, near: Mask) -> Index:
        """Return the root bodies of all that takes part in some of the `gaps`."""
        count = self._grounded * len(self._roots)
        of_pairs = [self._roots[ends][near[count:]] for ends in (self._one, self._other)]
        return np.concatenate([self._roots[near[:count]] if count else [], *of_pairs])

    def geoms(self, spheres: tuple[int, ...]) -> frozenset[int]:
        """Return the geoms of two spheres, or of one and the ground, which is the first of all."""
        return frozenset([*self._geoms[list(spheres)].tolist(), 0][:2])

    def readback(self, model: Any, data: Any) -> dict[str, Array]:
        """Return the fields of `Readback` on contact; restitution, which MuJoCo lacks, is NaN."""
        friction = np.where(model.pair_dim == 1, 0.0, model.pair_friction[:, 0])
        count = len(friction) - len(self._one)
        on_ground = friction[:count] if count else np.full(len(self._radius), np.nan)
        between = friction[count:]
        return {
            "contact": np.stack(
                [self._radius, on_ground, np.full_like(on_ground, np.nan)], axis=-1
            ),
            "collision": np.stack([between, np.full_like(between, np.nan)], axis=-1),
            "sphere": np.array(data.geom_xpos[self._geoms]),
        }


def _law(restitution: float, impact: Impact) -> dict[str, str]:
    law, h = impact_law(restitution, impact.count), impact.step
    return {
        "solref": numbers((-law.stiffness / h**2, -law.damping / h)),
        # The noslip solver has no softness, so the row's softness is taken out of its damping.
        "solreffriction": numbers((0.0, -impact.hardness / h)),
        "solimp": f"{impact.hardness} {impact.hardness} 0.001 0.5 2",
    }


def _time(gap: float, speed: float, pull: float) -> float:
    """Solve gap = _REACH (speed time + pull time²) for the time."""
    path = gap * (2.0 / _REACH)
    rate = speed + math.sqrt(speed**2 + 2.0 * pull * path)
    return path / max(rate, _TINY)


def _name(k: int) -> str:
    return f"contact sphere {k}"


def stop_law(restitution: float, step: float) -> dict[str, str]:
    """Return attributes for a joint's stop with a rebound in one step of semi-implicit Euler.

    Without restitution, RK4 takes the velocity within some steps. Only gears interact with a
    coordinate's stop, so a single step is right.
    """
    return {
        "solref": numbers((-_LIFT / step**2, -(1.0 + restitution) / step)),
        "solimp": f"{HARDEST} {HARDEST} 0.001 0.5 2",
    }


@dataclass(frozen=True)
class ImpactLaw:
    """Spring and damper of a contact, for a step of 1 and a mass of 1."""

    stiffness: float
    """Stiffness k h²."""
    damping: float
    """Damping b h."""


@functools.cache
def impact_law(restitution: float, steps: int) -> ImpactLaw:
    """Return the law of an impact that lasts `steps` steps.

    A restitution too small for any damper in so many steps gets an impact of one step.
    """
    if steps > 1:
        from scipy.optimize import brentq  # takes long to import

        stiffness = (math.pi / steps) ** 2

        def excess(damping: float) -> float:
            return float(rebounds(ImpactLaw(stiffness, damping)).mean()) - restitution

        # Below 0, as the damping of an elastic impact is close to 0.
        weakest = -0.5 * math.sqrt(stiffness)
        if excess(_STRONGEST) < 0.0:
            return ImpactLaw(stiffness, float(brentq(excess, weakest, _STRONGEST, xtol=1e-12)))
    return ImpactLaw(_LIFT, 1.0 + restitution)


def rebounds(law: ImpactLaw) -> Array:
    """Return speeds after impacts at speed 1 that begin at evenly spread phases of a step."""
    height = -(np.arange(_PHASES) + 0.5) / _PHASES
    speed = np.full(_PHASES, -1.0)
    for _ in range(_MOST_STEPS):
        inside = height < 0.0
        if not inside.any():
            break
        # The ground only pushes; it never holds back a sphere that leaves it.
        push = np.maximum(0.0, -law.damping * speed - law.stiffness * height)
        speed = np.where(inside, speed + push, speed)
        height = np.where(inside, height + speed, height)
    return speed
