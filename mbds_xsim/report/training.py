"""Training on the terminal: what it will cost, how far it is, and what came of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from mbds_xsim.counted import counted
from mbds_xsim.report.bar import Bar

if TYPE_CHECKING:
    from mbds_xsim.learn.runs import Cost
    from mbds_xsim.learn.trainings import TrainingOutcome, TrainingPlan

__all__ = ["TrainingBar", "print_blocked", "print_costs", "print_left_out", "print_outcome"]


class TrainingBar(Bar):
    """Shows steps, runs done, steps a second, time left, and the last validation."""

    def __init__(self, console: Console) -> None:
        super().__init__(
            console,
            BarColumn(bar_width=24),
            TextColumn("{task.fields[runs]}"),
            TextColumn("{task.fields[rate]}"),
            TextColumn("left at most"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[last]}"),
            runs="",
            rate="",
            last="",
        )
        self._console = console
        self._steps: dict[str, int] = {}
        self._taken, self._begin = 0, time.monotonic()
        self._lock = threading.Lock()

    def begin(self, done: int, most_steps: Sequence[int]) -> None:
        """Say how many runs are done, and the most steps of each that is not."""
        self._runs, self._done = done + len(most_steps), done
        self._begin = time.monotonic()
        self._show(total=sum(most_steps), runs=self._count())

    def reached(self, name: str, step: int, error: float, *, before: bool) -> None:
        """Tell how far a run is; steps of an earlier process are no speed of this one."""
        with self._lock:
            new = step - self._steps.get(name, 0)
            self._steps[name] = step
            self._taken += 0 if before else new
            rate = self._taken / max(time.monotonic() - self._begin, 1e-9)
            last = f"{name}: {error:.3g} m² at {step}"
            self._show(advance=new, rate=f"{rate:.3g} steps/s", last=last)

    def ended(self, name: str, most_steps: int, how: str) -> None:
        """Tell of a run that is over, whose other steps need not be taken."""
        with self._lock:
            self._done += 1
            left = most_steps - self._steps.get(name, 0)
            self._steps[name] = most_steps
            self._show(advance=left, runs=self._count())
        self._console.print(f"{name}: {how}", highlight=False, soft_wrap=True)
        self._console.file.flush()  # a log of days is read while it grows

    def _count(self) -> str:
        return f"{self._done}/{self._runs} runs"


def print_costs(plan: TrainingPlan, costs: Sequence[Cost], workers: int, console: Console) -> None:
    """Print what each model's runs take, and all together."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, header_style="bold")
    for column in ("data", "model"):
        table.add_column(column)
    for column in ("runs", "steps each", "steps/s", "a run [h]", "all [h]"):
        table.add_column(column, justify="right")
    total = 0.0
    for cost in costs:
        runs = [r for r in plan.runs if (r.group.name, r.model) == (cost.group, cost.model)]
        hours = cost.hours * len(runs)
        total += hours
        numbers = (len(runs), runs[0].profile.steps, *_brief(cost.steps_per_s, cost.hours, hours))
        table.add_row(cost.group, cost.model, *map(str, numbers))
    console.print(table)
    console.print(
        f"{counted(len(plan.runs), 'run')}, at most {total:.3g} h of one process, "
        f"{total / workers:.3g} h with {workers}; measured on a few steps, runs "
        "that are level end before",
        highlight=False,
        soft_wrap=True,
    )


def print_blocked(plan: TrainingPlan, console: Console) -> None:
    """Print why what is planned could not be trained into the folder that was named."""
    if plan.blocked:
        first = next(iter(plan.blocked.values()))
        console.print(
            f"{len(plan.blocked)} of these runs could not be written there: {first}",
            highlight=False,
            soft_wrap=True,
        )


def print_left_out(plan: TrainingPlan, console: Console) -> None:
    """Print what a model cannot represent, and which engines have no data."""
    for name, reason in plan.left_out.items():
        console.print(f"{name} left out: {reason}", highlight=False, soft_wrap=True)


def print_outcome(plan: TrainingPlan, outcome: TrainingOutcome, console: Console) -> None:
    """Print how many runs ended how, and which diverged."""
    from mbds_xsim.learn.trainings import diverged

    facts = [*outcome.trained.values(), *plan.done.values()]
    ways = {
        "level": "ended level",
        "steps": "took all their steps",
        "diverged": "diverged",
    }
    counts = [
        f"{sum(fact.get('ended') == way for fact in facts)} {words}" for way, words in ways.items()
    ]
    console.print(
        f"{counted(len(facts), 'run')} done, {len(plan.done)} of them before, "
        f"{len(outcome.failed)} failed; {', '.join(counts)}",
        highlight=False,
        soft_wrap=True,
    )
    for name in diverged({**plan.done, **outcome.trained}):
        console.print(
            f"{name} diverged: its file has the best parameters before; check its data, or train "
            "it with another --track into another --out",
            highlight=False,
            soft_wrap=True,
        )


def _brief(*values: float) -> list[str]:
    return [f"{value:.3g}" for value in values]
