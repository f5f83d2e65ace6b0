"""Survey of published models as one table, with its totals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from importlib.metadata import version

from benchmarks.harness import print_head, print_made, print_table
from benchmarks.survey_rows import READERS, Cause, SurveyRow
from benchmarks.survey_wheels import linked
from benchmarks.validated_model import ENGINES
from mbds_xsim.base.text import in_markdown

_HEAD = """\
Models in the wheels of pybullet (pybullet_data), dm_control, gymnasium, gymnasium-robotics and
example-robot-data that have joints, each imported, held against what two other readers make of it,
and read by three engines' own readers. Nothing was copied: the files are those of the wheels. The
name of a model leads to its section on its wheel's page.

*Deviation* is the largest difference of masses, centres of mass, inertias, axes and places of the
imported bodies and joints, over the model's own size, from MuJoCo's compiled model and from
Pinocchio's reading of URDF. What an engine has otherwise than the file says is what
`mbds-xsim readers MODEL` lists; see [what engines' own readers lose](../../docs/reader-losses.md).

*Verdicts* are on half a second of motion from three starts, at the engines' presets (`matched`,
without a search for better settings), with a minute of processor time for each engine and for the
reference. Verdicts are of an earlier run than the rest, of the same files and releases of engines.
"""


def print_page(rows: list[SurveyRow], causes: list[Cause]) -> None:
    """Print the survey: its totals, and one table of all models."""
    print_head("Models in the wild", "make reports-models-in-the-wild", _HEAD)
    read = [row for row in rows if not row.refused]
    print(f"{len(read)} of {len(rows)} files are imported.\n")
    print("## In short\n")
    print_table("what|>models", _summary(rows, read))
    print("\n## What is lost on import, by models\n")
    lost = Counter(name for row in read for name in row.counts("dropped"))
    near = Counter(name for row in read for name in row.counts("approximated"))
    losses = [("dropped", *pair) for pair in lost.most_common()]
    losses += [("approximated", *pair) for pair in near.most_common()]
    print_table("|element and attribute|>models", ((a, b, str(c)) for a, b, c in losses))
    print("\n## Model by model\n")
    heads = "model|>dof|>lost|>deviation|>from Pinocchio|mujoco|pybullet|dart|runs in"
    print_table(heads, (_cells(row) for row in read))
    print("\n## Why models do not pass\n")
    print_table("model|engine|verdict|by|why", _failed(read, causes))
    print("\n## Not imported\n")
    print_table(
        "file|why", ((linked(row), in_markdown(row.refused)) for row in rows if row.refused)
    )
    print_made(f"mujoco {version('mujoco')}", f"dart {version('dartpy')}")


def _summary(rows: list[SurveyRow], read: list[SurveyRow]) -> Iterator[tuple[str, str]]:
    still = sum(row.refused.startswith("nothing in it moves") for row in rows)
    yield "files that are no part of another", str(len(rows))
    yield "of these with degrees of freedom", str(len(rows) - still)
    yield "imported", f"{len(read)} ({len(read) / max(len(rows) - still, 1):.0%})"
    yield (
        "imported, nothing of the motion lost",
        str(sum(not row.lost for row in read)),
    )
    for name, key in (("MuJoCo's compiled model", "from_compiled"), ("Pinocchio", "from_second")):
        deviations = [value for row in read if (value := getattr(row, key)) is not None]
        near = sum(value <= 1e-9 for value in deviations)
        yield f"as {name} has them to 1e-9 (of those that it reads)", f"{near} of {len(deviations)}"
    for engine in READERS:
        readings = [row.readers[engine] for row in read if engine in row.readers]
        alike = readings.count("alike")
        refused = sum(reading.startswith("refuses") for reading in readings)
        yield f"{engine}'s own reader: as the file says", f"{alike} of {len(readings)}"
        yield f"{engine}'s own reader: refuses the file", f"{refused} of {len(readings)}"
    all_alike = sum(set(row.readers.values()) == {"alike"} for row in read)
    yield "read alike by all three engines' own readers", f"{all_alike} of {len(read)}"
    ran = [row for row in read if row.verdicts]
    passed = sum(len(row.verdicts) == 4 and set(row.verdicts.values()) == {"pass"} for row in ran)
    yield "validated so far, the smallest first", f"{len(ran)} of {len(read)}"
    if ran:
        judged = [sum(v in ("pass", "fail") for v in row.verdicts.values()) for row in ran]
        truth = [not row.reference for row in ran]
        both = sum(count == 4 and known for count, known in zip(judged, truth, strict=True))
        yield (
            "run in all four engines, with a verdict against the reference",
            f"{both} ({both / len(read):.0%} of all that are imported)",
        )
        yield "pass in all four engines", f"{passed} of {len(ran)}"
        for engine in ENGINES:
            counts = Counter(row.verdicts[engine] for row in ran)
            words = ", ".join(f"{count} {verdict}" for verdict, count in counts.most_common())
            yield f"validated in {engine}", words


def _cells(row: SurveyRow) -> tuple[str, ...]:
    lost = sum(fate.count for fate in row.lost)
    deviations = (
        "–" if value is None else f"{value:.0e}" for value in (row.from_compiled, row.from_second)
    )
    readers = (in_markdown(row.readers.get(engine, "–")) for engine in READERS)
    passed = [engine for engine, verdict in row.verdicts.items() if verdict == "pass"]
    runs = ", ".join(passed) or ("none" if row.verdicts else "–")
    return (linked(row), str(row.degrees_of_freedom), str(lost), *deviations, *readers, runs)


def _failed(read: list[SurveyRow], causes: list[Cause]) -> Iterator[tuple[str, ...]]:
    for row in read:
        if row.reference:
            yield row.place, "reference", "ends early", in_markdown(row.reference), ""
        for engine, reason in row.reasons.items():
            known = next((cause.why for cause in causes if cause.explains(row, engine)), "")
            yield row.place, engine, row.verdicts[engine], in_markdown(reason), in_markdown(known)
