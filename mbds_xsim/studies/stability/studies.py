"""All studies by name; a further one is a `Study` beside these, and a word here."""

from __future__ import annotations

from mbds_xsim.base.errors import UnknownName
from mbds_xsim.studies.stability import chains, cranks, grounds
from mbds_xsim.studies.stability.definition import Study

_ALL = (
    chains.SCENES, chains.MASS_RATIO, chains.CHAIN_LENGTH, chains.LOOPS, cranks.REDUNDANCY,
    cranks.SINGULAR, chains.STIFFNESS, chains.SPIN, grounds.WHEELS, grounds.THROW, chains.SWING,
    chains.PACE, chains.LINKS, grounds.FRICTION, grounds.RESTITUTION,
)  # fmt: skip

STUDIES: dict[str, Study] = {study.name: study for study in _ALL}
"""In the order in which they are listed and run."""


def study_named(name: str) -> Study:
    """Find a study.

    Raises:
        UnknownName: There is none of that name.
    """
    if name not in STUDIES:
        raise UnknownName.of("study", name, list(STUDIES))
    return STUDIES[name]
