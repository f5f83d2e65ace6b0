"""Versions of what stored results depend on.

A result that is kept on disk is named by the content of the work and by these numbers, never by the
text of the code: names and comments may change without losing hours of work. Raise a number in the
change that makes its results differ. `tests/test_versions.py` holds golden figures of a few cases,
and fails where somebody forgot. An adapter's own number is `Adapter.revision`.
"""

from __future__ import annotations

PHYSICS = 4
"""Starts, inputs and reference solutions of a scene."""

CHECKS = 19
"""Figures and verdicts of checks on a trajectory, and what studies derive from them."""

MODELS = 5
"""Predictions of learned models, and figures of them."""
