"""Write reports/paper-tables.md: the paper's four tables next to results of the stored studies.

python -m benchmarks.paper_tables reports/shift reports/lite > reports/paper-tables.md
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.harness import print_head, print_table, stored
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import refusal
from mbds_xsim.learn.shift.gaps import paper_rows
from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.report.quantity import number
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.studies.shift.figures import at, matrix_of, mean, trained_models

_HEAD = """\
Mean squared position errors t frames after the last known one. *Paper*: as printed, scaled as its
table says, as data and never as a target: its unit, averaging, masses and noise are not stated.
*Here*: m², mean over single-engine trainings on native data, each tested on its own engine, of the
study that has most steps. Only orders and growth with t compare.

*: cannot be right as printed (less than at an earlier t, or copied). HGNN and LGNN pass no messages
on the scenes that they accept: they are constrained energy models after their authors.
[How this is measured](../docs/shift.md).
"""
_TABLES = {
    "T1_t1": "Table 1: one frame ahead",
    "T2_t50": "Table 2: 50 frames ahead",
    "T3_main": "Table 3: five scenes over time",
    "T4_speed": "Table 4: ParticleCar by its speed",
}
_SPEEDS = {"": "all", "L": "low", "M": "medium", "H": "high"}
_NATIVE = "-native"
_NO_STUDY, _REFUSED = "no study yet", "refused"


def main(folders: Sequence[Path]) -> None:
    """Print the page."""
    files = [file for folder in folders for file in sorted(folder.glob("*.json.gz"))]
    shifts = [stored(file, Shift) for file in files]
    printed = paper_rows()
    print_head("The paper's tables", "make reports-paper-tables", _HEAD)
    for table, title in _TABLES.items():
        rows = [row for row in printed if row["table"] == table]
        frames = sorted({int(row["t"]) for row in rows})
        print(f"## {title}\n")
        heads = "scene|model|" + "|".join(f">t = {t}, paper|>here" for t in frames)
        print_table(heads, _rows(rows, frames, shifts))
        print()
    print(f"{_REFUSED}:\n")
    scenes = dict.fromkeys(row["scenario"] for row in printed)
    models = dict.fromkeys(row["model"] for row in printed)
    for reason in dict.fromkeys(_refusal(s, m) for s in scenes for m in models):
        if reason:
            print(f"- {reason}")


def _rows(
    printed: Sequence[dict[str, str]], frames: Sequence[int], shifts: Sequence[Shift]
) -> Iterator[tuple[str, ...]]:
    table = {(row["scenario"], row["speed"], row["model"], int(row["t"])): row for row in printed}
    cells = dict.fromkeys(key[:3] for key in table)
    for scenario, speed, model in sorted(cells, key=lambda cell: (cell[0], "LMH".find(cell[1]))):
        scene = _scene(scenario)
        texts = []
        for frame in frames:
            row = table[scenario, speed, model, frame]
            texts.append(number(float(row["mean_si"])) + (" *" if row["note"] else ""))
            texts.append(_here(shifts, scene, model.lower(), frame, _SPEEDS[speed]))
        name = f"{scene}, {_SPEEDS[speed]}" if speed else scene
        yield (name, model, *texts)


def _here(shifts: Sequence[Shift], scene: str, model: str, frame: int, interval: str) -> str:
    """Return a model's error on its own training engines, or why there is none."""
    own = [
        shift
        for shift in shifts
        if shift.scene == scene and model in trained_models(shift) and frame in shift.frames
    ]
    for shift in sorted(own, key=lambda s: max(m.steps for m in s.models), reverse=True):
        matrix = matrix_of(shift, model, at(shift, frame), interval)
        homes = [matrix.at_home(name) for name in matrix.homes if name.endswith(_NATIVE)]
        if homes and (error := mean(homes)) is not None:
            return number(error)
    return _REFUSED if _refusal(scene, model) else _NO_STUDY


def _scene(scenario: str) -> str:
    return scenario.replace("-", "").lower()


@functools.cache
def _refusal(scenario: str, model: str) -> str:
    return refusal(model.lower(), Graph.of(load_scene(_scene(scenario))), track="lite")


if __name__ == "__main__":
    main([Path(word) for word in sys.argv[1:]])
