"""Tests for authors of adapters: the contract suite and the ladder of check cases.

The suite for learned models is in `mbds_xsim.testing.models`, because it needs torch. The suites
need pytest, the cases do not.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if "pytest" in sys.modules:
    # Without this, a failing assert in the shipped suites shows no values.
    sys.modules["pytest"].register_assert_rewrite(
        "mbds_xsim.testing.contract",
        "mbds_xsim.testing.contact_contract",
        "mbds_xsim.testing.models",
    )

from mbds_xsim.testing.case import Case
from mbds_xsim.testing.cases import CASES
from mbds_xsim.testing.ladder import measured_order

if TYPE_CHECKING:
    from mbds_xsim.testing.contract import AdapterContract

__all__ = ["CASES", "AdapterContract", "Case", "measured_order"]


def __getattr__(name: str) -> object:
    """Load the suite only when it is asked for, because it needs pytest."""
    if name != "AdapterContract":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from mbds_xsim.testing.contract import AdapterContract

    return AdapterContract
