"""Does contact create energy, and do bodies at rest on the ground stay there?

A rigid impact changes the kinetic energy by the sum over its contacts of p·(u⁻ + u⁺)/2, with p the
impulse and u the velocities of the contact point. By Newton's restitution the normal part of it is
−(1 − e) p |u⁻|/2. In the tangential part p·u⁺ is never positive, as friction opposes the slip it
leaves; but p·u⁻ may be, if the coupling in an eccentric impact reverses the slip. Newton's
and Coulomb's laws together are then not passive (Kane & Levinson 1985, Dynamics; Brach 1989,
J. Appl. Mech. 56, 133), and an engine that follows them gains energy, too.
"""

from __future__ import annotations

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.collisions import pairs_of_balls
from mbds_xsim.checks.conservation import energy_of, input_work
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.ground import Impacts, Push, balls_of, impacts_of, pushes_of
from mbds_xsim.checks.joint_work import losses
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.fixed import fixed_spheres

_SLOW = 1e-3  # share of the speed √(g · length)
_NEAR = 1e-3  # share of the scene's length
_SAFE = 0.9  # share of the friction that is needed at most
_ROUND = 0.95 * np.pi  # widest angle between spheres that surround a point
# Times the declared duration and the arriving speed. A spring of that duration needs ½; joined
# bodies make it last up to 2.6 times as long (measured).
_LONGEST = 2.0
_LASTING = 4.0  # factor by which a steady gap counts more than that of an impact


@check("passivity", "passivity")
def passivity(record: Record) -> Figures | None:
    """Measure the rise of E − W that the law of impact does not explain, over the energy scale.

    W is the work of inputs, and of dampers, dry friction and servos, whose error is the finding's
    uncertainty. The rise is above the running minimum, among frames in which no contact stores
    energy. None without contact, or if something else supports a body that may touch.
    """
    scene, pushes = record.scene, _all_pushes(record)
    if not scene.contacts or (scene.ground is not None and not pushes):
        return None
    gain = sum((law_gain(record, push) for push in pushes), _collision_gain(record))
    explained = np.cumsum(gain, axis=1)
    share = np.nan_to_num(explained[:, -1] / energy_of(record).scale)
    note = f"impacts may add up to {share.max():.2g} of the scale by their own law"
    return _rise(record, pushes, explained)._replace(note=note if share.any() else "")


@check("energy rise", None)
def energy_rise(record: Record) -> Figures | None:
    """Show the whole rise of E − W, explained or not; None if the law of impact explains none."""
    pushes = _all_pushes(record)
    if all(push.ball for push in pushes):
        return None
    return _rise(record, pushes, np.zeros((1, record.steps)))


def law_gain(record: Record, push: Push) -> Array:
    """Return the energy that impacts may add by their own law [J], shape (trajectory, step).

    For a single impact between two frames in flight it follows from the slip on arrival and the
    impulse. If more may have happened in a step, it is bounded by the fastest slip: that of the
    step's ends, plus what turning about a body's centre of mass adds in between.
    """
    gain = np.zeros(push.impulse.shape[:2])
    if push.ball:
        return gain
    ground, slip = record.ground, np.linalg.norm(push.over.slip, axis=-1)
    slip = slip + record.frame * _veering(record, push)
    fastest = np.where(push.reach, np.maximum(slip[:, 1:], slip[:, :-1]), 0.0).max(axis=2)
    unclear = push.reach.any(axis=2) & ~push.steady
    most = 0.5 * ground.friction * np.maximum(push.impulse[..., 2], 0.0) * fastest
    gain[unclear] = most[unclear]
    hits = impacts_of(record, push)
    forward = np.sum(hits.impulse[:, :2] * hits.slip, axis=1)
    loss = (1.0 - ground.restitution) * hits.impulse[:, 2] * hits.arriving
    gain[hits.row, hits.step] = 0.5 * np.maximum(forward - loss, 0.0)
    return np.asarray(np.nan_to_num(gain))


def _veering(record: Record, push: Push) -> Array:
    """Compute |ω × (ω × r)| of spheres' centres [m/s²], shape (trajectory, frame, sphere)."""
    mechanism, own = record.mechanism, push.spheres
    body = mechanism.sphere_body[own]
    speed = record.bodies.speeds(body, mechanism.sphere_offset[own])
    swing = np.linalg.norm(speed - record.bodies.velocity[:, :, body], axis=-1)
    return np.asarray(swing * np.linalg.norm(record.bodies.angular_velocity[:, :, body], axis=-1))


def _collision_gain(record: Record) -> Array:
    """Return the energy that collisions may add by their own law [J], shape (trajectory, step).

    Collisions of balls, or without friction, add none. Others, whose slip may reverse as in an
    eccentric impact, may add any energy in a step in which the bodies may touch.
    """
    mechanism, collisions = record.mechanism, record.scene.collisions
    gain = np.zeros(record.moved.shape[:2])
    central = pairs_of_balls(mechanism)
    others = [k for k in range(len(mechanism.sphere_pairs)) if k not in central]
    if collisions is None or not collisions.friction or not others:
        return gain
    met = ~record.parted[..., others].all(axis=2)
    balance = _balance(record)
    gain[met] = np.maximum(np.diff(balance, axis=1), 0.0)[met]
    return np.asarray(np.nan_to_num(gain))


def _balance(record: Record) -> Array:
    """Return E − W: energy less the work of all but contact [J], shape (trajectory, frame)."""
    return energy_of(record).total - input_work(record) + losses(record)[0]


def _all_pushes(record: Record) -> list[Push]:
    """Return the groups with contact, or none if the ground's impulse on one is not known."""
    pushes = pushes_of(record)
    known = sum(len(push.spheres) for push in pushes) + len(fixed_spheres(record.scene))
    return pushes if known == len(record.mechanism.sphere_body) else []


def _rise(record: Record, pushes: list[Push], explained: Array) -> Figures:
    """Measure the relative rise above the running minimum, NaN if not compared."""
    scale, balance = energy_of(record).scale, _balance(record)
    balance[:, 1:] -= explained
    compared, most = record.finite.copy(), balance.copy()
    for push in pushes:
        compared &= settled(push)
        most += stored(record, push)
    compared[:, 1:] &= (record.neighbours.gap[:, 1:] > 0.0).all(axis=2)
    rise, error = risen(balance, most, compared), losses(record)[1].sum(axis=1)
    return Figures((rise / scale[:, None])[..., None], uncertainty=error / scale)


def risen(least: Array, most: Array, compared: Mask) -> Array:
    """Compute the rise of the lower bound `least` above the running minimum of the upper, `most`.

    Contacts may store the energy in between. Shape (trajectory, frame), NaN where not compared.
    """
    lowest = np.minimum.accumulate(np.where(compared, most, np.inf), axis=1)
    rise = np.where(compared, np.maximum(least - lowest, 0.0), np.nan)
    rise[:, 0] = 0.0
    return np.asarray(rise)


def settled(push: Push) -> Mask:
    """Find frames at which a group's contacts store no more than `stored`, (trajectory, frame).

    These are frames in flight, frames around which the ground only carries, and the start, whose
    overlaps are given. Even a slow impact stores the energy it arrives with.
    """
    quiet = push.untouched | push.resting
    quiet[:, 0] = True
    return np.asarray(quiet)


def stored(record: Record, push: Push) -> Array:
    """Return the most energy stored under the weight [J]: weight · overlap, (trajectory, frame)."""
    return np.asarray(push.mass * record.pull * np.maximum(-push.over.gap.min(axis=2), 0.0))


@check("hop", "passivity")
def hop(record: Record) -> Figures | None:
    """Measure how high balls get by themselves, over the scene's length; None without balls.

    A ball's vertical motion is not coupled to its other motions, so its vertical kinetic and
    potential energy less the work of vertical forces must not rise above its running minimum, as in
    `passivity`.
    """
    pushes, length, pull = balls_of(record), record.scene.length, -record.scene.gravity[2]
    if pull <= 0.0:
        return None
    climb = record.bodies.velocity[..., 2]
    rises = record.by_frame([_hop(record, push, pull) for push in pushes])
    # Semi-implicit Euler conserves v²/2 + g z + g h v/2.
    step = 0.0 if record.order > 1 else record.frame if record.step is None else record.step
    fastest = np.nanmax(np.abs(climb), axis=(1, 2), initial=0.0)
    names, uncertainty = [push.name for push in pushes], 0.5 * step * fastest / length
    return Figures(rises / length, names, uncertainty=uncertainty)


@check("resting", "resting")
def resting(record: Record) -> Figures | None:
    """Measure how far bodies move that were at rest, over the scene's length.

    A body is at rest if it hardly moves over a step, and three or more touching spheres surround
    the point where its load meets the ground. It must stay there as long as the inputs do not
    change and friction holds the load safely. With bodies joined to it, they must keep their places
    on it, and no torques may act. None without contact, if no group has all its spheres on one
    body, or with inputs that always change.
    """
    if not record.steps:
        return None
    carrier = record.mechanism.sphere_body
    pushes = [
        push
        for push in pushes_of(record)
        if len(push.spheres) >= 3 and len(set(carrier[push.spheres].tolist())) == 1
    ]
    moved = record.by_frame([_moved(record, push) for push in pushes])
    if np.isnan(moved).all():
        return None
    moved[:, 0] = np.nan_to_num(moved[:, 0])  # not every trajectory comes to rest
    return Figures(moved / record.scene.length, [push.name for push in pushes])


def _hop(record: Record, push: Push, pull: float) -> Array:
    """Compute the height that vertical energy gains [m], shape (trajectory, frame)."""
    body = push.bodies[0]
    height, climb = record.bodies.position[:, :, body, 2], record.bodies.velocity[:, :, body, 2]
    lift = record.batch.force[:, : record.steps, body, 2] / push.mass
    work = np.cumsum(lift * np.diff(height, axis=1), axis=1)
    energy = 0.5 * climb**2 + pull * height
    energy[:, 1:] -= work
    most = energy + stored(record, push) / push.mass
    return risen(energy, most, record.finite & settled(push)) / pull


def _moved(record: Record, push: Push) -> Array:
    """Compute the largest displacement of spheres since they came to rest [m], NaN without rest."""
    same, held = _same_inputs(record), _held(record, push)
    still = _still(record, push)
    places, layout = _places(record, push), _layout(record, push)
    displacement = np.full(record.finite.shape, np.nan)
    for row in range(len(displacement)):
        origin: int | None = None
        for frame in range(1, record.steps + 1):
            if not (same[row, frame - 1] and held[row, frame - 1]):
                origin = None
            if origin is not None:
                shifted = np.abs(layout[row, frame] - layout[row, origin]).max()
                origin = None if shifted > _NEAR * record.scene.length else origin
            if origin is not None:
                moved = np.abs(places[row, frame] - places[row, origin]).max()
                displacement[row, frame] = moved
            elif still[row, frame] and still[row, frame - 1] and held[row, frame - 1]:
                origin = frame
    return displacement


def _same_inputs(record: Record) -> Mask:
    """Return whether a step has the inputs of the one before, shape (trajectory, step)."""
    force, torque = (values[:, : record.steps] for values in (record.batch.force, record.torque))
    changed = np.zeros(force.shape[:2], dtype=bool)
    changed[:, 1:] = (np.diff(force, axis=1) != 0.0).any(axis=(2, 3))
    changed[:, 1:] |= (np.diff(torque, axis=1) != 0.0).any(axis=2)
    return ~changed


def _load(record: Record, push: Push) -> Array:
    """Return the sum of gravity and held forces on a group [N], shape (trajectory, step, 3)."""
    weight = push.mass * np.array(record.scene.gravity)
    return np.asarray(record.force[:, :, list(push.bodies)].sum(axis=2) + weight)


def _held(record: Record, push: Push) -> Mask:
    """Find steps in which friction holds a group's load safely, (trajectory, step).

    Torques may move the bodies of a group on each other, and with them the load.
    """
    load = _load(record, push)
    across = np.hypot(load[..., 0], load[..., 1])
    held = across < _SAFE * record.ground.friction * -load[..., 2]
    if len(push.bodies) > 1:
        held &= ~(record.torque[:, : record.steps] != 0.0).any(axis=2)
    return np.asarray(held)


def _layout(record: Record, push: Push) -> Array:
    """Return the places of a group's bodies on the one that has its spheres [m], as of bodies."""
    base, group = int(record.mechanism.sphere_body[push.spheres[0]]), list(push.bodies)
    bodies = record.bodies
    apart = bodies.position[:, :, group] - bodies.position[:, :, [base]]
    return rotation.rotate(rotation.conjugate(bodies.native[:, :, [base]]), apart)


def _still(record: Record, push: Push) -> Mask:
    """Find frames in which a group hardly moves on a support that carries it safely."""
    scene, bodies = record.scene, list(push.bodies)
    speed = np.linalg.norm(record.bodies.velocity[:, :, bodies], axis=-1)
    spin = np.linalg.norm(record.bodies.angular_velocity[:, :, bodies], axis=-1)
    unit = np.sqrt(record.pull * scene.length)
    slow = (speed + spin * scene.length).max(axis=2) < _SLOW * unit
    return np.asarray(slow & push.resting & _carried(record, push))


def _carried(record: Record, push: Push) -> Mask:
    """Return whether touching spheres surround the load, with one in every half-plane.

    The load acts at the centre of mass and leans towards the ground.
    """
    middle = push.middle(record.bodies.position)
    load = _load(record, push)
    load = np.concatenate([load[:, :1], load], axis=1)  # of the step before each frame
    lean = middle[..., 2:] * load[..., :2] / np.maximum(-load[..., 2:], np.finfo(float).tiny)
    arm = _places(record, push)[..., :2] - (middle[..., :2] + lean)[:, :, None]
    touching = np.abs(push.over.gap) < _NEAR * record.scene.length
    count = touching.sum(axis=2)
    # Spheres that do not touch repeat the first one that does.
    angle = np.arctan2(arm[..., 1], arm[..., 0])
    first = np.take_along_axis(angle, touching.argmax(axis=2)[..., None], axis=2)
    angle = np.sort(np.where(touching, angle, first), axis=2)
    round_again = 2 * np.pi + angle[:, :, 0] - angle[:, :, -1]
    widest = np.maximum(np.diff(angle, axis=2).max(axis=2), round_again)
    return np.asarray((count >= 3) & (widest < _ROUND))


def _places(record: Record, push: Push) -> Array:
    """Return centres of the group's contact spheres [m], shape (trajectory, frame, sphere, 3)."""
    mechanism, own = record.mechanism, push.spheres
    return record.bodies.points(mechanism.sphere_body[own], mechanism.sphere_offset[own])


@check("penetration", "penetration", of_positions=True)
def penetration(record: Record) -> Figures:
    """Measure the deepest overlap of a contact sphere with what it may touch, over the length.

    Only recorded frames count; an impact may go deeper between them. None without contact.
    """
    mechanism, names = record.mechanism, [sphere.body for sphere in record.scene.contacts]
    gaps, radii = [record.neighbours.gap], [mechanism.sphere_radius[mechanism.sphere_pairs].min(1)]
    pairs = [f"{names[one]} and {names[other]}" for one, other in mechanism.sphere_pairs]
    if record.scene.ground is not None:
        free = np.setdiff1d(np.arange(len(names)), fixed_spheres(record.scene))
        gaps = [record.spheres.gap[..., free], *gaps]
        radii = [mechanism.sphere_radius[free], *radii]
        pairs = [*(names[k] for k in free), *pairs]
    overlap = np.maximum(-np.concatenate(gaps, axis=2), 0.0)
    share = np.nanmax(overlap / np.concatenate(radii), initial=0.0)
    return Figures(overlap / record.scene.length, pairs, f"{share:.2g} of a radius")


@check("contact gap", "contact_gap")
def contact_gap(record: Record) -> Figures:
    """Measure how far spheres are from the ground that carries them, over the scene's length.

    At frames where the ground carries a steady weight it is the gap of the lowest sphere or, if
    larger, four times the least gap of this and the two adjacent frames. In a single impact it is
    the gap at which the motions before and after it meet. In eccentric impacts a depth below the
    ground that the declared contact time explains does not count, and no depth counts without a
    declared time. None without contact.
    """
    pushes = pushes_of(record)
    gaps = record.by_frame([_gaps(record, push) for push in pushes])
    return Figures(gaps / record.scene.length, [push.name for push in pushes])


def _gaps(record: Record, push: Push) -> Array:
    """Return distances from the ground where known [m], NaN elsewhere, (trajectory, frame)."""
    gap = push.over.gap.min(axis=2)
    gaps = np.where(push.resting, np.abs(gap), np.nan)
    # A gap that stays shows where the ground is; a gap in one frame may be a hop.
    around = np.minimum(np.minimum(gaps[:, :-2], gaps[:, 1:-1]), gaps[:, 2:])
    gaps[:, 1:-1] = np.fmax(gaps[:, 1:-1], _LASTING * around)
    hits = impacts_of(record, push)
    gaps[hits.row, hits.step + 1] = np.abs(hits.gap) if push.ball else _off(record, hits)
    gaps[:, 0] = np.nan_to_num(gaps[:, 0])  # not every trajectory touches
    return np.asarray(gaps)


def _off(record: Record, hits: Impacts) -> Array:
    """Return the distance from the ground that soft contact cannot explain [m], one per impact."""
    if record.contact_time is None:
        return np.maximum(hits.gap, 0.0)
    return np.maximum(hits.gap, -hits.gap - _LONGEST * record.contact_time * hits.arriving)
