"""The limits of the campaigns hold."""

from __future__ import annotations

import re
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st

from tests.fuzz import campaign
from tests.fuzz.campaign import CASES, TooLong, cases_of, fuzz, run_command


def test_there_are_as_many_cases_as_promised() -> None:
    tests = [path.read_text("utf-8") for path in Path(__file__).parent.glob("test_*.py")]
    assert set(re.findall(r'@fuzz\(\s*"(\w+)"', "".join(tests))) == CASES.keys()
    assert sum(CASES.values()) >= 300
    assert sum(map(cases_of, CASES)) >= campaign._ALL


@pytest.mark.parametrize("name", CASES)
def test_a_campaign_has_its_cases(name: str) -> None:
    numbers: list[int] = []

    @fuzz(name, number=st.integers())
    def test(number: int) -> None:
        numbers.append(number)

    test()

    assert len(numbers) == cases_of(name)


def test_a_case_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "_SECONDS", 1)

    with pytest.raises(TooLong), campaign._limits():
        time.sleep(5)


def test_a_case_gets_no_more_memory_than_allowed() -> None:
    with pytest.raises(MemoryError), campaign._limits():
        np.empty(campaign._BYTES + 2**28, dtype=np.uint8)


def test_a_refusal_is_one_line_and_code_2() -> None:
    ended = run_command("inspect", "nowhere.h5")

    assert (ended.code, ended.out) == (2, "")
    assert ended.err.startswith("mbds-xsim: nowhere.h5")
