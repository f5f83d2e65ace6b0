"""Runs at other steps end with the reference that they are compared with."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import msgspec
import pytest

from mbds_xsim.base.isolate import HERE
from mbds_xsim.measure import campaign, refinement
from mbds_xsim.simulate import timed
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.studies.validate import validate_with_evidence

STEPS = 60


def test_they_end_with_the_reference_of_a_cube_and_show_what_whole_ones_show(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cube = load_scene("simplecubli")
    scene = msgspec.structs.replace(cube, clock=msgspec.structs.replace(cube.clock, steps=STEPS))
    lengths: dict[float, set[int]] = defaultdict(set)
    simulate = timed.simulate

    def watched(scene: Any, batch: Any, engine: str, settings: Any) -> Any:
        lengths[settings.step].add(batch.steps)
        return simulate(scene, batch, engine, settings)

    for module in (campaign, refinement):
        monkeypatch.setattr(module, "simulate", watched)
    choice = Choice(("mujoco",))
    brief = validate_with_evidence(scene, choice=choice, conduct=HERE)[0].engines[0]
    own = lengths.pop(brief.step_s)
    assert own == {STEPS}
    others = set.union(*lengths.values())
    assert max(others) < STEPS // 2  # the cubes fall for some 0.4 s
    monkeypatch.setattr(refinement, "compared", lambda batch, _: batch)
    whole = validate_with_evidence(scene, choice=choice, conduct=HERE)[0].engines[0]
    assert max(set.union(*lengths.values())) == STEPS
    assert brief.findings == whole.findings
    assert [f.check for f in brief.findings].count("consistency of positions") == 1
