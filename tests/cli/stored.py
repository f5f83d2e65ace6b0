"""Results as `mbds-xsim` writes them, to be compared with others."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from mbds_xsim.report.files import results_json
from mbds_xsim.studies.ablate.analyse import Ablation, Floor, WeakenedEffect
from mbds_xsim.studies.contact import ContactFigure
from mbds_xsim.studies.contact.present import ContactStudy
from mbds_xsim.studies.releases.steps import History, Release, ReleaseRow
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


def ablation() -> Json:
    """Two engines that pass, and an effect that is needed."""
    floor = Floor(1e-4, 1e-3, 1e-3, 1e-2)
    rows = [WeakenedEffect("noise", factor, "none", "needed", "", 1e-3) for factor in (0.0, 0.5)]
    found = Ablation(
        scene="pair", description="", judge="the reference", judged_s=(1.0, 1.0), ends="",
        duration_s=1.0, length_m=1.0, floor=floor, floor_engines=("dart", "mujoco"), failed={},
        left_out={}, rows=tuple(rows), degrees_of_freedom=1, joint_coordinates=1,
        loop_conditions=0, contact_spheres=0, sizes=(), trajectories=(0,), seed=0, versions={},
        machine="", command="", wall_s=1.0,
    )  # fmt: skip
    return json.loads(msgspec.json.encode(found))


def contact() -> Json:
    """Two rebounds and a limit, all as asked."""
    bounced = ContactFigure("dart", "native", "restitution", "1", 0.5)
    at = {"restitution": 0.5, "speed": 1.0}
    figures = [
        msgspec.structs.replace(bounced, at=at),
        msgspec.structs.replace(bounced, at=at | {"speed": 2.0}),
        ContactFigure("dart", "native", "free spin", "rad/s", 5.0, note="told at 10 rad/s: no"),
    ]
    found = ContactStudy({"dart": "1"}, ("native",), {}, tuple(figures), (), "", "", 1.0)
    return json.loads(msgspec.json.encode(found)) | {"schema": "mbds-xsim/contact/1"}


def history() -> Json:
    """One release with one row."""
    row = ReleaseRow(key="0a", release="1.0", case="pair", way="native", error_m=1e-3, cpu_s=1.0)
    found = History(
        schema="mbds-xsim/releases/1", engine="dart", package="dartpy", command="", machine="",
        versions={}, measured=1, kept=0, wall_s=1.0, change_log="", releases=(Release("1.0"),),
        steps=(), rows=(row,),
    )  # fmt: skip
    return json.loads(msgspec.json.encode(found))
