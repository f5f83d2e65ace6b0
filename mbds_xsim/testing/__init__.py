"""What an adapter's author runs: the contract suite and the ladder of check cases.

That of learned models is in `mbds_xsim.testing.models`, for it needs torch.
"""

from __future__ import annotations

import pytest

# Without it a failing assert in the shipped suite shows no values.
pytest.register_assert_rewrite(
    "mbds_xsim.testing.contract",
    "mbds_xsim.testing.contact_contract",
    "mbds_xsim.testing.models",
)

from mbds_xsim.testing.case import Case  # noqa: E402
from mbds_xsim.testing.cases import CASES  # noqa: E402
from mbds_xsim.testing.contract import AdapterContract, measured_order  # noqa: E402

__all__ = ["CASES", "AdapterContract", "Case", "measured_order"]
