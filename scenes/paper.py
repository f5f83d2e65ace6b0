"""Parameters that the scenes take from the paper, and texts that credit it."""

from __future__ import annotations

import math

from mbds_xsim.scene.scene import Ground

NOISE = 0.1
"""Standard deviation of the noise force on a particle [N]; the paper has noise, but the
figure is the project's."""
DAMPING_RATIO = 0.022
"""The paper's ζ, read as that of the contact: half a period of a damped oscillator."""
GROUND = Ground(
    friction=0.43,
    restitution=math.exp(-math.pi * DAMPING_RATIO / math.sqrt(1.0 - DAMPING_RATIO**2)),
)
"""Ground; its restitution is the share of velocity that half a period of such a contact leaves."""
SOURCE = (
    "MBDS paper (particles, gravity, frames, friction, damping ratio); geometry, intervals and "
    "reading the damping ratio as restitution: mbds-xsim"
)
SMOOTH_SOURCE = "MBDS paper (particles, gravity, frames); geometry and intervals: mbds-xsim"
"""Source of scenes without contact."""
