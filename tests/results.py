"""Results made by hand: a trade-off, matched settings, and a map of stability."""

from __future__ import annotations

from typing import Any

import msgspec

from mbds_xsim.studies.match import SCHEMA as MATCH
from mbds_xsim.studies.match import Match, MatchedSettings
from mbds_xsim.studies.stability import SCHEMA as STABILITY
from mbds_xsim.studies.stability import MapCell, Panel, Survey
from mbds_xsim.studies.tradeoff import SCHEMA, CurveResult, Point, Tradeoff

_RUN: dict[str, Any] = {
    "versions": {"mujoco": "4.0.0"},
    "machine": "a machine",
    "workers": 1,
    "measured": 1,
    "kept": 0,
    "wall_s": 1.0,
}
_PAIR: dict[str, Any] = {"scene": "pair", "seed": 0, "left_out": {}}
_WAY: dict[str, Any] = {"engine": "mujoco", "version": "4.0.0", "method": "RK4"}


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
        **_PAIR,
        description="two bodies",
        command="mbds-xsim tradeoff pair",
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
        busy=1.0,
        **_RUN,
    )
    return msgspec.structs.replace(plain, **other)


def found(**other: Any) -> MatchedSettings:
    """Settings of an engine that keep the budgets."""
    plain = MatchedSettings(
        **_WAY,
        steps_per_frame=2,
        step_s=0.01,
        options={},
        meets_budget=True,
        reasons=(),
        held_out=60,
        wall_per_simulated_s=0.01,
        cpu_per_simulated_s=0.01,
        error_1s_m=1e-4,
        error_weighted_m=1e-4,
        constraint_gap_m=1e-6,
        energy_balance=1e-5,
        used_method="RK4",
        used_steps_per_frame=4,
        cost_ratio=0.5,
        trials=9,
    )
    return msgspec.structs.replace(plain, **other)


def matched(*engines: MatchedSettings, **other: Any) -> Match:
    """Matched settings of a scene called pair."""
    plain = Match(
        schema=MATCH,
        **_PAIR,
        command="mbds-xsim match pair",
        held_out_seed=1,
        trajectories=2,
        held_out=20,
        machine="a machine",
        engines=engines,
    )
    return msgspec.structs.replace(plain, **other)


def survey() -> Survey:
    """A map of one cell, which is stable."""
    how = _WAY | {"family": "Runge–Kutta", "profile": "matched"}
    cell = MapCell(
        key="k",
        study="spin",
        value=10.0,
        **how,
        options={},
        step_s=0.01,
        duration_s=1.0,
        limit_s=30.0,
        machine="a machine",
        outcome="stable",
        told="nobody",
        energy=1e-4,
    )
    return Survey(
        schema=STABILITY,
        study="spin",
        sentence="a body",
        quantity="spin",
        unit="rad/s",
        values=(10.0,),
        steps_s=(0.01,),
        duration_s=1.0,
        criteria="stable: finite",
        panels=(Panel(**how, cells=((cell,),)),),
        left_out={},
        unknown={},
        command="mbds-xsim stability spin",
        **_RUN,
    )
