"""Pictures of scenes: everything is drawn where the scene has it."""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from mbds_xsim import __main__ as cli
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.report.draw import draw_scene
from mbds_xsim.report.motion import Projection, outline, pose_of
from mbds_xsim.report.themed import PARTS, picture
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Body, Inertia, Joint, Particle, Scene, SpringDamper
from mbds_xsim.simulate import registry

HINGE, BALL, SPRING, PARTICLE = PARTS["hinge"], PARTS["ball"], PARTS["spring"], "#6f8296"

POINT = Body("bob", particles=(Particle((0.4, 0.0, -0.3)),))
PENDULUM = Scene(
    name="one",
    bodies=(POINT,),
    length=0.5,
    joints=(Joint("pin", "hinge", "world", "bob", (0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)),),
)


def _drawn(scene: Scene, folder: Path, start: int | None = None) -> Array:
    from matplotlib.image import imread

    draw_scene(scene, folder / "scene.png", start=start)
    return np.asarray(imread(folder / "scene.png"))[..., :3]


def _pixels(image: Array, colour: str) -> Array:
    """Rows and columns of a colour, shape (pixel, 2)."""
    from matplotlib.colors import to_rgb

    return np.asarray(np.argwhere(np.abs(image - to_rgb(colour)).max(axis=-1) < 0.02), float)


def _hinge(image: Array) -> Array:
    """Return pixels of the joint itself; others of its colour are in the legend below."""
    pixels = _pixels(image, HINGE)
    return pixels[pixels[:, 0] < pixels[:, 0].min() + 40]


def _ball(radius: float, mass: float = 2.0) -> Scene:
    moment = 0.4 * mass * radius**2
    inertia = Inertia(mass, moments=(moment, moment, moment))
    return Scene(name="ball", bodies=(Body("ball", inertia=inertia),), length=1.0)


@pytest.mark.parametrize("name", ["6pendulum", "2ladder", "workbench", "balldrop", "simplecubli"])
def test_every_kind_of_scene_can_be_drawn(name: str, tmp_path: Path) -> None:
    image = _drawn(registry.load_scene(name), tmp_path)

    ink = (image < 0.9).any(axis=-1)
    assert min(image.shape[:2]) > 600
    assert 0.005 < ink.mean() < 0.6


def test_a_particle_lies_where_it_is(tmp_path: Path) -> None:
    """Below and to the right of its hinge, at a slope of 3 to 4."""
    image = _drawn(PENDULUM, tmp_path)

    down, right = _pixels(image, PARTICLE).mean(axis=0) - _hinge(image).mean(axis=0)
    assert right > 100
    assert down / right == pytest.approx(0.75, abs=0.02)


def test_a_hinge_axis_towards_the_viewer_is_a_point(tmp_path: Path) -> None:
    joint = msgspec.structs.replace(PENDULUM.joints[0], axis=(1.0, 0.0, 0.0))
    along = msgspec.structs.replace(PENDULUM, joints=(joint,))

    towards, sideways = (np.ptp(_hinge(_drawn(s, tmp_path))[:, 1]) for s in (PENDULUM, along))
    assert sideways > 2.0 * towards


def test_joints_and_springs_are_drawn_where_there_are_any(tmp_path: Path) -> None:
    ends = ("world", "bob"), ((0.0, 0.0, -0.3), (0.4, 0.0, -0.3))
    sprung = msgspec.structs.replace(PENDULUM, springs=(SpringDamper("s", *ends, 10.0),))
    plain, more = _drawn(PENDULUM, tmp_path), _drawn(sprung, tmp_path)

    assert len(_pixels(plain, BALL)) == 0
    assert len(_pixels(more, SPRING)) > 100 > 0 == len(_pixels(plain, SPRING))


def test_a_start_is_drawn_in_place_of_the_reference_pose(tmp_path: Path) -> None:
    joint = msgspec.structs.replace(PENDULUM.joints[0], start=np.pi)
    turned = msgspec.structs.replace(PENDULUM, joints=(joint,))

    image = _drawn(turned, tmp_path, start=0)

    down, right = _pixels(image, PARTICLE).mean(axis=0) - _hinge(image).mean(axis=0)
    assert down < 0
    assert right < 0


def test_a_homogeneous_ball_is_as_large_as_it_is() -> None:
    mechanism = Mechanism.of(_ball(0.3))
    view = Projection.of(np.eye(3), 3)

    half = outline(mechanism, pose_of(mechanism, None), view, 0)

    assert half == pytest.approx(0.09 * np.eye(2), abs=1e-12)


def test_a_homogeneous_box_is_as_wide_and_high_as_its_ellipsoid() -> None:
    """Semi-axes of a homogeneous ellipsoid along x, y, z, seen along y."""
    a, b, c = 0.3, 0.2, 0.1
    moments = (0.2 * (b**2 + c**2), 0.2 * (a**2 + c**2), 0.2 * (a**2 + b**2))
    scene = Scene(name="e", bodies=(Body("e", inertia=Inertia(1.0, moments)),), length=1.0)
    mechanism = Mechanism.of(scene)
    view = Projection.of(np.zeros((1, 3)), 2)

    half = outline(mechanism, pose_of(mechanism, None), view, 0)

    assert half == pytest.approx(np.diag([a**2, c**2]), abs=1e-12)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
def test_a_flat_plate_seen_edge_on_is_drawn(axis: tuple[float, ...], tmp_path: Path) -> None:
    """Rounding turns the square of its thickness in the picture into -1e-16 m²."""
    turned = (np.sqrt(0.5), *(np.sqrt(0.5) * np.array(axis)).tolist())
    moments = (0.1, 0.2, 0.1) if axis[0] else (0.2, 0.1, 0.1)
    plate = Body("plate", inertia=Inertia(1.0, moments), orientation=turned)
    scene = Scene(name="plate", bodies=(plate,), length=1.0)

    assert len(_drawn(scene, tmp_path))


@pytest.mark.parametrize(
    ("points", "towards"),
    [
        ([[0, 0, 0], [1, 0, 1]], [0, -1, 0]),
        ([[0, 0, 0], [0, 1, 1]], [1, 0, 0]),
        ([[0, 0, 0], [1, 1, 0]], [0, 0, 1]),
        ([[0, 0, 0], [0, 0, 1]], [0, -1, 0]),
    ],
)
def test_a_flat_scene_is_seen_straight_on(points: list[list[int]], towards: list[int]) -> None:
    view = Projection.of(np.array(points, dtype=float), 3)

    assert view.axes[2].tolist() == towards


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_a_view_is_a_right_handed_frame(dimension: int) -> None:
    axes = Projection.of(np.eye(3), dimension).axes

    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)


def test_a_file_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")

    with pytest.raises(InputError, match="cannot write"):
        draw_scene(PENDULUM, tmp_path / "file" / "scene.png")


@pytest.mark.filterwarnings("error")
def test_letters_that_the_font_lacks_are_drawn_without_a_warning() -> None:
    assert picture(lambda figure: figure.text(0.5, 0.5, "名前"), (1.0, 1.0), None)


def test_the_same_scene_gives_the_same_file(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        draw_scene(PENDULUM, tmp_path / name)

    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        (["3pendulum", "--png", "scene.png"], 0, ""),
        (["3pendulum", "--png", "scene.png", "--start", "2"], 0, ""),
        (["3pendulum", "--png", "."], 2, "--png: cannot write"),
        (["nothing", "--png", "."], 2, "--png: cannot write"),
        (["3pendulum", "--start", "2"], 2, "--start: got 2, which says what is drawn or given"),
    ],
)
def test_show_draws_into_a_file(
    arguments: list[str],
    code: int,
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["mbds-xsim", "show", *arguments])

    with pytest.raises(SystemExit) as ended:
        cli.main()

    assert ended.value.code == code
    assert told in capsys.readouterr().err
    drawn = tmp_path / "scene.png"
    assert drawn.exists() == (code == 0)
    assert code or drawn.read_bytes().startswith(b"\x89PNG")
