"""Where the ground is, and whether what lies on it stays on it, and where it came to rest."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.finding import Figures, Record, check
from mbds_xsim.checks.ground import Push, balls_of, pushes_of
from mbds_xsim.checks.impacts import Impacts, impacts_of
from mbds_xsim.checks.passivity import risen, settled, stored

_SLOW = 1e-3  # of the speed √(g · length)
_NEAR = 1e-3  # of the scene's length
_ROUND = 0.95 * np.pi  # widest angle between spheres that surround a point
# Times the declared duration and the arriving speed. Half of it is what a spring makes that lasts
# as long; joined bodies make one last longer, measured up to 2.6 times.
_LONGEST = 2.0
_LASTING = 4.0  # how much sharper than in impacts it is known where the ground is that carries


@check("hop", "passivity")
def hop(record: Record) -> Figures | None:
    """Measure how high balls get by themselves, over the scene's length; None without balls.

    Nothing couples the vertical motion of a ball to the other ones, so that its energy of climb
    and height less the work of vertical forces never rises: above the running minimum, as in
    `passivity`.
    """
    pushes, length, pull = balls_of(record), record.scene.length, -record.scene.gravity[2]
    if pull <= 0.0:
        return None
    climb = record.bodies.velocity[..., 2]
    rises = record.by_frame([_rise(record, push, pull) for push in pushes])
    # Semi-implicit Euler keeps v²/2 + g z + g h v/2.
    step = 0.0 if record.order > 1 else record.frame if record.step is None else record.step
    fastest = np.nanmax(np.abs(climb), axis=(1, 2), initial=0.0)
    names, uncertainty = [push.name for push in pushes], 0.5 * step * fastest / length
    return Figures(rises / length, names, uncertainty=uncertainty)


@check("resting", "resting")
def resting(record: Record) -> Figures | None:
    """Measure how far bodies move that were at rest, over the scene's length.

    At rest is what three spheres or more carry, around the centre of mass, and what hardly moves
    over a step; it has to stay as long as the inputs stay as they are. None without contact, or
    with inputs that always change.
    """
    pushes = [push for push in pushes_of(record) if len(push.spheres) >= 3]
    moved = record.by_frame([_moved(record, push) for push in pushes])
    if np.isnan(moved).all():
        return None
    moved[:, 0] = np.nan_to_num(moved[:, 0])  # not every trajectory comes to rest
    return Figures(moved / record.scene.length, [push.name for push in pushes])


def _rise(record: Record, push: Push, pull: float) -> Array:
    """Height that the energy of climb and height gains [m], shape (trajectory, frame)."""
    body = push.bodies[0]
    height, climb = record.bodies.position[:, :, body, 2], record.bodies.velocity[:, :, body, 2]
    lift = record.batch.force[:, : record.steps, body, 2] / push.mass
    work = np.cumsum(lift * np.diff(height, axis=1), axis=1)
    energy = 0.5 * climb**2 + pull * height
    energy[:, 1:] -= work
    most = energy + stored(record, push) / push.mass
    return risen(energy, most, record.finite & settled(push)) / pull


def _moved(record: Record, push: Push) -> Array:
    """Largest displacement of spheres since they came to rest [m], NaN where there is no rest."""
    same = _same_inputs(record)
    still = _still(record, push)
    places = _places(record, push)
    found = np.full(record.finite.shape, np.nan)
    for row in range(len(found)):
        held: Array | None = None
        for frame in range(1, record.steps + 1):
            if not same[row, frame - 1]:
                held = None
            if held is not None:
                found[row, frame] = np.abs(places[row, frame] - held).max()
            elif still[row, frame] and still[row, frame - 1]:
                held = places[row, frame]
    return found


def _same_inputs(record: Record) -> Mask:
    """Tell whether a step has the inputs of the one before, shape (trajectory, step)."""
    force, torque = (
        values[:, : record.steps] for values in (record.batch.force, record.batch.torque)
    )
    changed = np.zeros(force.shape[:2], dtype=bool)
    changed[:, 1:] = (np.diff(force, axis=1) != 0.0).any(axis=(2, 3))
    changed[:, 1:] |= (np.diff(torque, axis=1) != 0.0).any(axis=2)
    return ~changed


def _still(record: Record, push: Push) -> Mask:
    """Frames in which a group hardly moves on a support that carries it safely."""
    scene, bodies = record.scene, list(push.bodies)
    speed = np.linalg.norm(record.bodies.velocity[:, :, bodies], axis=-1)
    spin = np.linalg.norm(record.bodies.angular_velocity[:, :, bodies], axis=-1)
    unit = np.sqrt(record.pull * scene.length)
    slow = (speed + spin * scene.length).max(axis=2) < _SLOW * unit
    return np.asarray(slow & push.resting & _carried(record, push))


def _carried(record: Record, push: Push) -> Mask:
    """Whether touching spheres surround the centre of mass: no half of the plane is without one."""
    middle = push.middle(record.bodies.position)
    arm = _places(record, push)[..., :2] - middle[:, :, None, :2]
    touching = np.abs(push.over.gap) < _NEAR * record.scene.length
    count = touching.sum(axis=2)
    # Those that do not touch repeat the first one that does.
    angle = np.arctan2(arm[..., 1], arm[..., 0])
    first = np.take_along_axis(angle, touching.argmax(axis=2)[..., None], axis=2)
    angle = np.sort(np.where(touching, angle, first), axis=2)
    round_again = 2 * np.pi + angle[:, :, 0] - angle[:, :, -1]
    widest = np.maximum(np.diff(angle, axis=2).max(axis=2), round_again)
    return np.asarray((count >= 3) & (widest < _ROUND))


def _places(record: Record, push: Push) -> Array:
    """Centres of the group's contact spheres [m], shape (trajectory, frame, sphere, 3)."""
    mechanism, own = record.mechanism, push.spheres
    return record.bodies.points(mechanism.sphere_body[own], mechanism.sphere_offset[own])


@check("penetration", "penetration")
def penetration(record: Record) -> Figures:
    """Measure the deepest overlap of a contact sphere with the ground over the scene's length.

    Of recorded frames: an impact may go deeper between them. None without contact.
    """
    overlap = np.maximum(-record.spheres.gap, 0.0)
    share = np.nanmax(overlap / record.mechanism.sphere_radius, initial=0.0)
    names = [sphere.body for sphere in record.scene.contacts]
    return Figures(overlap / record.scene.length, names, f"{share:.2g} of a radius")


@check("contact gap", "contact_gap")
def contact_gap(record: Record) -> Figures:
    """Measure how far spheres are from the ground that carries them, over the scene's length.

    At frames where the ground carries a steady weight it is the gap of the lowest sphere, four
    times that where it stays for three of them; in a
    single impact the gap at which the motions before and after it meet. Of those beside the centre
    of mass, what the declared time of contact explains is left out below the ground, and all of it
    where none is declared. None without contact.
    """
    pushes = pushes_of(record)
    gaps = record.by_frame([_gaps(record, push) for push in pushes])
    return Figures(gaps / record.scene.length, [push.name for push in pushes])


def _gaps(record: Record, push: Push) -> Array:
    """Distances where they are known [m], NaN elsewhere, shape (trajectory, frame)."""
    gap = push.over.gap.min(axis=2)
    found = np.where(push.resting, np.abs(gap), np.nan)
    # A gap that stays is where the ground is; one of a frame may be a hop.
    around = np.minimum(np.minimum(found[:, :-2], found[:, 1:-1]), found[:, 2:])
    found[:, 1:-1] = np.fmax(found[:, 1:-1], _LASTING * around)
    hits = impacts_of(record, push)
    found[hits.row, hits.step + 1] = np.abs(hits.gap) if push.ball else _off(record, hits)
    found[:, 0] = np.nan_to_num(found[:, 0])  # not every trajectory touches
    return np.asarray(found)


def _off(record: Record, hits: Impacts) -> Array:
    """Distance from the ground at which a soft contact cannot meet [m], one an impact."""
    if record.contact_time is None:
        return np.maximum(hits.gap, 0.0)
    return np.maximum(hits.gap, -hits.gap - _LONGEST * record.contact_time * hits.arriving)
