"""The shipped contract suite on every registered adapter."""

from __future__ import annotations

import pytest

from mbds_xsim.simulate.adapter import Adapter
from mbds_xsim.testing import AdapterContract


class TestContract(AdapterContract):
    @pytest.fixture
    def adapter(self, request: pytest.FixtureRequest, engine: str) -> Adapter:
        del engine
        adapter: Adapter = request.getfixturevalue("adapter")
        return adapter
