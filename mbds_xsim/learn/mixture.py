"""What a model trains on: one engine, all but one, or all, always to one budget.

Of several engines each trajectory is taken from one, in turn: as many distinct trajectories as of
a single engine, from the same starts and in the same order, so that the same seed draws the same
windows in every training. One engine's starts of a single interval are for measuring an engine's
shift by one that everybody knows: they are a third as many, at as many steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from mbds_xsim.errors import InputError
from mbds_xsim.learn.domains import Group
from mbds_xsim.learn.window import Motions
from mbds_xsim.sampling_terms import INTERVALS

__all__ = ["Share", "mixed", "trainings", "turns"]

_SEVERAL = ("all", "leave-one-out")


@dataclass(frozen=True)
class Share:
    """The part of a group that a training has."""

    engines: tuple[str, ...]
    interval: str = ""
    """Of the starts: low, medium or high; all when left out."""

    def numbers(self, group: Group, split: str) -> NDArray[np.int64]:
        """Numbers of the trajectories of a part, ascending."""
        found = group.numbers(split)
        if not self.interval:
            return found
        return found[found % len(INTERVALS) == INTERVALS.index(self.interval)]


def trainings(group: Group, on: str) -> dict[str, Share]:
    """Give what each training has, by its name: `mujoco`, `not-mujoco`, `all`, `mujoco-low`.

    Args:
        group: The engines that there are.
        on: Comma-separated: `each`, `leave-one-out`, `all`, `by-interval`, or names of those of
            single engines.

    Raises:
        InputError: A word is none of these, or there are too few engines.
    """
    found: dict[str, Share] = {}
    for word in (word.strip() for word in on.split(",")):
        found |= dict(_of_word(group, word))
    return found


def _of_word(group: Group, word: str) -> Iterator[tuple[str, Share]]:
    engines = tuple(group.files)
    parts = {f"{e}-{interval}": Share((e,), interval) for e in engines for interval in INTERVALS}
    ways = {
        "each": {engine: Share((engine,)) for engine in engines},
        "leave-one-out": {
            f"not-{out}": Share(tuple(e for e in engines if e != out)) for out in engines
        },
        "all": {"all": Share(engines)},
        "by-interval": parts,
        **{engine: {engine: Share((engine,))} for engine in engines},
    }
    known = list(ways)
    ways |= {name: {name: share} for name, share in parts.items()}
    if word not in ways:
        msg = (
            f"--on: got {word!r}, allowed for {group.name} is {', '.join(known)}, or an engine's "
            f"starts of an interval, as {next(iter(parts))}"
        )
        raise InputError(msg)
    if word in _SEVERAL and len(engines) < 2:
        msg = (
            f"--on: {word} needs data of at least 2 engines, {group.name} has {engines[0]} only; "
            "give more data, or --on each"
        )
        raise InputError(msg)
    yield from ways[word].items()


def turns(numbers: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Which of so many engines each trajectory is taken from.

    The interval of speed is the number modulo 3, so whole triples are taken in turn: with three
    engines each would otherwise be seen at one speed only.
    """
    return numbers // len(INTERVALS) % count


def check_share(group: Group, share: Share, split: str) -> None:
    """Refuse a training without any trajectory of a part.

    Raises:
        InputError: None is of its interval of speed.
    """
    if not len(share.numbers(group, split)):
        msg = (
            f"{group.name}: no trajectory of {split} is of the interval {share.interval!r}; "
            "generate more"
        )
        raise InputError(msg)


def mixed(
    group: Group,
    share: Share,
    split: str,
    *,
    bodies: bool = False,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
    most: int | None = None,
) -> Motions:
    """Read a part of a training's data, in ascending order of the trajectories' numbers.

    Args:
        group: Only trajectories that every engine of it has are taken.
        share: Of the training.
        split: "train" or "validation".
        bodies: Whether to read the bodies' states too.
        device: Where to put them.
        dtype: Of positions, velocities and inputs.
        most: The first so many trajectories; all when left out.
    """
    check_share(group, share, split)
    numbers = share.numbers(group, split)[:most]
    turn = turns(numbers, len(share.engines))
    parts = []
    for k, engine in enumerate(share.engines):
        data = group.data[engine]
        rows = np.flatnonzero(np.isin(data.index, numbers[turn == k]))
        if len(rows):
            parts.append(
                Motions.of(data, split, rows=rows, bodies=bodies, device=device, dtype=dtype)
            )
    if len(parts) == 1:
        return parts[0]  # no copy of what may fill the memory; files are in ascending order
    whole = Motions.joined(parts)
    return whole[torch.from_numpy(np.argsort(whole.index))]
