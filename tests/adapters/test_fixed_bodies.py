"""Scenes in which nothing can move: every engine says so, whatever acts."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, DistanceLink, Force, Inertia, Joint, Scene, SpringDamper
from mbds_xsim.simulate import readback
from mbds_xsim.simulate.adapter import Adapter, Settings

_NONE = (0.0, 0.0, 0.0)
_WELDED = Scene(
    "welded",
    tuple(Body(name, inertia=Inertia(1.0, (0.1, 0.2, 0.2))) for name in ("a", "b")),
    1.0,
    joints=(Joint("foot", "fixed", "world", "a", _NONE), Joint("weld", "fixed", "a", "b", _NONE)),
)
_PULL = SpringDamper("pull", ("world", "b"), ((0.0, 0.0, 2.0), (0.0, 0.1, 0.0)), 10.0, 1.0, 0.5)
_PIN = Joint("pin", "hinge", "world", "b", _NONE, (0.0, 1.0, 0.0))
_WIRE = DistanceLink("wire", ("world", "b"), ((0.0, 0.0, 2.0), _NONE), 2.0)
_SCENES = {
    "alone": _WELDED,
    "hinged as well": msgspec.structs.replace(_WELDED, joints=(*_WELDED.joints, _PIN)),
    "linked as well": msgspec.structs.replace(_WELDED, distance_links=(_WIRE,)),
    "pushed": msgspec.structs.replace(_WELDED, forces=(Force("b", ((1.0, 2.0, 3.0),)),)),
    "pulled": msgspec.structs.replace(_WELDED, springs=(_PULL,)),
}


@pytest.mark.parametrize("name", _SCENES)
def test_bodies_that_are_all_fixed_stay(adapter: Adapter, name: str) -> None:
    scene = _SCENES[name]
    batch = draw_batch(scene, [0, 1]).truncated(3)
    methods = [m for m in adapter.methods.values() if not adapter.refusals(scene, m.name)]
    assert methods or scene.distance_links

    for method in methods:
        settings = Settings(method.name, scene.clock.frame / 4)
        with adapter.open(scene, settings) as run:
            motion, native = run.rollout(batch), run.readback(batch)
            assert run.native(batch)
        assert readback.compare(Mechanism.of(scene), batch, settings, native, method) == []
        assert motion.failures == (None, None)
        assert np.abs(motion.position - batch.position[:, None]).max() < 1e-9
