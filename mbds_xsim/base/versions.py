"""Version numbers of the computations on which stored results depend.

A result that is kept on disk is named by the content of the work and by these numbers, never by the
text of the code: names and comments may change without losing hours of work. Raise a number in the
change that makes its results differ. `tests/test_versions.py` holds golden figures of a few cases,
and fails if this was forgotten. An adapter's own number is `Adapter.revision`.
"""

from __future__ import annotations

PHYSICS = 4
"""Version of the starts, inputs and reference solutions of a scene."""

CHECKS = 27
"""Version of the checks' figures and verdicts, and of the studies' results from them."""

MODELS = 6
"""Version of the predictions of learned models and of the figures computed from them."""
