"""Rows that are kept: as they were written, or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from mbds_xsim.measure.runner import Keyed, Store


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
