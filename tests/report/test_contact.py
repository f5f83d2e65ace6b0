"""Contact on pages, against motions whose contact is known in closed form."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import subprocess
from importlib import resources

import msgspec
import numpy as np
import pytest

from mbds_xsim.base.arrays import Array
from mbds_xsim.measure.result import EnsembleResult
from mbds_xsim.report import themed
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.studies.validate import figures, words
from mbds_xsim.studies.validate.motion import contact_of, contacts_of, tables

from .conftest import Case, Fake, make_case
from .test_page import numbers, viewer, written

ROWS, STEPS, FRAME = 3, 200, 0.02
TIME: Array = FRAME * np.arange(STEPS + 1, dtype=np.float64)
PULL = 9.81
LESS = 0.9
HEIGHTS = (0.5, 1.1, 1.7)
"""Height of the lowest point at the start, one per trajectory [m]."""


@pytest.fixture(scope="module")
def disc() -> Scene:
    return registry.load_scene("balldrop")


@pytest.fixture(scope="module")
def ball() -> Scene:
    return registry.load_scene("ballscroll")


def bounce(height: float, restitution: float, time: Array = TIME) -> tuple[Array, Array]:
    """Return height and rate of the lowest point of a body dropped from rest."""
    hit = float(np.sqrt(2 * height / PULL))
    gap, climb = height - PULL * time**2 / 2, -PULL * time
    start, speed = hit, restitution * PULL * hit
    while start < time[-1]:
        since = time - start
        after = since >= 0
        gap = np.where(after, speed * since - PULL * since**2 / 2, gap)
        climb = np.where(after, speed - PULL * since, climb)
        start, speed = start + 2 * speed / PULL, restitution * speed
    return gap, climb


def motion(scene: Scene, gap: Array, velocity: Array, spin: Array | float = 0.0) -> Trajectory:
    """Move a single body: gap (row, frame), velocity (row, frame, 3), spin about y."""
    mechanism = Mechanism.of(scene)
    shape = (*gap.shape, 1)
    position = np.zeros((*shape, 3))
    position[..., 0, 2] = gap + mechanism.sphere_radius[0] - mechanism.sphere_offset[0, 2]
    turning = np.zeros((*shape, 3))
    turning[..., 0, 1] = spin
    upright = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (*shape, 4)).copy()
    return Trajectory(
        TIME[: gap.shape[1]],
        position,
        mechanism.body_orientation(upright),
        velocity[:, :, None, :],
        turning,
        (None,) * len(gap),
    )


def dropped(scene: Scene, restitution: float) -> Trajectory:
    gaps, climbs = zip(*(bounce(height, restitution) for height in HEIGHTS), strict=True)
    climb = np.array(climbs)
    velocity = np.stack([0 * climb, 0 * climb, climb], axis=-1)
    return motion(scene, np.array(gaps), velocity)


def of(scene: Scene) -> float:
    assert scene.ground is not None
    return scene.ground.restitution


@pytest.fixture(scope="module")
def bouncing(disc: Scene) -> Case:
    """The reference bounces as the scene says, one engine bounces less, one is gone."""
    fakes = (Fake("mujoco"), Fake("pybullet", crashed=True), Fake("dart"))
    case = make_case(disc, fakes, frames=STEPS + 1)
    exact = dropped(disc, of(disc))
    evidence = dataclasses.replace(
        case.evidence, reference=exact, trajectories=(dropped(disc, LESS), None, exact)
    )
    return Case(case.validation, evidence)


def _until(case: Case, *known: float | None) -> Case:
    """Let the reference be known up to these times only."""
    reference = case.validation.reference
    assert reference is not None
    validation = msgspec.structs.replace(
        case.validation, reference=msgspec.structs.replace(reference, known_s=known)
    )
    cut = dataclasses.replace(
        case.evidence.reference, position=case.evidence.reference.position.copy()
    )
    errors = [None if error is None else error.copy() for error in case.evidence.errors]
    for row, end in enumerate(known):
        if end is not None:
            beyond = cut.time > end
            cut.position[row, beyond] = np.nan
            for error in errors:
                if error is not None:
                    error[row, beyond] = np.nan
    evidence = dataclasses.replace(case.evidence, reference=cut, errors=tuple(errors))
    return Case(validation, evidence)


def test_a_bouncing_ball_touches_in_the_steps_of_its_impacts(disc: Scene) -> None:
    e, batch = of(disc), draw_batch(disc, range(ROWS), noise=False)

    contact = contact_of(disc, batch, dropped(disc, e))

    for row, height in enumerate(HEIGHTS):
        fall = np.sqrt(2 * height / PULL)
        times = np.concatenate([[fall], fall * (1 + 2 * np.cumsum(e ** np.arange(1, 20)))])
        steps = (times[times < TIME[-1]] / FRAME).astype(int)
        np.testing.assert_array_equal(np.flatnonzero(contact.touch[row, :, 0]), steps)
        np.testing.assert_array_equal(np.flatnonzero(contact.impact[row]), steps)


def test_its_figures_are_those_of_the_motion(disc: Scene) -> None:
    batch = draw_batch(disc, range(ROWS), noise=False)

    contact = contact_of(disc, batch, dropped(disc, LESS))

    for height, episode in zip(HEIGHTS, contact.episodes, strict=True):
        speed = np.sqrt(2 * PULL * height)
        np.testing.assert_allclose(episode.leaving / episode.arriving, LESS, rtol=1e-6)
        assert episode.arriving[0] == pytest.approx(speed, rel=1e-9)
        assert episode.rebound == pytest.approx(LESS**2 * height, rel=1e-9)
        assert episode.first == pytest.approx(np.ceil(speed / PULL / FRAME) * FRAME)
        assert episode.rolls is None
    np.testing.assert_allclose(contact.gap[:, 0], HEIGHTS, rtol=1e-9)


def test_near_the_ground_is_not_on_it(disc: Scene) -> None:
    """A throw from a millimetre upwards: the ground is within reach, and does not push."""
    time = TIME[:6]
    climb = np.tile(2.0 - PULL * time, (ROWS, 1))
    gap = np.tile(1e-3 + 2.0 * time - PULL * time**2 / 2, (ROWS, 1))
    flight = motion(disc, gap, np.stack([0 * climb, 0 * climb, climb], axis=-1))

    contact = contact_of(disc, draw_batch(disc, range(ROWS), noise=False), flight)

    assert not contact.touch.any()
    assert np.isnan(contact.slip).all()
    assert [episode.first for episode in contact.episodes] == [None] * ROWS


def _sliding(scene: Scene, speed: Array) -> tuple[Trajectory, Array]:
    """Balls that start without spin, and when they begin to roll."""
    assert scene.ground is not None
    brake, radius = scene.ground.friction * PULL, Mechanism.of(scene).sphere_radius[0]
    until = 2 * speed / (7 * brake)
    slid = np.minimum(TIME, until[:, None])
    velocity = speed[:, None] - brake * slid
    spin = 2.5 * brake / radius * slid
    whole = np.stack([velocity, 0 * velocity, 0 * velocity], axis=-1)
    return motion(scene, np.zeros_like(velocity), whole, spin), until


def test_a_sliding_ball_rolls_when_friction_has_done_its_work(ball: Scene) -> None:
    run, until = _sliding(ball, np.array([2.0, 5.0, 9.0]))

    contact = contact_of(ball, draw_batch(ball, range(ROWS), noise=False), run)

    assert contact.touch.all()
    assert not contact.impact.any()
    assert [episode.rolls for episode in contact.episodes] == pytest.approx(until, abs=1e-6)
    np.testing.assert_allclose(contact.slip[:, 0], [2.0, 5.0, 9.0], rtol=1e-9)
    np.testing.assert_allclose(contact.slip[:, -1], 0.0, atol=1e-9)


def test_the_table_holds_engines_beside_the_reference(bouncing: Case) -> None:
    names = ("reference", *(result.engine for result in bouncing.validation.engines))
    entries = [(name, themed.Style(0, dashed=False)) for name in names]
    table = tables(contacts_of(bouncing.evidence), entries, range(ROWS))[1]

    headings = [column.heading for column in table.columns]
    rebound, ratio = headings.index("first rebound"), headings.index("restitution")
    reference, worse, alike = (row.texts for row in table.rows)
    e = of(bouncing.evidence.scene)
    assert reference[rebound] == f"{e**2 * HEIGHTS[1]:.4f} m"
    assert f"({100 * (LESS**2 / e**2 - 1):+.2f} %)" in worse[rebound]
    assert (worse[ratio], alike[ratio]) == ("0.9000", f"{e:.4f}")
    assert "rolls from" not in headings


def test_the_script_gets_what_touches(bouncing: Case) -> None:
    data = viewer(written(bouncing))
    contact = data["contact"]

    assert [entry["name"] for entry in data["entries"]] == [
        "reference",
        "mujoco matched",
        "dart matched",
    ]
    for packed, expected in zip(
        contact["entries"], filter(None, contacts_of(bouncing.evidence)), strict=True
    ):
        bits = np.unpackbits(
            numbers(packed["flags"], "u1").astype("u1").reshape(ROWS, STEPS, 1), axis=2
        )
        np.testing.assert_array_equal(bits[..., 0], expected.touch[..., 0])
        np.testing.assert_array_equal(bits[..., 1], expected.impact)
        gap = numbers(packed["gap"], "<f4").reshape(ROWS, STEPS + 1)
        np.testing.assert_allclose(gap, expected.gap, atol=1e-6)


def test_strips_of_many_frames_have_ends() -> None:
    """Browsers take some 65 000 to 125 000 arguments: figures of frames are never arguments."""
    script = resources.files("mbds_xsim.report").joinpath("contact.js").read_text("utf-8")
    (function,) = re.findall(r"^function range\(.*?^}", script, re.DOTALL | re.MULTILINE)
    assert "..." not in function

    node = shutil.which("node")
    if node is not None:
        count = 300_000
        program = f"""
        const state = {{ trajectory: 1 }}, contact = {{ frames: {count} }};
        const gap = new Float32Array(2 * contact.frames).fill(NaN);
        gap.set([-9, -0.5, 2, Infinity], contact.frames - 1);
        const level = new Float32Array(gap.length).fill(0.25);
        const scene = {{ entries: [{{ gap }}, {{ gap: level }}] }};
        {function}
        console.log(JSON.stringify(range("gap")));"""
        told = subprocess.run([node, "-e", program], check=True, capture_output=True, text=True)
        assert json.loads(told.stdout) == [-0.5, 2]


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_the_last_time_under_the_strips_is_whole() -> None:
    script = resources.files("mbds_xsim.report").joinpath("contact.js").read_text("utf-8")
    (function,) = re.findall(r"^function drawTimes\(.*?^}", script, re.DOTALL | re.MULTILINE)
    program = f"""
    const ink = {{ measureText: () => ({{ width: 28 }}) }}, ends = [];
    const theme = () => "", stroke = () => null, ticks = () => [0, 0.6, 1.2];
    const write = (text, x) => ends.push(x + 14);
    {function}
    drawTimes({{ width: 700, height: 300, duration: 1.2, x: (time) => 128 + time * 468.333 }});
    console.log(Math.max(...ends) <= 700);"""
    node = str(shutil.which("node"))
    told = subprocess.run([node, "-e", program], check=True, capture_output=True, text=True)

    assert told.stdout == "true\n"


def test_a_page_of_contact_has_its_tables_and_its_words(bouncing: Case) -> None:
    page = written(bouncing)
    section = page.split('<section id="contact">')[1].split("</section>")[0]

    assert section.count("<table") == ROWS
    assert section.count(" hidden>") == ROWS - 1
    assert "exact through all contacts" in section
    impacts = page.split("<h2>Impacts</h2>")[1].split("</section>")[0]
    assert 'class="curve-0"' in impacts
    assert 'class="curve-1"' not in impacts


def test_a_scene_without_contact_has_nothing_of_it(case: Case) -> None:
    page = written(case)

    assert 'id="contact"' not in page
    assert "function drawStrips" not in page
    assert "contact" not in viewer(page)
    assert "no unique solution" not in page.split("<script")[0]


def test_where_the_reference_ends_the_page_says_so(bouncing: Case) -> None:
    case = _until(bouncing, 0.3, 0.45, None)

    page = written(case)
    section = page.split('<section id="contact">')[1].split("</section>")[0]

    assert "reference ends at the first impact" in section
    assert viewer(page)["contact"]["ends"] == [0.3, 0.45, None]
    assert page.count("no unique solution</tspan>") + page.count(">no unique solution<") == 2
    assert "at 0.30 to 0.45 s" in words.reference_line(case.validation)
    assert "≥0.30 s" in page
    assert "always" not in page.split("</table>")[0]


def test_a_scene_that_starts_in_contact_has_no_error_at_all(bouncing: Case) -> None:
    case = _until(bouncing, 0.0, 0.0, 0.0)

    page = written(case)

    assert figures.error_growth(case.validation, case.evidence) == []
    assert "<figcaption>Error" not in page
    assert "starts in contact" in page
    agrees = [words.cells_of(r, case.validation)[-1].text for r in case.validation.engines]
    assert agrees == ["–"] * 3


def test_engines_alone_are_in_the_matrix_where_the_reference_has_ended(case: Case) -> None:
    count = len(case.validation.names)
    matrix = np.array(case.validation.matrix_m)
    matrix[-1, :-1] = matrix[:-1, -1] = np.nan
    ended = msgspec.structs.replace(case.validation, matrix_m=tuple(map(tuple, matrix.tolist())))

    charts = [figures.matrix(v) for v in (ended, case.validation)]
    drawn, whole = (themed.svg("", f.draw, f.size, f.tips) for f in charts if f is not None)

    assert whole.count(">reference<") == 2
    assert drawn.count(">reference<") == 0
    nothing = msgspec.structs.replace(ended, matrix_m=((np.nan,) * count,) * count)
    assert figures.matrix(nothing) is None


def test_distributions_are_on_the_page(case: Case) -> None:
    pair = EnsembleResult("dart native", "mujoco native", 4.0, 0.0123, 0.0005, 60)
    validation = msgspec.structs.replace(case.validation, ensembles=(pair,))

    page = written(dataclasses.replace(case, validation=validation))

    assert "1 pair, 1 told apart with p below 0.01" in page
    (row,) = re.findall(r"<tr><td[^>]*>dart native and mujoco native.*?</tr>", page)
    assert "0.012" in row
    assert "5.0e-04" in row


@pytest.mark.parametrize(("slower", "marked"), [(1.0, True), (0.1, False)])
def test_a_budget_at_1_s_is_told_of_where_it_is_drawn(
    case: Case, slower: float, marked: bool
) -> None:
    time = slower * case.evidence.reference.time
    reference = dataclasses.replace(case.evidence.reference, time=time)
    evidence = dataclasses.replace(case.evidence, reference=reference)

    text = words.growth_words(case.validation, evidence, known=True)

    assert ("triangle" in text) is marked
