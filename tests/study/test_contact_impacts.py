"""The study of contact, on impacts whose outcome is known."""

from __future__ import annotations

import numpy as np
import pytest

from mbds_xsim.scene.scene import Ground
from mbds_xsim.simulate.adapter import Adapter
from mbds_xsim.studies.contact import PULL, ContactBench, ball, reason
from mbds_xsim.studies.contact.impacts import rebounds


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_matched_engines_give_back_what_is_asked(grounded: Adapter, restitution: float) -> None:
    """The error is within the scene's budget plus gravity's effect during an impact."""
    bench = ContactBench(grounded.name, "matched", "balldrop")
    if value := grounded.cannot_hold(ball(Ground(0.43, restitution), bench.clock(0.01, 0.1))[0]):
        assert reason(rebounds(bench, restitution, 2.0)[2]).endswith(value)
        return
    time = grounded.contact_scales(bench.settings).time

    kept, duration, _ = rebounds(bench, restitution, 2.0)

    assert np.abs(kept - restitution).max() <= 0.01 + 2.0 * PULL * time / 2.0
    bounced = np.isfinite(duration)
    assert bounced.all() == (restitution > 0.0)
    assert np.all(duration[bounced] <= 3.0 * max(time, bench.settings.step))


def test_the_default_contact_of_mujoco_knows_no_restitution() -> None:
    pytest.importorskip("mujoco")

    kept, _, _ = rebounds(ContactBench("mujoco", "native", "balldrop"), 1.0, 1.0)

    np.testing.assert_array_equal(kept, 0.0)


def test_the_arrival_is_where_and_as_fast_as_asked() -> None:
    """Arrivals are seen in an engine of impulses, which rebounds within two steps of the touch."""
    pytest.importorskip("dartpy")
    bench = ContactBench("dart", "native", "balldrop")
    gravity_in_a_step = PULL * bench.settings.step

    kept, duration, motion = rebounds(bench, 1.0, 5.0)

    np.testing.assert_allclose(kept, 1.0 + gravity_in_a_step / 5.0, atol=2e-4)
    assert np.all((duration >= -1e-9) & (duration <= 2.0 * bench.settings.step))
    assert motion.failures == (None,) * len(motion)
