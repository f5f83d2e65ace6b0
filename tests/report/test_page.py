"""Content of the page of a validation; a browser is not needed."""

from __future__ import annotations

import base64
import dataclasses
import html.parser
import json
import re
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from mbds_xsim.report import themed
from mbds_xsim.report.files import to_html
from mbds_xsim.report.motion import skeleton
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Body, Inertia, Joint, Scene
from mbds_xsim.studies.validate.motion import pack
from mbds_xsim.studies.validate.present import present

from .conftest import Case, Fake, make_case


@pytest.fixture(scope="module")
def page(case: Case) -> str:
    return written(case)


def written(case: Case) -> str:
    return to_html([present(case.validation, case.evidence)], case.validation.scene)


def viewer(page: str) -> dict[str, Any]:
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert match
    data: dict[str, Any] = json.loads(match[1])
    return data


def numbers(text: str, kind: str) -> NDArray[np.float64]:
    return np.frombuffer(base64.b64decode(text), kind).astype(np.float64)


def unpacked(data: dict[str, Any], entry: dict[str, Any]) -> NDArray[np.float64]:
    """Read positions as the page's script does, (trajectory, frame, point, 3)."""
    shape = (len(data["trajectories"]), data["frames"], data["points"], 3)
    low, high = np.array(data["low"]), np.array(data["high"])
    base = low + numbers(data["base"], "<u2").reshape(shape) / 65535 * (high - low)
    if entry["deviation"] is None:
        return base
    part = numbers(entry["deviation"], "<i2").reshape(shape) / 32767
    return np.asarray(base + data["reach"] * part**3)


def test_the_page_asks_nothing_of_the_network(page: str) -> None:
    assert not re.search(r"""(src|href)\s*=\s*["']?(https?:)?//""", page)
    assert "@import" not in page
    assert "url(http" not in page


def test_its_tags_are_balanced(page: str) -> None:
    assert _unclosed(page) == []


class _Tags(html.parser.HTMLParser):
    void = frozenset({"meta", "input", "br", "link", "hr", "img"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:  # noqa: ARG002
        if tag not in self.void:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> without a start"
        assert self.open.pop() == tag


def _unclosed(page: str) -> list[str]:
    parser = _Tags()
    parser.feed(page)
    parser.close()
    return parser.open


def test_it_tells_what_a_check_saw_besides(page: str, case: Case) -> None:
    findings = [finding for result in case.validation.engines for finding in result.findings]

    assert page.count("told besides") == len(findings)


def test_it_names_verdict_command_versions_and_options(page: str, case: Case) -> None:
    validation = case.validation
    for text in (validation.command, validation.machine, *validation.versions, "1.2.3"):
        assert text in page
    for key in validation.engines[0].options:
        assert f"{key} = " in page
    assert 'class="verdict fail"' in page


def test_every_finding_is_listed(page: str, case: Case) -> None:
    rows = page.split("<h2>Findings</h2>")[1].split("</section>")[0].count("<tr")
    findings = sum(len(result.findings) for result in case.validation.engines)
    assert rows == findings + len(case.validation.engines)  # and a head each


def test_every_engine_has_its_curve_in_every_plot_over_time(page: str, case: Case) -> None:
    errors_and_checks = 3 + 3
    for place in range(len(case.validation.engines)):
        assert page.count(f'class="curve-{place}"') == errors_and_checks


def test_plots_take_the_colours_of_the_page(page: str) -> None:
    svg = "".join(re.findall(r"<svg role.*?</svg>", page, re.DOTALL))

    assert "var(--c0)" in svg
    assert "var(--ink)" in svg
    assert not any(colour in svg for colour in themed.LIGHT)


def test_no_id_is_used_twice_for_different_things(page: str) -> None:
    ids = re.findall(r'\bid="([^"]+)"', page)
    figures = re.findall(r"<svg role.*?</svg>", page, re.DOTALL)
    own = [set(re.findall(r'\bid="([^"]+)"', figure)) for figure in figures]
    # Definitions of matplotlib carry the hash of their content: within a figure they may recur.
    assert sum(map(len, own)) == len(set().union(*own)) > 0
    again = {name for name in ids if ids.count(name) > 1}
    assert all(re.fullmatch(r"[a-z][0-9a-f]{10}", name) for name in again)


def test_text_of_the_scene_is_escaped(one_engine: Case) -> None:
    (result,) = one_engine.validation.engines
    evil = "</script><script>alert(1)</script>"
    validation = msgspec.structs.replace(
        one_engine.validation,
        description=evil,
        engines=(msgspec.structs.replace(result, reasons=(evil,), engine=evil),),
        names=(evil, "reference"),
    )

    page = written(dataclasses.replace(one_engine, validation=validation))

    assert "<script>alert" not in page
    assert _unclosed(page) == []


def test_the_viewer_gets_the_motion_back(page: str, case: Case) -> None:
    data = viewer(page)
    bones = skeleton(case.evidence.scene)
    reference = bones.positions(case.evidence.reference)

    entries = {entry["name"]: entry for entry in data["entries"]}
    assert list(entries) == [
        "reference",
        *(f"{r.engine} {r.profile}" for r in case.validation.engines),
    ]
    np.testing.assert_allclose(unpacked(data, entries["reference"]), reference, atol=1e-4)


def test_small_deviations_survive_the_packing(page: str, case: Case) -> None:
    data = viewer(page)
    bones = skeleton(case.evidence.scene)
    place = next(
        k
        for k, result in enumerate(case.validation.engines)
        if (result.engine, result.profile) == ("mujoco", "matched")
    )
    motion = case.evidence.trajectories[place]
    assert motion is not None
    wanted = bones.positions(motion) - bones.positions(case.evidence.reference)

    entries = data["entries"]
    got = unpacked(data, entries[1 + place]) - unpacked(data, entries[0])

    large = np.abs(wanted) > 1e-7
    assert large.sum() > 50
    np.testing.assert_allclose(got[large], wanted[large], rtol=0.02)


def test_a_blow_up_is_shown_as_far_as_it_goes(page: str) -> None:
    entry = next(e for e in viewer(page)["entries"] if e["name"] == "pybullet native")

    assert entry["shown"] == [101, 101, 60]


def test_a_motion_out_of_reach_ends_in_the_view(case: Case) -> None:
    motion = case.evidence.trajectories[1]
    assert motion is not None
    flown = dataclasses.replace(motion, position=motion.position.copy())
    flown.position[0, 20:] += 1e6
    evidence = dataclasses.replace(case.evidence, trajectories=(flown,), errors=(None,))

    packed = pack(evidence, [("x", themed.Style(0, False))])

    assert packed["entries"][1]["shown"] == [20, 101, 101]


def test_a_reference_that_ends_early_leaves_engines_in_view(case: Case) -> None:
    reference = case.evidence.reference
    cut = dataclasses.replace(reference, position=reference.position.copy())
    cut.position[:, 30:] = np.nan
    motion = case.evidence.trajectories[1]
    evidence = dataclasses.replace(
        case.evidence, reference=cut, trajectories=(motion,), errors=(None,)
    )

    packed = pack(evidence, [("x", themed.Style(0, False))])

    assert [entry["shown"] for entry in packed["entries"]] == [[30] * 3, [101] * 3]


@pytest.mark.parametrize("others", [1, 2])
@pytest.mark.parametrize("ends", [0, 30])
def test_beyond_the_reference_an_engine_that_flies_off_is_not_the_measure(
    case: Case, others: int, ends: int
) -> None:
    reference, motion = case.evidence.reference, case.evidence.trajectories[1]
    assert motion is not None
    cut = dataclasses.replace(reference, position=reference.position.copy())
    cut.position[:, ends:] = np.nan
    flown = dataclasses.replace(motion, position=motion.position.copy())
    flown.position[:, 50:] += np.linspace(0.1, 5e3, 51)[:, None, None]
    names = ("flown", "x", "y")[: 1 + others]
    evidence = dataclasses.replace(
        case.evidence, reference=cut, trajectories=(flown, *[motion] * others),
        errors=(None,) * len(names),
    )  # fmt: skip

    packed = pack(evidence, [(name, themed.Style(0, False)) for name in names])

    reached, *kept = [entry["shown"] for entry in packed["entries"][1:]]
    assert kept == [[101] * 3] * others
    assert all(50 < shown < 60 for shown in reached)
    assert np.abs([packed["low"], packed["high"]]).max() < 10.0 * case.evidence.scene.length


def test_a_blow_up_without_a_reference_leaves_numbers_of_json(case: Case) -> None:
    reference, motion = case.evidence.reference, case.evidence.trajectories[1]
    assert motion is not None
    gone = dataclasses.replace(reference, position=np.full_like(reference.position, np.nan))
    flown = dataclasses.replace(motion, position=motion.position.copy())
    flown.position[:, 40:] = 1e200
    evidence = dataclasses.replace(
        case.evidence, reference=gone, trajectories=(flown,), errors=(None,)
    )

    packed = pack(evidence, [("x", themed.Style(0, False))])

    json.dumps(packed, allow_nan=False)
    assert packed["entries"][1]["shown"] == [40] * 3


def test_a_large_scene_is_thinned_to_the_limit(case: Case) -> None:
    count = len(case.evidence.trajectories)
    results = [(f"n{k}", themed.Style(0, False)) for k in range(count)]

    frames = pack(case.evidence, results, limit=20_000)
    trajectories = pack(case.evidence, results, limit=3_000)

    assert (frames["frames"], frames["left_out"]) == (51, 0)
    assert frames["step"] == pytest.approx(0.08)
    assert (trajectories["frames"], trajectories["left_out"]) == (26, 2)
    assert len(frames["base"]) * (count + 1) * 3 / 4 <= 20_000 * 1.01


@pytest.mark.parametrize("name", ["one_engine", "with_crash"])
def test_other_validations_make_a_page(name: str, request: pytest.FixtureRequest) -> None:
    case: Case = request.getfixturevalue(name)

    page = written(case)

    assert _unclosed(page) == []
    assert len(viewer(page)["entries"]) == 2
    assert ("signal 11" in page) == (name == "with_crash")


def test_bodies_without_particles_and_edges_are_drawn_by_their_joints() -> None:
    plate = Inertia(2.0, (0.1, 0.1, 0.15), com=(0.0, 0.0, -0.5))
    scene = Scene(
        name="plate",
        bodies=(Body("plate", inertia=plate),),
        joints=(Joint("hang", "ball", "world", "plate", (0.0, 0.0, 0.0)),),
        length=0.5,
    )
    case = make_case(scene, (Fake("mujoco"),), frames=21)

    bones = skeleton(scene)
    places = bones.positions(case.evidence.reference)

    assert bones.edges == ((0, 1),)
    np.testing.assert_allclose(places[..., 0, :], case.evidence.reference.position[..., 0, :])
    np.testing.assert_allclose(places[..., 1, :], 0.0, atol=1e-12)
    assert _unclosed(written(case)) == []


def test_anchors_are_numbered_behind_all_moving_points(scene: Scene) -> None:
    bones = skeleton(scene)

    assert bones.edges == scene.edges
    np.testing.assert_array_equal(bones.fixed, scene.anchors)
    np.testing.assert_array_equal(bones.body, Mechanism.of(scene).particle_body)
