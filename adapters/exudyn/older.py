"""Translation of listings for earlier releases of Exudyn, which use other names."""

from __future__ import annotations

import re

import exudyn

# First release with today's name, pattern in today's listing, and the text used before.
_EARLIER = (
    ((1, 13), r"\.solution\.file\.write", ".solutionSettings.writeSolutionToFile"),
    ((1, 13), r"\.solution\.sensors\.active", ".solutionSettings.sensorsStoreAndWriteFiles"),
    ((1, 13), r"\.linearSolver\.solverType", ".linearSolverType"),
    ((1, 13), r"\.linearSolver\.ignore", ".linearSolverSettings.ignore"),
    ((1, 13), r"CreateForce(.*?\))", r"AddLoad(items.LoadForceVector\1)"),
    ((1, 13), r"CreateTorque(.*?\))", r"AddLoad(items.LoadTorqueVector\1)"),
    ((1, 13), r"itemNumber=", "markerNumber="),
    ((1, 13), r"sphereRadius=", "radiusSphere="),
    ((1, 13), r"Mass1D\(mass=", "Mass1D(physicsMass="),
    ((1, 13), r"itemNumbers=", "bodyNumbers="),
    ((1, 10), r", TreeLink$", ""),
    ((1, 9), r"(SpringDamper|Constraint)\(bodyNumbers=", r"\1(bodyList="),
    ((1, 8), r"bodyList=", "bodyOrNodeList="),
    ((1, 8), r"CreateGround\(\)", "AddObject(items.ObjectGround())"),
)


def silence() -> None:
    """Stop Exudyn from printing."""
    if hasattr(exudyn, "config"):
        exudyn.config.printToConsole = False
        exudyn.config.suppressWarnings = True
    else:  # before 1.10
        exudyn.SetWriteToConsole(False)
        exudyn.SuppressWarnings(True)


def in_its_words(listing: str) -> str:
    """Return a listing with the names of the installed release."""
    release = tuple(int(number) for number in exudyn.__version__.split(".")[:2])
    for until, pattern, earlier in _EARLIER:
        if release < until:
            listing = re.sub(pattern, earlier, listing, flags=re.MULTILINE)
    return listing
