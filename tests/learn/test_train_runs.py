"""Runs are the same on a cluster and after an interruption, and tell whether they are level."""

from __future__ import annotations

import pytest
import torch

from mbds_xsim.dataset.cluster import Cluster
from mbds_xsim.learn import runs
from mbds_xsim.learn.curves import read_curve
from mbds_xsim.learn.model_file import read_model
from mbds_xsim.learn.train import CurvePoint, Training
from mbds_xsim.learn.trainings import carry, planned
from tests.farm import Farm
from tests.learn.carried import Deaf, carry_out, interrupt
from tests.learn.conftest import Ask


@pytest.mark.slow
def test_a_cluster_trains_the_same_models(farm: Farm, ask: Ask) -> None:
    pytest.importorskip("distributed")
    here, there = ask(on="each"), ask(on="each", out="there")
    carry_out(here)
    farm.worker()
    farm.wait_for(1)
    there.out.mkdir()
    with Cluster(farm.address, there.out) as cluster:
        carry(planned(there), workers=cluster.workers, carrier=cluster, progress=Deaf())
    for name in ("mujoco-s0", "pybullet-s0"):
        one, two = (
            read_model(next(request.out.rglob(f"{name}.pt")))[0] for request in (here, there)
        )
        assert all(map(torch.equal, one.state_dict().values(), two.state_dict().values()))


@pytest.mark.parametrize("model", ["gns", "sgnn", "hgnn"])
def test_an_interrupted_campaign_goes_on_to_the_same_bits(ask: Ask, model: str) -> None:
    carry_out(ask(model, out="whole"))
    interrupt(ask(model, out="halted"))
    (run,) = planned(ask(model, out="halted")).runs
    assert run.checkpoint.exists()
    assert not run.path.exists()
    carry_out(ask(model, out="halted"))
    whole = read_model(ask(model, out="whole").out / f"{run.name}.pt")[0].state_dict()
    resumed = read_model(run.path)[0].state_dict()
    assert all(torch.equal(value, resumed[key]) for key, value in whole.items())
    curves = [
        read_curve(ask(out=out).out / f"{run.name}.curve.json") for out in ("whole", "halted")
    ]
    assert curves[0] == curves[1]


def test_the_telling_of_level_follows_the_curve(ask: Ask) -> None:
    (run,) = planned(ask()).runs
    model, _, parts = runs.prepared(run)
    level = [
        CurvePoint(4 * k + 4, 1.0, error, 1e-3)
        for k, error in enumerate((4.0, 2.0, 1.0, 1.0, 0.99))
    ]
    falling = [*level[:-1], CurvePoint(20, 1.0, 0.5, 1e-3)]
    for curve, word in ((level, "yes"), (falling, "no")):
        training = Training(model, curve, ended="steps", wall_s=1.0)
        assert runs.facts_of(run, training, parts)["level"] == word
