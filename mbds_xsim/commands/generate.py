"""`mbds-xsim plan` and `generate`: estimate the cost of data sets, and make checked ones."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Exit, Option

from mbds_xsim.base.isolate import LIMIT, Conduct
from mbds_xsim.base.text import counted
from mbds_xsim.commands import shared
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Block, Column, Remark, Remarks, Text, table_of

if TYPE_CHECKING:
    from mbds_xsim.dataset.estimate import CostPlan, Estimate
    from mbds_xsim.dataset.generate import Generated


_SIZES = ((1e15, "PB"), (1e12, "TB"), (1e9, "GB"), (1e6, "MB"), (1e3, "kB"), (1.0, "B"))
_TIMES = ((8766.0, "years"), (24.0, "days"), (1.0, "h"), (1 / 60, "min"), (1 / 3600, "s"))
_FIGURES = ("each", "simulate", "check", "core-h", "wall", "size", "published")


@shared.command("data", writes="json")
def plan(
    to: shared.Outputs,
    scene: shared.SceneName,
    trajectories: Annotated[int, Option(help="Number of trajectories planned.", min=1)] = 15_000,
    engines: shared.EngineNames = None,
    settings: Annotated[
        str, Option(help="matched, native, files of settings, or several: matched,native.")
    ] = "matched",
    sample: Annotated[
        int, Option(help="Trajectories of each of the two measured shards.", min=2, max=1000)
    ] = 6,
    workers: Annotated[
        int | None, Option(help="Processes that will work; all cores when left out.", min=1)
    ] = None,
    limit: shared.TimeLimit = LIMIT,
) -> None:
    """Measure a few trajectories, and estimate core-hours and bytes of a data set of any size.

    Examples:
        mbds-xsim plan 6pendulum --trajectories 1000000000
        mbds-xsim plan 3ladder --engines mujoco,dart --trajectories 15000 --workers 64
    """
    from mbds_xsim.dataset.estimate import plan as run
    from mbds_xsim.simulate.choice import Choice

    choice = Choice.parse(engines=engines, profiles=settings, limit=limit)
    with shared.progress_on(to.console) as progress:
        conduct = Conduct(workers, meter=progress)
        cost_plan = run(shared.scene_named(scene), choice, trajectories, conduct, sample=sample)
    to.answer(plan_blocks(cost_plan), cost_plan, "plan")
    raise Exit(0 if all(not estimate.failure for estimate in cost_plan.estimates) else 1)


def plan_blocks(plan: CostPlan) -> Iterator[Block]:
    """Lay out the estimated cost of a data set, one row per variant."""
    cores = counted(plan.workers, "core")
    yield Text(f"{plan.scene}: {counted(plan.trajectories, 'trajectory')} on {cores}")
    yield table_of(["variant", *map(Column, _FIGURES)], map(_cells, plan.estimates))
    failed = [Remark(e.variant, e.failure, "fail") for e in plan.estimates if e.failure]
    left_out = [Remark(f"{name} left out", reason) for name, reason in plan.left_out.items()]
    yield Remarks((*failed, *left_out))
    measurements = [one.measured for one in plan.estimates if one.measured is not None]
    if measurements:
        spread = max(one.spread for one in measurements)
        yield Text(
            f"measured on 2 × {measurements[0].sample} trajectories each, which differ by up to "
            f"{spread:.0%}; core time and size of each are this machine's, the "
            "published share is the sample's"
        )


def _cells(estimate: Estimate) -> tuple[str, ...]:
    measured = estimate.measured
    if measured is None or estimate.core_hours is None:
        return (estimate.variant, *[quantity.NONE] * len(_FIGURES))
    return (
        estimate.variant,
        quantity.span(measured.trajectory_s),
        f"{measured.shares['simulate_s']:.0%}",
        f"{measured.shares['check_s']:.0%}",
        quantity.number(estimate.core_hours),
        _scaled(estimate.wall_hours or 0.0, _TIMES),
        _scaled(estimate.bytes or 0.0, _SIZES),
        f"{measured.published} of {2 * measured.sample}",
    )


def _scaled(value: float, units: tuple[tuple[float, str], ...]) -> str:
    """Format a value in the largest unit in which it is at least 1."""
    size, unit = next((pair for pair in units if value >= pair[0]), units[-1])
    return f"{value / size:.3g} {unit}"


@shared.command("data", writes="json")
def generate(
    to: shared.Outputs,
    scenes: shared.SceneNames,
    out: Annotated[Path, Option(metavar="DIR", help="Folder of the data, made if needed.")],
    engines: shared.EngineNames = None,
    settings: Annotated[
        str,
        Option(
            help="matched or a file of `match --out` (certified), native or a file with a name of "
            "its own (uncertified), or several."
        ),
    ] = "matched",
    trajectories: Annotated[
        int, Option(help="Number of trajectories drawn; rejected ones are not replaced.", min=1)
    ] = 15_000,
    seed: shared.Seed = 0,
    noise: Annotated[bool, Option(help="Random forces.")] = True,
    workers: shared.WorkerCount = None,
    limit: Annotated[float, shared.seconds("Time limit of each shard [s].")] = LIMIT,
    scheduler: Annotated[
        str | None,
        Option(
            metavar="ADDRESS",
            help="Dask scheduler in place of --workers; its workers must see DIR.",
        ),
    ] = None,
) -> None:
    """Make data sets: simulate, check every trajectory, publish those that pass.

    Examples:
        mbds-xsim generate 6pendulum --engines mujoco --trajectories 1000 --out data
        the same command continues after an interruption
    """
    from mbds_xsim.dataset.cluster import carrier_of
    from mbds_xsim.dataset.generate import Request
    from mbds_xsim.dataset.generate import generate as run
    from mbds_xsim.report.progress import GeneratingBar
    from mbds_xsim.simulate.choice import Choice

    loaded = tuple(map(shared.scene_named, scenes))
    choice = Choice.parse(engines=engines, profiles=settings, limit=limit)
    request = Request(loaded, choice, trajectories, out, seed, noise)
    with ExitStack() as stack:
        carry_out, at_once = carrier_of(stack, scheduler, workers, out)
        progress = stack.enter_context(GeneratingBar(to.console))
        generated = run(request, workers=at_once, progress=progress, carry_out=carry_out)
    to.answer(_outcome(generated), generated, "generate")
    whole = not generated.failed and all(count.published for count in generated.variants)
    raise Exit(0 if whole else 1)


def _outcome(generated: Generated) -> Iterator[Block]:
    """Describe the outcome: published and rejected trajectories, and why."""
    yield table_of(
        ["file", ">drawn", ">published", ">rejected", ">MB", "rejected by"],
        [
            [
                count.file,
                *map(str, (count.trajectories, count.published, count.rejected)),
                f"{count.bytes / 1e6:.4g}",
                ", ".join(f"{cause} {number}" for cause, number in count.rejected_by.items()),
            ]
            for count in generated.variants
        ],
    )
    yield Remarks.of((f"{pair} left out", reason) for pair, reason in generated.left_out.items())
    yield Remarks.of((f"{variant} failed", why) for variant, why in generated.failed.items())
    rate = generated.made / generated.wall_s
    trajectories = counted(generated.made, "trajectory")
    yield Text(f"{trajectories} made in {generated.wall_s:.1f} s ({rate:.3g}/s)")
