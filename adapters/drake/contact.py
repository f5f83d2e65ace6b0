"""Spheres on the ground: the calls that build them, and the spring that yields a restitution.

Drake has no coefficient of restitution: the ground is a spring with Hunt and Crossley's damper,
k d (1 − c v), whose rebound depends on speed. Measured on 1.51, in plants that step themselves:

- The spring acts by its length at the step's end. Even without a damper this costs speed, the same
  share at every speed: an impact of n steps has a restitution of exp(−π² / 2n). From 22 steps on
  this does not depend on where in a step the impact begins.
- With c = 1000 s/m nothing rebounds faster than 1 mm/s.
- Drake's default solver (SAP) stops at a residual of 1e-6 of the momentum, whatever the step. A
  ball that rolls at 10 m/s is 14 mm off in 4 s at steps of 63 µs and 33 mm at 16 µs. TAMSI, which
  supports no constraints, converges: 2.6 mm at 63 µs, 0.7 mm at 31 µs, in a quarter of the time.

https://drake.mit.edu/doxygen_cxx/group__contact__engineering.html
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.simulate.claims import ContactLaw

CONTACT_LAW = ContactLaw(
    normal="compliant: a spring and damper, evaluated at the end of the step",
    restitution="no coefficient: set by the damper (Hunt and Crossley) and the steps per impact",
    friction="a round cone; slip below 0.1 mm/s is not stopped",
    mixing="the harmonic mean of frictions, stiffnesses in series",
    adapter="Spheres and ground carry the pair's friction. Native settings do no more and ignore "
    "restitution. Matched settings use no damper: the stiffness is chosen so that an impact lasts "
    "just as many implicit steps as reduce the speed by the restitution. For restitution 0 the "
    "damper absorbs the whole impact. Contact is solved by TAMSI, as the tolerance of Drake's "
    "default solver, relative to the momentum, is too coarse for fast bodies.",
)

OWN_TIME = math.pi * math.sqrt(1e-3 / 9.81)
"""Half a period of Drake's own spring, which a body's weight compresses by 1 mm [s]."""
STICTION = 1e-4
"""Drake's default of the slip below which its friction is less than Coulomb's [m/s]."""
LEAST_REBOUND, MOST_REBOUND = 0.8, 0.98
"""Range of restitutions that hold wherever an impact begins and do not take too many steps."""
_DEAD_STEPS, _DEAD = 10.0, 1e3
_STATEMENTS = """\
plant.set_contact_model(ContactModel.kPoint)


def add_geometry(body, place, shape, name, **material):
    surface = ProximityProperties()
    surface.AddProperty("material", "coulomb_friction", CoulombFriction({friction}, {friction}))
    for key, value in material.items():
        surface.AddProperty("material", key, value)
    pose = RigidTransform(np.array(place))
    return plant.RegisterCollisionGeometry(body, pose, shape, name, surface)

"""
_TAMSI = "plant.set_discrete_contact_approximation(DiscreteContactApproximation.kTamsi)"


def steps_of_impact(restitution: float) -> float:
    """Return the number of steps that an impact with this restitution takes."""
    if restitution == 0.0:
        return _DEAD_STEPS
    return -(math.pi**2) / 2.0 / math.log(min(restitution, MOST_REBOUND))


def contact_lines(mechanism: Mechanism, step: float, count: float) -> Iterator[str]:
    """Yield the lines that add the ground and the spheres.

    Args:
        mechanism: Mechanism of the scene.
        step: Step of the plant [s].
        count: Number of steps that an impact takes; 0 for Drake's own material and solver.
    """
    ground = mechanism.scene.ground
    if ground is None:
        return
    yield _STATEMENTS.format(friction=ground.friction)
    surfaces = [""] * (1 + len(mechanism.sphere_body))
    if count:
        yield _TAMSI
        stiffness = mechanism.mass[mechanism.sphere_body] * (math.pi / count / step) ** 2
        # In series with the ground's, so that each pair gets the stiffness of its own sphere.
        hard = 2.0 * float(stiffness.max())
        damper = f"hunt_crossley_dissipation={0.0 if ground.restitution else _DEAD}"
        surfaces = [
            f", point_contact_stiffness={float(k)!r}, {damper}"
            for k in (hard, *(stiffness * hard / (hard - stiffness)))
        ]
    yield f'add_geometry(world, (0, 0, 0), HalfSpace(), "ground"{surfaces[0]})'
    yield "spheres = []"
    for k, body in enumerate(mechanism.sphere_body.tolist()):
        shape = f"Sphere({float(mechanism.sphere_radius[k])!r})"
        args = f'bodies[{body}], {mechanism.sphere_offset[k].tolist()}, {shape}, "sphere {k}"'
        yield f"spheres.append(add_geometry({args}{surfaces[k + 1]}))"
    yield "among = CollisionFilterDeclaration().ExcludeWithin(GeometrySet(spheres))"
    yield "scene_graph.collision_filter_manager().Apply(among)"
