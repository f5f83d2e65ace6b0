"""Impacts off the centre of mass: two laws for them, one of which may add energy."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.optimize import brentq

from mbds_xsim.base.arrays import Array
from mbds_xsim.checks import Finding, Record
from mbds_xsim.checks.eccentric import (
    ImpactEvidence,
    Pool,
    eccentric_friction,
    eccentric_restitution,
    impact_coefficients,
)
from mbds_xsim.checks.ground import impacts_of, pushes_of
from mbds_xsim.checks.passivity import contact_gap, energy_rise, passivity
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import Throw
from mbds_xsim.scene.scene import Body, Clock, ContactSphere, Ground, Inertia, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.simulate.timed import simulate

RK4 = load_adapter("mujoco").methods["RK4"]
OFFSET, RADIUS, MOMENT, GRAVITY = np.array([0.2, -0.1]), 0.02, 0.02, 9.81
PART = 1e-3  # step over the time unit of a spring


def _club(friction: float = 0.43, restitution: float = 0.9332) -> Scene:
    """Make a body in the x–z plane with one contact sphere beside its centre of mass."""
    x, z = OFFSET.tolist()
    spans = ((0.0, 0.0), (0.0, 0.0), (0.0, 0.3))
    return Scene(
        name="club",
        dimension=2,
        bodies=(Body("club", inertia=Inertia(1.0, (MOMENT,) * 3), position=(0.0, 0.0, 0.4)),),
        contacts=(ContactSphere("club", (x, 0.0, 0.4 + z), RADIUS),),
        ground=Ground(friction, restitution),
        length=0.4,
        clock=Clock(0.02, 20),
        sampling=(
            Throw(
                "club",
                displacement=spans,
                orientation="about_y",
                velocity=((-2.0, 2.0), (0.0, 0.0), (-2.0, 0.0)),
                angular_velocity=((0.0, 0.0), (-8.0, 8.0), (0.0, 0.0)),
            ),
        ),
    )


@dataclasses.dataclass(frozen=True)
class _State:
    """State of planar motion: place and velocity (x, z), angle and rate about y."""

    place: Array
    velocity: Array
    angle: float
    rate: float

    def later(self, t: float) -> _State:
        pull = np.array([0.0, -GRAVITY])
        place = self.place + t * self.velocity + 0.5 * t**2 * pull
        angle = self.angle + t * self.rate
        return _State(place, self.velocity + t * pull, angle, self.rate)

    @property
    def lever(self) -> Array:
        """Vector from the centre of mass to the sphere's lowest point."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.array([[c, s], [-s, c]]) @ OFFSET - [0.0, RADIUS]

    @property
    def gap(self) -> float:
        return float(self.place[1] + self.lever[1])

    @property
    def speed(self) -> Array:
        """Velocity of the lowest point."""
        x, z = self.lever
        return np.asarray(self.velocity + self.rate * np.array([z, -x]))

    def hit(self, friction: float, restitution: float) -> _State:
        """Bounce by Newton's and Coulomb's laws: stick, or slip with friction against it."""
        x, z = self.lever
        give = np.eye(2) + np.outer([z, -x], [z, -x]) / MOMENT
        goal = -self.speed - [0.0, restitution * self.speed[1]]
        impulse = np.linalg.solve(give, goal)
        if abs(impulse[0]) > friction * impulse[1]:
            for sense in (1.0, -1.0):
                along = np.array([-sense * friction, 1.0])
                impulse = along * goal[1] / (give[1] @ along)
                if sense * (self.speed + give @ impulse)[0] >= 0.0:
                    break
        return self._struck(impulse)

    def press(self, friction: float, restitution: float) -> _State:
        """Bounce on a spring that pushes e² as hard on its way back, with friction all along."""
        x, z = self.lever
        give = np.eye(2) + np.outer([z, -x], [z, -x]) / MOMENT
        speed, total, depth = self.speed, np.zeros(2), 0.0
        while depth >= 0.0:
            depth -= PART * speed[1]
            push = PART * max(depth, 0.0) * (1.0 if speed[1] < 0.0 else restitution**2)
            across = -(speed[0] + give[0, 1] * push) / give[0, 0]
            impulse = np.array([np.clip(across, -friction * push, friction * push), push])
            speed, total = speed + give @ impulse, total + impulse
        return self._struck(total)

    def _struck(self, impulse: Array) -> _State:
        x, z = self.lever
        rate = self.rate + (z * impulse[0] - x * impulse[1]) / MOMENT
        return _State(self.place, self.velocity + impulse, self.angle, rate)


Law = Callable[[_State, float, float], _State]


def _frame_later(state: _State, law: Law, friction: float, restitution: float) -> _State:
    rest = 0.02
    while rest > 0.0:
        times = np.linspace(1e-9, rest, 20)
        below = [t for t in times if state.later(t).gap < 0.0]
        if not below:
            return state.later(rest)
        hit = brentq(lambda t, s=state: s.later(t).gap, 1e-12, below[0], xtol=1e-15)
        state, rest = law(state.later(hit), friction, restitution), rest - hit
    return state


def _thrown(
    scene: Scene, friction: float, restitution: float, law: Law, count: int
) -> tuple[Batch, Trajectory]:
    """Follow clubs through impacts on a ground that need not be the scene's."""
    batch = draw_batch(scene, range(count))
    motion = Trajectory.empty(np.linspace(0.0, 0.4, 21), len(batch), 1)
    for row in range(len(batch)):
        w, _, y, _ = batch.orientation[row, 0]
        place, velocity = batch.position[row, 0, ::2], batch.velocity[row, 0, ::2]
        angle, rate = 2 * float(np.arctan2(y, w)), float(batch.angular_velocity[row, 0, 1])
        state = _State(place, velocity, angle, rate)
        for frame in range(21):
            if frame:
                state = _frame_later(state, law, friction, restitution)
            half = 0.5 * state.angle
            motion.position[row, frame, 0] = [state.place[0], 0.0, state.place[1]]
            motion.velocity[row, frame, 0] = [state.velocity[0], 0.0, state.velocity[1]]
            motion.orientation[row, frame, 0] = [np.cos(half), 0.0, np.sin(half), 0.0]
            motion.angular_velocity[row, frame, 0] = [0.0, state.rate, 0.0]
    return batch, motion


def _record(
    friction: float = 0.43, restitution: float = 0.9332, delivered: float | None = None
) -> Record:
    scene = _club(friction, restitution)
    delivered = restitution if delivered is None else delivered
    return Record(scene, *_thrown(scene, friction, delivered, _State.hit, 60), RK4)


def _bounced(law: Law, friction: float = 0.43, restitution: float = 0.9332) -> Record:
    """Throw some clubs on a ground that the scene may not have."""
    scene = _club()
    return Record(scene, *_thrown(scene, friction, restitution, law, 15), RK4)


@pytest.fixture(scope="module")
def lawful() -> Record:
    return _record()


def _figures(record: Record) -> tuple[Array, Array]:
    unexplained, whole = passivity.finding(record), energy_rise.finding(record)
    return unexplained.figure, whole.figure


def test_what_the_law_of_impact_adds_is_explained(lawful: Record) -> None:
    unexplained, whole = _figures(lawful)

    assert (whole > 1e-2).sum() >= 5
    assert unexplained.max() < 1e-9


@pytest.mark.parametrize("ground", [(0.43, 0.6), (0.0, 0.9332)])
def test_less_restitution_or_no_friction_adds_nothing(ground: tuple[float, float]) -> None:
    unexplained, whole = _figures(_record(*ground))

    assert whole.max() < 1e-9
    assert unexplained.max() < 1e-9


@pytest.mark.parametrize("delivered", [1.0, 1.1])
def test_more_than_the_law_adds_is_not_explained(delivered: float) -> None:
    unexplained, whole = _figures(_record(delivered=delivered))
    rises = whole > 1e-3

    assert rises.sum() >= 20
    assert (unexplained[rises] > 1e-3).all()


@pytest.mark.parametrize(("law", "known"), [(_State.hit, 1e-6), (_State.press, 5e-3)])
def test_impacts_keep_to_either_law(law: Law, known: float) -> None:
    restitution, friction = _eccentric(_bounced(law))

    assert restitution.figure.max() < known
    assert friction.figure.max() < known
    assert "the scene has 0.9332" in restitution.note
    (counts,) = re.findall(r"; (\d+) of (\d+) impacts by the rigid law", restitution.note)
    rigid, impacts = map(int, counts)
    assert rigid == impacts if law is _State.hit else rigid < impacts / 2


def test_springs_do_not_keep_to_newtons_law() -> None:
    record = _bounced(_State.press)
    (push,) = pushes_of(record)
    hits = impacts_of(record, push)

    assert np.abs(hits.leaving / hits.arriving - 0.9332).max() > 0.05


@pytest.mark.parametrize("law", [_State.hit, _State.press])
def test_another_restitution_of_eccentric_impacts_shows(law: Law) -> None:
    restitution, _ = _eccentric(_bounced(law, restitution=1.0))

    assert not restitution.passed.all()
    assert restitution.figure.max() == pytest.approx(1.0 - 0.9332, abs=5e-3)


@pytest.mark.parametrize("law", [_State.hit, _State.press])
def test_eccentric_impacts_that_rebound_little_pass(law: Law) -> None:
    scene = _club(restitution=0.6)
    record = Record(scene, *_thrown(scene, 0.43, 0.6, law, 15), RK4, 1e-4, contact_time=1e-4)

    assert eccentric_restitution.finding(record).passed.all()


@pytest.mark.parametrize("law", [_State.hit, _State.press])
@pytest.mark.parametrize("taken", [0.185, 0.0])
def test_another_friction_of_eccentric_impacts_shows(law: Law, taken: float) -> None:
    _, friction = _eccentric(_bounced(law, friction=taken))

    assert not friction.passed.all()
    assert friction.figure.max() <= 1.0 - taken / 0.43 + 5e-3


@pytest.mark.parametrize("law", [_State.hit, _State.press])
def test_impacts_together_tell_a_coefficient_that_none_of_them_tells(law: Law) -> None:
    """A single impact's budgets allow errors of 0.033 in restitution or of a sixth in friction."""
    bounced = _bounced(law, restitution=0.90)
    records = _bounced(law), bounced, _bounced(law, friction=0.37)
    sound, lively, rough = map(impact_coefficients.finding, records)

    assert sound.figure.max() < 0.1
    assert _eccentric(bounced)[0].passed.all()
    assert not lively.passed.any()
    assert set(lively.where) == {"restitution"}
    assert not rough.passed.any()
    assert set(rough.where) == {"friction"}


def test_few_impacts_tell_no_coefficient(lawful: Record) -> None:
    few = dataclasses.replace(
        lawful, batch=lawful.batch[:3], trajectory=lawful.trajectory[slice(0, 3)]
    )
    assert impact_coefficients(few) is None


def test_an_impact_that_a_law_cannot_follow_is_left_out() -> None:
    restitution, ones = np.full((2, 9), 0.001), np.ones((2, 9))
    restitution[1, 4] = np.nan
    pool = Pool.of(ImpactEvidence(restitution, ones, 0.0 * ones, ones))

    assert pool is not None
    assert pool.impacts == 8
    assert pool.restitution == pytest.approx(0.001)


def _eccentric(record: Record) -> tuple[Finding, Finding]:
    return eccentric_restitution.finding(record), eccentric_friction.finding(record)


def test_a_sphere_that_sinks_further_than_its_contact_lasts_shows(lawful: Record) -> None:
    """A sphere that is 2 mm larger in the scene than in the motion hits 2 mm below the ground."""
    (sphere,) = lawful.scene.contacts
    other = msgspec.structs.replace(sphere, radius=RADIUS + 2e-3)
    larger = dataclasses.replace(
        lawful, scene=msgspec.structs.replace(lawful.scene, contacts=(other,))
    )
    unknown, rigid, soft = (
        contact_gap.finding(dataclasses.replace(larger, contact_time=time))
        for time in (None, 1e-5, 1e-2)
    )

    assert unknown.passed.all()
    assert rigid.figure.max() * lawful.scene.length == pytest.approx(2e-3, rel=0.02)
    assert not rigid.passed.all()
    assert soft.passed.all()


def test_impacts_are_taken_apart_exactly(lawful: Record) -> None:
    (push,) = pushes_of(lawful)
    hits = impacts_of(lawful, push)

    assert len(hits.row) > 50
    assert hits.leaving / hits.arriving == pytest.approx(0.9332, abs=1e-6)
    assert np.abs(hits.gap).max() < 1e-7


def test_beside_dry_friction_and_stops_that_may_act_no_impact_is_taken_apart() -> None:
    """The contact-free motions that lead to an impact know neither friction nor stops."""
    pytest.importorskip("mujoco")
    scene = msgspec.structs.replace(load_scene("simplecubli"), clock=Clock(0.02, 60))
    batch = draw_batch(scene, range(3), noise=False)
    settings = settings_for(scene, load_adapter("mujoco"), "matched")
    trajectory = simulate(scene, batch, "mujoco", settings).trajectory

    def impacts(**law: Any) -> set[tuple[int, int]]:
        joints = tuple(msgspec.structs.replace(joint, **law) for joint in scene.joints)
        record = Record(msgspec.structs.replace(scene, joints=joints), batch, trajectory, RK4)
        (push,) = pushes_of(record)
        hits = impacts_of(record, push)
        return set(zip(hits.row.tolist(), hits.step.tolist(), strict=True))

    free = impacts()
    assert len(free) >= 3
    assert impacts(limits=(-1e3, 1e3)) == free
    assert impacts(friction=0.1) == set()
    assert impacts(limits=(-1.0, 1.0)) < free


def test_an_impact_of_two_spheres_is_no_single_one(lawful: Record) -> None:
    """Where another sphere may touch in the same step, the law's gain is a bound."""
    (sphere,) = lawful.scene.contacts
    twin = msgspec.structs.replace(sphere, center=(0.2, 0.1, sphere.center[2]))
    scene = msgspec.structs.replace(lawful.scene, contacts=(sphere, twin))
    twins = dataclasses.replace(lawful, scene=scene)
    (push,) = pushes_of(twins)

    assert len(impacts_of(twins, push).row) == 0
    unexplained, _ = _figures(twins)
    assert unexplained.max() < 1e-9
