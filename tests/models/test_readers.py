"""Losses of engines' own readers are found, and none where they lose nothing."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks.reader_losses import ENGINES, FOLDER, SHOWN, page, shown
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.imported import LinkFacts
from mbds_xsim.scene.joint_space import BodyStates, to_links
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate.registry import read_model, registered
from mbds_xsim.studies import readers
from mbds_xsim.studies.readers import compare
from tests.command_line import CommandLine

for _engine in ("mujoco", "pybullet", "dartpy"):
    pytest.importorskip(_engine)

_ALIKE = """<robot name="arm"><link name="base"/><link name="ball"><inertial>
  <origin xyz="0.5 0 0"/><mass value="3"/>
  <inertia ixx="{0}" iyy="{0}" izz="{0}" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0.5 0 0"/><geometry><sphere radius="0.5"/></geometry></collision></link>
  <joint name="pivot" type="continuous"><parent link="base"/><child link="ball"/>
  <origin xyz="0 1 0" rpy="0 0 0.7"/><axis xyz="0 0.6 0.8"/><dynamics damping="0.25"/></joint>
</robot>"""


@pytest.mark.slow
def test_every_file_of_a_loss_shows_it() -> None:
    assert sorted(SHOWN) == sorted(path.name for path in FOLDER.iterdir())
    expected = (FOLDER.parents[2] / "docs" / "reader-losses.md").read_text("utf-8")
    assert [name for name in SHOWN if f"| `{name}` |" not in expected] == [], "see SHOWN"
    assert page() == expected, "python -m benchmarks.reader_losses > docs/reader-losses.md"


def test_links_that_an_engine_lacks_are_not_compared() -> None:
    stated = [LinkFacts(name, 1.0, (0.0, 0.0, 0.0), (1.0,) * 6) for name in ("a", "b", "c")]
    pairs = [
        (stated[0], None),
        *((link, msgspec.structs.replace(link, mass=2.0)) for link in stated[1:]),
    ]

    (difference,) = readers._field("links", "mass", pairs, lambda link: link.mass)

    assert (difference.count, difference.among, difference.first) == (2, 2, "b")


def test_what_differs_little_does_not_read_the_same() -> None:
    stated = LinkFacts("a", 1.0, (0.0, 0.0, 0.0), (1.0,) * 6)
    read = msgspec.structs.replace(stated, mass=1.0 + 3e-6)

    (difference,) = readers._field("links", "mass", [(stated, read)], lambda link: link.mass)

    assert (difference.read, difference.stated) == ("1.000003", "1")


@pytest.mark.parametrize("name", ["mimic.urdf", "degrees.xml"])
def test_a_loss_is_told_for_those_engines_that_have_it(name: str) -> None:
    readings = compare(FOLDER / name, ENGINES)

    assert [engine for engine, _ in shown(name, readings)] == list(SHOWN[name])
    (mujoco,) = (reading for reading in readings.readings if reading.engine == "mujoco")
    assert mujoco.alike


def test_a_solid_ball_is_read_alike_by_all(run: CommandLine, here: Path) -> None:
    (here / "arm.urdf").write_text(_ALIKE.format(0.4 * 3 * 0.5**2))
    assert run("readers", "arm.urdf").code == 0
    assert run("readers", "arm.urdf", "--engines", "mujoco, pybullet").code == 0

    (here / "arm.urdf").write_text(_ALIKE.format(0.41 * 3 * 0.5**2))
    ended = run("readers", "arm.urdf", "--json", "arm.json")
    assert ended.code == 1
    assert "otherwise: pybullet" in ended.out
    assert '"field": "inertia"' in (here / "arm.json").read_text()


_ONE_SIDED = (
    '<sdf version="1.6"><model name="m"><link name="l"><inertial><mass>2</mass><inertia>'
    "<ixx>1</ixx><iyy>1</iyy><izz>1</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia>"
    "</inertial></link>"
    '<joint name="j" type="revolute"><parent>world</parent><child>l</child><axis><xyz>0 1 0</xyz>'
    "<limit><lower>0</lower></limit></axis></joint></model></sdf>"
)


_UNIVERSAL = (
    _ONE_SIDED.replace("revolute", "universal")
    .replace("<limit><lower>0</lower></limit>", "")
    .replace("</axis>", "</axis><axis2><xyz>1 0 0</xyz></axis2>")
)
_FUSED = (
    '<mujoco><compiler fusestatic="true"/><worldbody><body name="a"><joint name="j" axis="0 1 0"/>'
    '<geom size=".1"/><body name="b" pos="0 0 1"><geom size=".1"/></body></body></worldbody>'
    "</mujoco>"
)
_FOLLOWING = (FOLDER / "mimic.urdf").read_text()


@pytest.mark.parametrize(
    ("reader", "ending", "text"),
    [
        ("dart", "sdf", _ONE_SIDED),
        ("dart", "sdf", _UNIVERSAL),
        ("dart", "urdf", _FOLLOWING),
        ("mujoco", "xml", _FUSED),
    ],
    ids=["limit on one side", "universal joint", "coupling", "fused bodies"],
)
def test_what_an_engine_reads_in_its_way_is_read_alike(
    reader: str, ending: str, text: str, here: Path
) -> None:
    (here / f"m.{ending}").write_text(text)
    (reading,) = compare(here / f"m.{ending}", [reader]).readings

    assert reading.alike


def test_a_reader_leaves_other_connections_to_pybullet_alone(tmp_path: Path) -> None:
    load, path = registered("mbds_xsim.model_loaders")["pybullet"].load(), tmp_path / "arm.urdf"
    path.write_text(_ALIKE.format(0.3))
    pybullet = pytest.importorskip("pybullet")
    other = pybullet.connect(pybullet.DIRECT)
    try:
        assert len(load(path, floating=False).joints) == 1
        assert pybullet.getNumBodies(physicsClientId=other) == 0
        assert pybullet.isConnected(other + 1) == 0
    finally:
        pybullet.disconnect(other)


def test_what_is_read_otherwise_moves_as_its_own_equation_says() -> None:
    readings = compare(FOLDER / "inertia-from-shape.urdf", ["pybullet", "dart"])
    pybullet, dart = readings.readings
    (inertia,) = pybullet.differences
    stated, read = (2 * 0.5**2 + float(text.split()[0]) for text in (inertia.stated, inertia.read))

    scene = read_model(FOLDER / "inertia-from-shape.urdf").scene
    start = draw_batch(scene, [1, 4, 7])
    mechanism = Mechanism.of(scene)
    links = to_links(mechanism, BodyStates.of(mechanism, start))
    squares = []
    for angle, rate in zip(links.coordinate[:, 0], links.rate[:, 0], strict=True):
        first, second = (_swung(angle, rate, moment) for moment in (stated, read))
        squares.append((2 * 0.5 * np.sin((first - second) / 2)) ** 2)  # a chord at 0.5 m
    assert dart.moved_m == 0
    assert pybullet.moved_m == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-3)
    assert np.mean(squares) > 0.02**2


def _swung(angle: float, rate: float, moment: float) -> float:
    """Angle after 1 s of a pendulum of 2 kg at 0.5 m from its pivot."""

    def slope(_: float, state: Array) -> list[float]:
        return [state[1], -2 * 9.81 * 0.5 * np.sin(state[0]) / moment]

    ended = solve_ivp(slope, (0, 1), [angle, rate], rtol=1e-10, atol=1e-12)
    return float(ended.y[0, -1])


def test_an_engine_without_a_reader_is_one_line(run: CommandLine, here: Path) -> None:
    (here / "arm.urdf").write_text(_ALIKE.format(1))

    assert "there are: dart, mujoco, pybullet" in run(
        "readers", "arm.urdf", "--engines", "exudyn"
    ).refusal  # fmt: skip
