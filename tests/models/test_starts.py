"""Starts that an imported model gets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mbds_xsim.scene.joint_space import BodyStates, LinkStates, to_links
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.registry import read_model

pytest.importorskip("mujoco")
pytestmark = pytest.mark.usefixtures("in_process")


def _drawn(model: str, here: Path, starts: int) -> tuple[Scene, Batch, LinkStates]:
    """Import MJCF of angles in radians, and draw starts."""
    path = here / "model.xml"
    path.write_text(f'<mujoco><compiler angle="radian"/><worldbody>{model}</mujoco>')
    scene = read_model(path).scene
    batch, mechanism = draw_batch(scene, range(starts)), Mechanism.of(scene)
    return scene, batch, to_links(mechanism, BodyStates.of(mechanism, batch))


def test_starts_are_inside_the_limits_and_differ(here: Path) -> None:
    geom = '<geom type="box" size=".1 .2 .3" pos="0 0 -1"/>'
    model = (
        f'<body><joint name="hip" range="0.5 1.5" axis="0 1 0"/>{geom}<body pos="0 0 -2">'
        f'<joint name="rail" type="slide" range="-0.2 0" axis="0 0 1"/>{geom}</body></body>'
        f'<body name="puck" pos="3 0 0"><freejoint/>{geom}</body></worldbody>'
    )
    scene, batch, links = _drawn(model, here, starts=30)

    names = [link.joint.name if link.joint else "puck" for link in Mechanism.of(scene).links]
    hip, rail = (links.coordinate[:, names.index(name)] for name in ("hip", "rail"))
    assert ((hip > 0.55) & (hip < 1.45)).all()
    assert ((rail > -0.19) & (rail < -0.01)).all()
    assert min(np.ptp(hip), np.ptp(rail) * 5) > 0.5
    rates = np.abs(batch.angular_velocity[:, [body.name for body in scene.bodies].index("puck")])
    assert (rates[0::3].max() < 0.1) & (0.4 < rates.max() <= 1.0)


@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_a_joint_that_others_follow_is_drawn_so_that_all_are_inside_their_limits(
    offset: float, here: Path
) -> None:
    body = '<body pos="0 0 -2"><joint name="{}" axis="0 1 0" {}/><geom size=".1" pos="0 0 -1"/>'
    names, limits = ("hip", "knee", "toe"), ("", 'range="-0.1 2"', "")
    bodies = "".join(body.format(*joint) for joint in zip(names, limits, strict=True))
    model = (
        f"{bodies}</body></body></body></worldbody>"
        f'<equality><joint joint1="toe" joint2="knee" polycoef="0 3 0 0 0"/>'
        f'<joint joint1="knee" joint2="hip" polycoef="{offset} -2 0 0 0"/></equality>'
    )
    scene, _, links = _drawn(model, here, starts=60)

    hip, knee, toe = links.coordinate.T
    assert 0.8 < np.abs(links.rate).max() <= 1.0  # the toe's, six times the hip's
    np.testing.assert_allclose(knee, offset - 2 * hip, atol=1e-11)
    np.testing.assert_allclose(toe, 3 * knee, atol=1e-11)
    assert scene.joints[1].limits == (-0.1, 2.0)
    assert ((knee > -0.1) & (knee < np.pi / 3)).all()
    assert np.ptp(knee) > 0.7 * (np.pi / 3 + 0.1)


def test_a_joint_that_an_offset_moves_is_drawn_inside_its_limits(here: Path) -> None:
    """The hip recoils when the coupling turns the toe to its offset."""
    body = '<body><joint name="{}" axis="0 1 0" {}/><geom size=".1" pos="0 0 -1"/>'
    model = (
        f'{body.format("hip", """range="-0.05 0.05" """)}{body.format("knee", "")}</body>'
        f"{body.format('toe', '')}</body></body></worldbody><equality>"
        '<joint joint1="toe" joint2="knee" polycoef="0.5 2 0 0 0"/></equality>'
    )
    _, _, links = _drawn(model, here, starts=30)

    hip, _, _ = links.coordinate.T
    assert np.ptp(hip) > 0.07
    assert np.abs(hip).max() < 0.9 * 0.05 + 1e-12
