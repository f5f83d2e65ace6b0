"""Record the program's results, and check later whether they are still the same.

    python -m benchmarks.frozen make out/frozen        # before a change that should change nothing
    python -m benchmarks.frozen compare out/frozen     # after it: 0 the same, 1 not

The record holds the results of every command at small sizes, checksums of the contents of data
sets, and the help of every command. Figures of physics must repeat to 1e-9 and data to the bit: run
both on the same machine with the same packages. Results that exist already are not made again.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np

from mbds_xsim.base.errors import InputError
from mbds_xsim.commands import app
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.simulate.registry import PAPER_SCENES
from mbds_xsim.studies.diff.compare import EntryDiff, compare_files

_SMALL = "1pendulum --engines mujoco,pybullet --settings native"
_COMMANDS = {
    **{f"validate-{scene}-{seed}": f"validate {scene} --seed {seed}"
       for scene in PAPER_SCENES for seed in (1, 2)},
    "match": "match 2pendulum --engines mujoco --trajectories 1 --held-out 2 --out match.toml",
    "tradeoff": "tradeoff 2pendulum --starts 1 --limit 2 --fresh",
    "stability": "stability pace --quick --limit 10 --fresh",
    "ablate": "ablate 2pendulum --engines mujoco --trajectories 1",
    "contact": "contact --engines mujoco,dart",
    "generate": f"generate {' '.join(PAPER_SCENES)} --trajectories 3 --settings native --out data",
    "verify": "verify data --seed 0",
    "inspect": "inspect data",
    "audit": "audit data/3ladder/mujoco-native.h5",
    "learn": f"generate {_SMALL} --trajectories 60 --out learn",
    "train": "train learn --models gns,hgnn --on each --seeds 1 --profile smoke --out models",
    "shift": "shift models learn",
}  # fmt: skip


def main() -> None:
    """Make a record, or compare with one."""
    match sys.argv[1:]:
        case ["make", folder]:
            _make(Path(folder).resolve())
        case ["compare", folder]:
            sys.exit(_compare(Path(folder).resolve()))
        case _:
            sys.exit(__doc__)


def _make(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, words in _COMMANDS.items():
        if not (folder / f"{name}.json").exists():
            print(name, flush=True)
            _run(folder, *words.split(), "--json", f"{name}.json")
    for command in ("", *_names()):
        text = _run(folder, *command.split(), "--help")
        (folder / f"help-{command}.txt").write_text(text, "utf-8")
    sums = "".join(f"{line}\n" for line in _checksums(folder / "data"))
    (folder / "data.txt").write_text(sums, "utf-8")


def _names() -> list[str]:
    calls = ((command.name, command.callback) for command in app.registered_commands)
    return [name or call.__name__ for name, call in calls if call is not None]


def _run(folder: Path, *words: str) -> str:
    """Return the command's standard output; a verdict of fail (exit code 1) is a result too."""
    command = [sys.executable, "-c", "from mbds_xsim.__main__ import main; main()", *words]
    process = subprocess.run(
        command,
        cwd=folder,
        env=os.environ | {"COLUMNS": "100", "MBDS_XSIM_CACHE": str(folder / "cache")},
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    if process.returncode not in (0, 1):
        sys.exit(f"mbds-xsim {' '.join(words)}: exit code {process.returncode}")
    return process.stdout


def _checksums(data: Path) -> Iterator[str]:
    """Yield a checksum of each series of each data set, independent of the file's layout."""
    for path in sorted(data.glob("*/*-*.h5")):
        for name, values in load_dataset(path).items():
            content = np.asarray(values)
            whole = content.astype("S") if content.dtype == object else content
            digest = hashlib.sha256(np.ascontiguousarray(whole).tobytes()).hexdigest()
            yield f"{path.relative_to(data)} {name} {content.shape} {digest}"


def _compare(before: Path) -> int:
    after = before.with_name(f"{before.name}-now")
    shutil.rmtree(after, ignore_errors=True)  # drop the results of the last comparison
    _make(after)
    for path in after.glob("*.json"):  # some name files by their whole paths
        path.write_text(path.read_text("utf-8").replace(str(after), str(before)), "utf-8")
    wrong = [*_other_results(before, after), *_other_texts(before, after)]
    print("\n".join(wrong) or f"{len(_COMMANDS)} results, data and help as before")
    return 1 if wrong else 0


def _other_results(before: Path, after: Path) -> Iterator[str]:
    for name in _COMMANDS:
        try:
            comparison = compare_files(before / f"{name}.json", after / f"{name}.json", rtol=1e-9)
        except InputError as error:
            yield f"{name}: {error}"
            continue
        for scene in comparison.scenes:
            changed = [entry.name for entry in scene.entries if _is_other(entry)]
            changed += [extra.name for extra in (*scene.only_old, *scene.only_new)]
            if changed:
                yield f"{name} {scene.scene}: {', '.join(changed)}"


def _is_other(entry: EntryDiff) -> bool:
    """Return whether more changed than a file's checksum: models keep the time they took."""
    settings = tuple(change for change in entry.settings if change.what != "content")
    return msgspec.structs.replace(entry, settings=settings).changed


def _other_texts(before: Path, after: Path) -> Iterator[str]:
    for path in sorted(before.glob("*.txt")):
        if path.read_text("utf-8") != (after / path.name).read_text("utf-8"):
            yield f"{path.name}: another text; diff {path} {after / path.name}"


if __name__ == "__main__":
    main()
