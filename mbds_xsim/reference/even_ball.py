"""A ball whose spin a friction force changes alike in every direction that occurs.

So it is with three equal moments of inertia; or in the x–z plane, where only the moment about y
counts. Everything but the orientation under a turning axis of rotation is in closed form.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.reference.ball import STILL, BallContact, BallState, Load, flown
from mbds_xsim.reference.sliding import Sliding, slide
from mbds_xsim.reference.turning import turned

_Law = Callable[[float], Sliding]


@dataclass(frozen=True, slots=True)
class EvenBall:
    """Laws of motion of such a ball."""

    contact: BallContact
    inertia: float
    """[kg·m²]"""

    @property
    def yielding(self) -> float:
        """Slip that a tangential impulse gives the lowest point [1/kg]."""
        return 1.0 / self.contact.mass + self.contact.radius**2 / self.inertia

    def fly(self, motion: BallState, load: Load, duration: float) -> BallState:
        """Move without contact: a parabola, at a constant spin."""
        turn = _turned_by(motion.turn, motion.spin * duration, motion.twist * duration)
        return dataclasses.replace(flown(motion, load, duration), turn=turn)

    def hit(self, motion: BallState) -> BallState:
        """Bounce: friction takes all the slip, or as much as μ times the normal impulse can."""
        slip, most = self.contact.slip(motion), self.contact.friction * self.contact.impulse(motion)
        stick = abs(slip) <= most * self.yielding
        braked = slip if stick else most * self.yielding * slip / abs(slip)
        return dataclasses.replace(self._braked(motion, braked), climb=self.contact.rebound(motion))

    def keep_contact(self, motion: BallState, load: Load, limit: float) -> tuple[float, BallState]:
        """Slide until the slip stops, or roll while friction can hold against the loads."""
        slip = self.contact.slip(motion)
        brake = self.contact.friction * self.contact.mass * -load.lift * self.yielding
        if abs(slip) <= STILL:
            slip = 0j
        if slip or abs(load.push) > brake:
            law: _Law = functools.partial(slide, slip, load.push, brake)
        else:
            law = _no_slide
        part = law(limit)
        return part.duration, self._carried(motion, load, slip, part, law)

    def _carried(
        self, motion: BallState, load: Load, slip: complex, part: Sliding, law: _Law
    ) -> BallState:
        """Follow the centre of mass and the spin along a slip that is known."""
        t = part.duration
        lost = t * (slip + 0.5 * t * load.push) - part.travelled
        moved = flown(motion, Load(load.push, 0.0), t)
        moved = self._braked(moved, slip + t * load.push - part.slip)
        place = moved.place - lost / (self.contact.mass * self.yielding)

        def spin(at: float) -> complex:
            return motion.spin + self._lever() * (slip + at * load.push - law(at).slip)

        turn = _rolled(motion, spin, self._lever() * lost, t)
        return dataclasses.replace(moved, place=place, turn=turn)

    def _braked(self, motion: BallState, slip: complex) -> BallState:
        """Take away some slip by a tangential impulse."""
        share = self.contact.mass * self.yielding
        return dataclasses.replace(
            motion,
            velocity=motion.velocity - slip / share,
            spin=motion.spin + self._lever() * slip,
        )

    def _lever(self) -> complex:
        return 1j * self.contact.radius / (self.inertia * self.yielding)


def _no_slide(limit: float) -> Sliding:
    return Sliding(limit, 0j, 0j)


def _rolled(
    motion: BallState, spin: Callable[[float], complex], gained: complex, t: float
) -> Array:
    """Turn by a spin whose integral is known, which is all where its axis keeps its direction."""
    if not gained or (motion.twist == 0.0 and (motion.spin * gained.conjugate()).imag == 0.0):
        return _turned_by(motion.turn, motion.spin * t + gained, motion.twist * t)
    return turned(motion.turn, lambda at: _vector(spin(at), motion.twist), t)


def _turned_by(turn: Array, angle: complex, twist: float) -> Array:
    return rotation.multiply(rotation.from_vector(_vector(angle, twist)), turn)


def _vector(plane: complex, up: float) -> Array:
    return np.array([plane.real, plane.imag, up])
