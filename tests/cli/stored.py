"""Results as `mbds-xsim` writes them, to be compared with others."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from mbds_xsim.report.files import results_json
from mbds_xsim.studies.tradeoff import Point, Ratio
from tests import results
from tests.command_line import Ended

Json = dict[str, Any]
Edit = Callable[[Json], object]
Compare = Callable[..., tuple[Ended, Json]]

KEPT = Path(__file__).parents[2] / "reports" / "3ladder.json"


def validation() -> Json:
    return json.loads(KEPT.read_text())


def tradeoff() -> Json:
    """Two methods at two steps, of which the larger breaks a budget."""
    plain = Point(steps_per_frame=2, step_s=0.01, kind="done", error_m=1e-4, wall_s=0.01)
    far = {"steps_per_frame": 1, "step_s": 0.02, "error_m": 1e-2, "broken": ("gap",)}
    points = (msgspec.structs.replace(plain, **far), plain)
    methods = ("RK4", "Euler")
    study = results.tradeoff(
        *(results.curve("mujoco", method, *points, measured_order=4.0) for method in methods),
        ratios=(Ratio(error_m=1e-3, budget=True, wall_s=(0.01, 0.1), best=0),),
        measured=2,
    )
    return json.loads(results_json([study]))


def match() -> Json:
    return json.loads(msgspec.json.encode(results.matched(results.found())))


def stability() -> Json:
    return json.loads(results_json([results.survey()]))
