"""A verification on the terminal: what the data are, what was checked, what is wrong."""

from __future__ import annotations

from collections import Counter

from rich.console import Console
from rich.text import Text

from mbds_xsim.counted import counted
from mbds_xsim.dataset.verify import Verified

__all__ = ["print_verified"]

_MOST = 20  # problems that are listed


def print_verified(verified: Verified, console: Console) -> None:
    """Print what a stranger needs to know."""
    for about in verified.about:
        console.print(_describe(about), highlight=False, soft_wrap=True)
    problems = [(report.file, text) for report in verified.files for text in report.problems]
    for file, text in problems[:_MOST]:
        console.print(Text(f"✗ {file}: {text}", style="red"), soft_wrap=True)
    if len(problems) > _MOST:
        console.print(f"… and {len(problems) - _MOST} more", highlight=False)
    for note, count in Counter(n for r in verified.files for n in r.notes).items():
        where = f" ({count} files)" if count > 1 else ""
        console.print(f"  {note}{where}", highlight=False)
    if any("simulated again: " in note for report in verified.files for note in report.notes):
        console.print(f"  simulated again: chosen by --seed {verified.seed}", highlight=False)
    checked = sum(r.trajectories for r in verified.files if r.kind in ("shard", "rejected"))
    style = "bold green" if verified.sound else "bold red"
    verdict = (
        "everything holds what it says" if verified.sound else counted(len(problems), "problem")
    )
    console.print(
        Text(
            f"{counted(len(verified.files), 'file')}, "
            f"{counted(checked, 'trajectory')} checked: {verdict}",
            style=style,
        )
    )


def _describe(about: dict[str, object]) -> str:
    noise = "with" if about["noise"] else "without"
    return (
        f"{about['file']}: {about['scene_name']} in {about['engine']} {about['engine_version']}, "
        f"{about['method']} at {about['step_s']:.6g} s, {about['certification']}; "
        f"{about['published']} of {about['count']} published, {noise} noise, seed {about['seed']}"
    )
