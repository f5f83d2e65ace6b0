"""Golden figures of each version of stored results: a change without a new version fails."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

__all__ = ["check_golden", "shadow"]

_FILE = Path(__file__).with_name("golden.json")


def shadow(values: Any) -> float:
    """Return one number that changes with any entry: a weighted sum of all finite entries."""
    flat = np.nan_to_num(np.asarray(values, dtype=np.float64).ravel())
    return float(flat @ np.cos(np.arange(flat.size)))


def check_golden(
    name: str, version: int, figures: dict[str, float], *, rtol: float = 1e-8, atol: float = 1e-10
) -> None:
    """Compare figures with the stored ones of the same version.

    With MBDS_XSIM_GOLDEN=renew in the environment, figures of a new version are stored.
    """
    stored = json.loads(_FILE.read_text()) if _FILE.exists() else {}
    known = stored.get(name, {"version": None, "figures": {}})
    if known["version"] != version:
        assert os.environ.get("MBDS_XSIM_GOLDEN") == "renew", (
            f"golden figures of {name} are of version {known['version']}, not {version}; run "
            "MBDS_XSIM_GOLDEN=renew pytest -k golden"
        )
        stored[name] = {"version": version, "figures": figures}
        _FILE.write_text(json.dumps(stored, indent=1, sort_keys=True) + "\n")
        return
    assert figures == pytest.approx(known["figures"], rel=rtol, abs=atol), (
        f"{name} gives other figures: raise its version, or find out why it should not"
    )
