"""The shipped contract suite on every registered adapter."""

from __future__ import annotations

import pytest

from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Adapter
from mbds_xsim.testing import AdapterContract


class TestContract(AdapterContract):
    @pytest.fixture
    def adapter(self, request: pytest.FixtureRequest, engine: str) -> Adapter:
        del engine
        adapter: Adapter = request.getfixturevalue("adapter")
        return adapter


class TestContractOfTheReference(AdapterContract):
    @pytest.fixture
    def adapter(self) -> Adapter:
        return registry.load_adapter(registry.REFERENCE)
