"""Which engines run: named ones must be able to, others are left out with the reason."""

from __future__ import annotations

import pytest

from mbds_xsim.choice import Choice
from mbds_xsim.errors import Unsupported
from mbds_xsim.scene import Body, DistanceLink, Particle, Scene

ENDS = ((0.0, 0.0, 0.0), (0.0, 0.0, -1.0))
LINKED = Scene(
    "linked",
    (Body("ball", particles=(Particle((0.0, 0.0, -1.0)),)),),
    length=1.0,
    distance_links=(DistanceLink("rope", ("world", "ball"), ENDS),),
)


def test_engines_that_cannot_do_a_scene_are_left_out_with_the_reason() -> None:
    contenders, left_out = Choice.parse().contenders(LINKED)
    assert {contender.engine for contender in contenders} == {"mujoco", "exudyn"}
    assert set(left_out) == {"dart", "pybullet"}
    assert all("distance link" in reason for reason in left_out.values())


def test_an_engine_asked_for_by_name_must_be_able_to() -> None:
    with pytest.raises(Unsupported, match=r"distance link.*use --engines exudyn"):
        Choice.parse(engines="pybullet,exudyn").contenders(LINKED)


def test_some_engine_must_be_able_to() -> None:
    with pytest.raises(Unsupported, match="no engine given here can"):
        Choice(("pybullet", "dart"), named=False).contenders(LINKED)
