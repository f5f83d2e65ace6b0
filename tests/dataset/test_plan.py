"""`mbds-xsim plan`: extrapolated bytes are those of the real thing, costs add up."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import Conduct, Crash, Silent
from mbds_xsim.commands.generate import plan_blocks
from mbds_xsim.dataset.estimate import CostPlan, ShardCost, estimate, measure, plan
from mbds_xsim.dataset.shard import STAGES
from mbds_xsim.dataset.variant import Variant
from mbds_xsim.report.terminal import print_blocks
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.choice import Choice
from tests.dataset.conftest import Make

KNOWN = ShardCost(
    sample=6,
    published=12,
    start_s=2.0,
    shard_s=3.0,
    trajectory_s=0.5,
    spread=0.1,
    shares=dict.fromkeys(STAGES, 0.25),
    shard_bytes=1000.0,
    trajectory_bytes=100.0,
    audit_s=0.0,
)


class Silence(Silent):
    def begin(self, total: int, done: int = 0) -> None:
        del done
        self.total, self.names = total, list[str]()

    def advance(self, work: str) -> None:
        self.names.append(str(work))


@pytest.fixture(scope="module")
def variant(rod: Scene) -> Variant:
    (contender,), _ = Choice.parse(engines="mujoco").contenders(rod)
    return Variant(rod, contender, 0, True)


@pytest.fixture(scope="module")
def measured(variant: Variant) -> ShardCost:
    return measure(variant, 6, audit=True)


def test_bytes_are_those_that_generate_writes(
    variant: Variant, measured: ShardCost, make: Make, tmp_path: Path
) -> None:
    """The size of 700 trajectories is extrapolated from shards of 1 and 6."""
    make(tmp_path, trajectories=700)
    cost = estimate(variant, measured, 700, audit_s=0.0, workers=1)
    real = sum(path.stat().st_size for path in tmp_path.rglob("*.h5") if path.name != "joint.h5")
    assert cost.shards == len(list(variant.items(700)))
    assert cost.bytes == pytest.approx(real, rel=0.03)


def test_what_is_measured_can_be(measured: ShardCost) -> None:
    assert measured.published == 12
    assert measured.trajectory_s > 0
    # The time is not checked: a pause, as for garbage collection, may fall into any of the runs.
    assert measured.audit_s is not None
    assert sum(measured.shares.values()) == pytest.approx(1.0)
    assert measured.shares["simulate_s"] > 0


@pytest.mark.parametrize("count", [0, 10**15 + 1, 10**400], ids=["none", "more", "endless"])
def test_no_plan_is_made_for_numbers_beyond_all_use(rod: Scene, count: int) -> None:
    with pytest.raises(InputError, match=r"^--trajectories: got \d{1,60}, allowed is 1 to 10{15}$"):
        plan(rod, Choice(("mujoco",)), count, Conduct(0))


def test_costs_add_up_at_any_size(variant: Variant) -> None:
    for count in (1, 300, 301, 15_001, 4_000_000_000):
        cost = estimate(variant, KNOWN, count, audit_s=7.0, workers=8)
        shards = variant.shard_count(count)
        seconds = 2.0 * min(8, shards) + 3.0 * shards + 0.5 * count + 7.0 * -(-count // 15_000)
        assert cost.shards == shards
        assert cost.core_hours == pytest.approx(seconds / 3600)
        assert cost.wall_hours == pytest.approx(seconds / 3600 / min(8, shards))
        assert cost.bytes == pytest.approx(1000 * shards + 109 * count)


@pytest.mark.parametrize("name", ["5pendulum", "3ladder", "8000pendulum"])
def test_few_trajectories_are_work_for_many_processes(name: str) -> None:
    scene = registry.load_scene(name)
    (contender,), _ = Choice.parse(engines="mujoco").contenders(scene)
    variant = Variant(scene, contender, 0, True)
    longer = list(variant.items(2500))
    for count in (1, 16, 17, 300, 2499):
        items = list(variant.items(count))
        assert variant.shard_count(count) == len(items)
        assert [index for item in items for index in item.indices] == list(range(count))
        assert [item.first for item in items] == [item.first for item in longer[: len(items)]]
        assert max(item.count for item in items) <= max(16, count / 9)
    assert len(list(variant.items(300))) >= 15


def test_plan_measures_every_engine_apart(rod: Scene) -> None:
    progress = Silence()
    choice = Choice.parse(engines="mujoco", profiles="matched,native")
    costs = plan(rod, choice, 10_000_000_000, Conduct(4, meter=progress), sample=2)
    assert [one.variant for one in costs.estimates] == ["mujoco-matched", "mujoco-native"]
    assert progress.names == ["mujoco-matched", "mujoco-native"]
    first, second = (one.measured for one in costs.estimates)
    assert first is not None
    assert second is not None
    assert first.audit_s is not None
    assert second.audit_s is None  # the reference is the same for both
    assert all(one.core_hours is not None and one.core_hours > 0 for one in costs.estimates)


def test_a_crash_is_told_not_extrapolated(variant: Variant) -> None:
    cost = estimate(variant, Crash("the process ended by signal 11"), 5, audit_s=0.0, workers=2)
    assert (cost.core_hours, cost.bytes, cost.measured) == (None, None, None)
    stream = io.StringIO()
    print_blocks(plan_blocks(CostPlan("rod", 5, 2, (cost,), {})), Console(file=stream, width=120))
    assert "✗ mujoco-matched: the process ended by signal 11" in stream.getvalue()


def test_the_table_shows_sizes_people_know(variant: Variant) -> None:
    cost = estimate(variant, KNOWN, 4_000_000_000, audit_s=0.0, workers=1)
    stream = io.StringIO()
    costs = CostPlan("rod", 4_000_000_000, 1, (cost,), {"dart": "no"})
    print_blocks(plan_blocks(costs), Console(file=stream, width=120))
    text = stream.getvalue()
    for words in (
        "4 000 000 000 trajectories",
        "64.6 years",
        "449 GB",
        "12 of 12",
        "dart left out",
    ):
        assert words in text
    small = replace(cost, wall_hours=0.5, bytes=2500.0)
    stream = io.StringIO()
    print_blocks(plan_blocks(CostPlan("rod", 5, 1, (small,), {})), Console(file=stream, width=120))
    assert "30 min" in stream.getvalue()
    assert "2.5 kB" in stream.getvalue()
