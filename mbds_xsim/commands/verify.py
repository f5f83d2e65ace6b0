"""`mbds-xsim verify`: check data again, from its own contents alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Exit, Option

from mbds_xsim.base.isolate import LIMIT
from mbds_xsim.base.text import counted
from mbds_xsim.commands import shared
from mbds_xsim.report.blocks import Block, Remark, Remarks, Text

if TYPE_CHECKING:
    from mbds_xsim.dataset.verify import Verified

_MOST = 20
"""Problems that are listed."""


@shared.command(
    "data",
    epilog="Examples:  mbds-xsim verify data  ·  mbds-xsim verify data/6pendulum/mujoco-matched.h5",
)
def verify(
    path: Annotated[
        Path, Argument(metavar="FILE|DIR", help="A data file, with its shards, or a folder.")
    ],
    seed: Annotated[
        int | None,
        Option(help="Chooses what is simulated again; left out, at random.", min=0),
    ] = None,
    workers: shared.WorkerCount = None,
    limit: shared.TimeLimit = LIMIT,
    json: shared.JsonFile = None,
) -> None:
    """Check data again: layout, checksums, pairing, every check, some trajectories made anew."""
    from mbds_xsim.dataset.verify import verify as run

    console = shared.console_for(json)
    shared.check_targets(json=json)
    with shared.progress_on(console) as progress:
        verified = run(path, seed=seed, workers=workers, limit=limit, progress=progress)
    shared.answer(_outcome(verified), verified, json, "verify")
    raise Exit(0 if verified.sound else 1)


def _outcome(verified: Verified) -> Iterator[Block]:
    """Say what the data are, what was checked, and what is wrong."""
    yield from map(_describe, verified.about)
    problems = [Remark(one.file, text, "fail") for one in verified.files for text in one.problems]
    yield Remarks(tuple(problems), most=_MOST)
    for note, count in Counter(note for one in verified.files for note in one.notes).items():
        yield Text(f"  {note}{f' ({count} files)' if count > 1 else ''}")
    if any("simulated again: " in note for one in verified.files for note in one.notes):
        yield Text(f"  simulated again: chosen by --seed {verified.seed}")
    checked = sum(one.trajectories for one in verified.files if one.kind in ("shard", "rejected"))
    verdict = (
        "everything holds what it says" if verified.sound else counted(len(problems), "problem")
    )
    yield Text(
        f"{counted(len(verified.files), 'file')}, {counted(checked, 'trajectory')} checked: "
        f"{verdict}",
        "pass" if verified.sound else "fail",
    )


def _describe(about: dict[str, object]) -> Text:
    noise = "with" if about["noise"] else "without"
    return Text(
        f"{about['file']}: {about['scene_name']} in {about['engine']} {about['engine_version']}, "
        f"{about['method']} at {about['step_s']:.6g} s, {about['certification']}; "
        f"{about['published']} of {about['count']} published, {noise} noise, seed {about['seed']}"
    )
