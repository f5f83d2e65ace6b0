"""What the words mean with which a run ended, and whose words they are."""

from __future__ import annotations

import re

from mbds_xsim.state import Failure
from mbds_xsim.study.stability.rows import Outcome, Told

__all__ = ["meaning", "who_told"]

# How the words of engines begin that adapters hand on; every other reason is an adapter's own.
_ENGINES_WORDS = re.compile(
    r"DART: |WARNING|Nan, Inf or huge value|Inertia matrix is too close to singular|"
    r"Newton's method stopped|the linear solver failed|\w*(Error|Exception)\b"
)
# The first that is found counts.
_MEANINGS: tuple[tuple[str, Outcome], ...] = (
    (r"blow-up|speed passes|not finite|not a number|huge value|[Nn]on-finite", "blows up"),
    (r"in the ground", "sinks in"),
    (r"\bcuts\b", "clamped"),
    (r"Newton|linear solver|SolverError|solver failed|solved to", "gives up"),
)


def who_told(failure: Failure | None) -> Told:
    """Tell whether a failure is in an engine's own words or those of its adapter's watch."""
    if failure is None:
        return "nobody"
    return "engine" if _ENGINES_WORDS.match(failure.reason) else "adapter"


def meaning(failure: Failure | None) -> Outcome:
    """Tell what a failure is about."""
    reason = "" if failure is None else failure.reason
    return next((what for words, what in _MEANINGS if re.search(words, reason)), "ends early")
