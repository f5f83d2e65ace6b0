"""All studies by name; a further one is a file, and a line here."""

from __future__ import annotations

from mbds_xsim.errors import UnknownName
from mbds_xsim.study.stability import (
    builtin,
    chain_length,
    friction,
    links,
    mass_ratio,
    pace,
    redundancy,
    restitution,
    rungs,
    singular,
    spin,
    stiffness,
    swing,
    throw,
    wheels,
)
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDIES", "study_named"]

_PARTS = (
    builtin, mass_ratio, chain_length, rungs, redundancy, singular, stiffness, spin, wheels, throw,
    swing, pace, links, friction, restitution,
)  # fmt: skip

STUDIES: dict[str, Study] = {part.STUDY.name: part.STUDY for part in _PARTS}
"""In the order in which they are listed and run."""


def study_named(name: str) -> Study:
    """Find a study.

    Raises:
        UnknownName: There is none of that name.
    """
    if name not in STUDIES:
        raise UnknownName.of("study", name, list(STUDIES))
    return STUDIES[name]
