"""Stored rows are read as they were written, or not at all."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import pytest

from mbds_xsim.base.isolate import HERE, Task
from mbds_xsim.measure.runner import Keyed, Piece, Store, carry_out


class _Row(Keyed, frozen=True, kw_only=True):
    error: float


@pytest.mark.parametrize(
    ("old", "new"), [(b"0.25", b"0.15"), (b"0.25}", b""), (b'"one"', b'"two"'), (b"{", b"[")]
)
def test_a_row_that_was_changed_is_passed_over(old: bytes, new: bytes, tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    store = Store(path, _Row)
    store.add(_Row(key="one", error=0.25))
    store.add(_Row(key="last", error=1.0))
    whole = path.read_bytes()
    assert whole.count(old) >= 1

    assert set(Store(path, _Row).rows) == {"one", "last"}
    path.write_bytes(whole.replace(old, new, 1))
    assert set(Store(path, _Row).rows) == {"last"}


@pytest.mark.parametrize("workers", [0, 2])
def test_answers_are_kept_in_their_order_as_soon_as_all_of_an_engine_are_there(
    workers: int,
) -> None:
    kept: list[object] = []
    slow = Task(exec, ("import time; time.sleep(0.5)",))
    pieces = [
        Piece("", of, Task(math.factorial, (count,)), kept.append)
        for of, count in (("one", 3), ("other", 4), ("one", 5))
    ]
    last = Piece("", "last", slow, kept.append)

    carry_out([last, *pieces], replace(HERE, workers=workers), defaultdict(float), then=kept.append)

    assert kept.index("one") == kept.index(120) + 1 == kept.index(6) + 2
    assert kept.index("other") == kept.index(24) + 1
    assert (kept[-2:] == [None, "last"]) == bool(workers)
