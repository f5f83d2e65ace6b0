"""The shipped suite of learned models, on every model that is registered."""

from __future__ import annotations

import pytest

from mbds_xsim.learn.model import model_names
from mbds_xsim.testing.models import ModelContract


class TestContract(ModelContract):
    @pytest.fixture(params=model_names())
    def name(self, request: pytest.FixtureRequest) -> str:
        name: str = request.param
        return name
