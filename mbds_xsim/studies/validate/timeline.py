"""Contact packed for the strips under the viewer: heights, slips, which spheres touch and when."""

from __future__ import annotations

from typing import Any

import numpy as np

from mbds_xsim.measure.result import Evidence, Validation
from mbds_xsim.report.animation import encoded, in_base64
from mbds_xsim.studies.validate.episodes import Contact


def pack(
    validation: Validation, evidence: Evidence, contacts: tuple[Contact | None, ...], count: int
) -> dict[str, Any]:
    """Give what the script of the strips reads, ready for JSON.

    Args:
        validation: With the ends of what is known.
        evidence: Motions of the engines and the reference.
        contacts: Of the reference, then of the engine results; those that crashed are left out.
        count: How many of the trajectories the viewer has.
    """
    reference = validation.reference
    known = () if reference is None else reference.known_s
    found = [contact for contact in contacts if contact is not None]
    return {
        "step": evidence.scene.clock.frame,
        "frames": len(evidence.reference.time),
        "spheres": len(evidence.scene.contacts),
        "ends": list(known[:count]) or [None] * count,
        "slips": any(np.nan_to_num(contact.slip).any() for contact in found),
        "entries": [_entry(contact, count) for contact in found],
    }


def reading(evidence: Evidence, *, slips: bool) -> str:
    """Say how to read the strips."""
    lanes = _lanes([sphere.body for sphere in evidence.scene.contacts])
    slip = (
        " Slip: mean speed of the points that touch along the ground, 0 where they roll or stick."
        if slips
        else ""
    )
    several = (
        " Where several may touch at once, frames cannot tell which one the ground pushed: all are "
        "marked."
        if lanes
        else ""
    )
    return (
        "Height: from the ground to the lowest contact sphere, below 0 where it overlaps."
        f"{slip} Touch{f' ({lanes})' if lanes else ''}: pale where the ground carries, solid below "
        "a triangle where it hits. In the motion, a dot marks where a sphere touches, a halo where "
        f"it hits.{several}"
    )


def _lanes(names: list[str]) -> str:
    """Say which contact sphere each lane of the strips is, where there are several."""
    if len(names) == 1:
        return ""
    if len(set(names)) == 1:
        return f"{len(names)} lanes, one for each sphere of {names[0]}"
    return f"lanes from above: {', '.join(names)}"


def _entry(contact: Contact, count: int) -> dict[str, str]:
    """Bits of a step are the spheres that touch, then whether it has an impact."""
    flags = np.concatenate([contact.touch, contact.impact[..., None]], axis=2)[:count]
    return {
        "gap": encoded(contact.gap[:count], "<f4"),
        "slip": encoded(contact.slip[:count], "<f4"),
        "flags": in_base64(np.packbits(flags, axis=2)),
    }
