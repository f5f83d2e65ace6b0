"""Points by which motions are compared."""

from __future__ import annotations

import numpy as np

from mbds_xsim.scene.markers import marker_positions, markers
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate.registry import load_scene


def test_particles_are_the_markers_where_every_body_has_some() -> None:
    mechanism, batch = Mechanism.of(load_scene("2ladder")), draw_batch(load_scene("2ladder"), [4])
    native = mechanism.native_rotation(batch.orientation)
    np.testing.assert_array_equal(
        marker_positions(mechanism, batch.position, native),
        mechanism.particle_positions(batch.position, batch.orientation),
    )


def test_a_turn_of_a_body_without_particles_shows() -> None:
    mechanism = Mechanism.of(load_scene("workbench"))
    body, offset = markers(mechanism)
    for bare in np.flatnonzero(mechanism.particles_per_body == 0):
        star = offset[body == bare]
        assert len(star) == 6
        # Masses at the markers have the body's centre of mass and mean moment of inertia.
        np.testing.assert_allclose(star.mean(axis=0), 0.0, atol=1e-15)
        moment = 2.0 * mechanism.mass[bare] * np.mean(np.sum(star**2, axis=1))
        np.testing.assert_allclose(moment, np.trace(mechanism.inertia[bare]))
