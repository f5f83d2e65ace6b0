"""A trade-off made by hand."""

from __future__ import annotations

from typing import Any

import msgspec

from mbds_xsim.studies.tradeoff.rows import SCHEMA, CurveResult, Point, Tradeoff


def curve(engine: str, method: str, *points: Point, **other: Any) -> CurveResult:
    """A method of fourth order."""
    plain = CurveResult(
        engine=engine,
        version="1.0",
        method=method,
        family="Runge–Kutta",
        variation="",
        options={},
        order=4,
        measured_order=None,
        points=points,
    )
    return msgspec.structs.replace(plain, **other)


def tradeoff(*curves: CurveResult, **other: Any) -> Tradeoff:
    """A study of one start of a scene called pair."""
    plain = Tradeoff(
        schema=SCHEMA,
        scene="pair",
        description="two bodies",
        command="mbds-xsim tradeoff pair",
        seed=0,
        trajectories=(1,),
        horizon_s=1.0,
        reference_ends_s=None,
        duration_s=4.0,
        length_m=1.0,
        budget={"error_1s": 1e-3, "error": 1e-2},
        contact=False,
        limit_s=30.0,
        curves=curves,
        ratios=(),
        left_out={},
        versions={"mujoco": "4.0.0"},
        machine="a machine",
        workers=1,
        busy=1.0,
        measured=1,
        kept=0,
        wall_s=1.0,
    )
    return msgspec.structs.replace(plain, **other)
