"""Do joints stay between their limits, and do stops give no energy?"""

from __future__ import annotations

import numpy as np

from mbds_xsim.checks.conservation import damper_loss, energy_of, input_work
from mbds_xsim.checks.coordinates import coordinate_of
from mbds_xsim.checks.finding import Figures, Record, check
from mbds_xsim.checks.flights import summed


@check("past limits", "penetration")
def past_limits(record: Record) -> Figures | None:
    """Measure how far joints are past their limits: hinges [rad], sliders over the scene's length.

    Of recorded frames, as `penetration`. None where no joint has limits.
    """
    parts = [
        joint.beyond(coordinate_of(record, joint))
        / (1.0 if joint.kind == "hinge" else record.scene.length)
        for joint in record.mechanism.limited
    ]
    return Figures(record.by_frame(parts), [f"joint {j.name}" for j in record.mechanism.limited])


@check("stop passivity", lambda record: record.energy_budget)
def stop_passivity(record: Record) -> Figures | None:
    """Measure the energy that stops create over the energy scale; None where there are none.

    It is what the energy balance gains over each period in which a stop may act, up to any of its
    frames: an impact takes (1 − e²) of the energy of the approach, and rest none. Soft stops that
    have given nothing back yet only show less.
    """
    if not record.mechanism.limited or record.scene.contacts:
        return None
    energy, (loss, error) = energy_of(record), damper_loss(record)
    balance = energy.total - input_work(record) + loss
    stopped = ~record.flying()
    gained = np.zeros(record.finite.shape)
    gained[:, 1:] = summed(np.diff(balance, axis=1)[..., None], stopped)[..., 0]
    rise = np.where(record.finite, np.maximum(gained, 0.0), np.nan)
    return Figures((rise / energy.scale[:, None])[..., None], uncertainty=error / energy.scale)
