"""Survey: published models, what of each is lost on import, and what engines' readers make of it.

    python -m benchmarks.models_in_the_wild PACKAGES found.json
    python -m benchmarks.models_in_the_wild PACKAGES found.json --validate 60
    python -m benchmarks.models_in_the_wild found.json > reports/wild/models.md

Beside found.json stands causes.toml, written by hand: what was found out about failed verdicts.

PACKAGES is a folder into which the wheels of the extra `wild` are installed; nothing is copied from
it. What was found of a model is kept by its content and the versions, so that an interrupted run
goes on where it was. `--validate` also runs models in all engines: that many, smallest first. What
engines' own readers make of the models is looked at last. Each model has a process of its own, and
as many are at work as there are cores.
"""

from __future__ import annotations

import hashlib
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from fnmatch import fnmatch
from importlib.metadata import version
from pathlib import Path

import msgspec

from benchmarks.harness import print_head, print_made, print_table
from benchmarks.other_readings import from_compiled, from_pinocchio
from benchmarks.validated_model import ENGINES, verdicts_on
from mbds_xsim.base import versions
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import write_whole
from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.base.text import in_markdown
from mbds_xsim.scene.imported import Imported
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.simulate.registry import read_model
from mbds_xsim.studies.readers import Difference, compared

_ENGINES = ("mujoco", "pybullet", "dart")
_MOVES = {
    "mujoco": re.compile(r"<(joint|freejoint|include)\b"),
    "robot": re.compile(r"<joint[^>]*type\s*=\s*.(revolute|continuous|prismatic|floating|planar)"),
}
_INCLUDES = re.compile(r"<include\s+file\s*=\s*[\"']([^\"']+)")
_ROOT = re.compile(r"<(mujoco|robot)\b")
_REVISION = 4
"""Of what is found; raised, all models are looked at anew."""


class SurveyRow(msgspec.Struct):
    """What was found of one model."""

    key: str
    package: str
    path: str
    format: str = ""
    refused: str = ""
    """Why it is not imported."""
    bodies: int = 0
    degrees_of_freedom: int = 0
    import_s: float = 0.0
    dropped: dict[str, int] = {}
    """By element and attribute, how many; what bears on the motion alone."""
    approximated: dict[str, int] = {}
    from_compiled: float | None = None
    """Largest deviation of masses, places and axes from MuJoCo's compiled model, relative."""
    from_second: float | None = None
    """The same from Pinocchio's reading of a URDF."""
    readers: dict[str, str] = {}
    """By engine: "alike", "refuses: …", or the fields that its own reader has otherwise."""
    moved_m: dict[str, float] = {}
    """By engine, how far the bodies are after 1 s from where the file has them go [m]."""
    verdicts: dict[str, str] = {}
    """By engine, where it was validated: as in `Verdicts`."""
    reasons: dict[str, str] = {}
    """By engine, why it does not pass."""
    reference: str = ""
    """Why the reference ends early, or is not there."""
    validation_s: float = 0.0


class Cause(msgspec.Struct):
    """What was found out about failed verdicts."""

    models: str
    """Pattern of their paths, as of a shell."""
    engine: str
    finding: str
    """What the verdict's reason begins with: a cause does not outlive its finding."""
    why: str

    def explains(self, row: SurveyRow, engine: str) -> bool:
        """Say whether this is why a model does not pass in an engine."""
        told = row.reasons.get(engine, "").startswith(self.finding)
        return told and engine == self.engine and fnmatch(row.path, self.models)


def main(words: list[str]) -> None:
    """Survey, or print the page."""
    if len(words) == 1:
        by_hand = Path(words[0]).with_name("causes.toml").read_bytes()
        causes = msgspec.toml.decode(by_hand, type=dict[str, list[Cause]])["causes"]
        page(msgspec.json.decode(Path(words[0]).read_bytes(), type=list[SurveyRow]), causes)
        return
    packages, target = map(Path, words[:2])
    old = msgspec.json.decode(target.read_bytes(), type=list[SurveyRow]) if target.exists() else []
    known = {row.key: row for row in old}
    rows = [_begun(path.relative_to(packages), packages) for path in _models(packages)]
    rows = [known.get(row.key, row) for row in rows]
    _fill(looked_at, [row for row in rows if not (row.refused or row.bodies)], rows, words)
    if "--validate" in words:
        most = int(words[words.index("--validate") + 1])
        smallest = sorted(filter(_imported, rows), key=lambda row: row.degrees_of_freedom)[:most]
        _fill(validated, [row for row in smallest if not row.verdicts], rows, words)
    _fill(read_by_engines, [r for r in rows if _imported(r) and not r.readers], rows, words)


def _imported(row: SurveyRow) -> bool:
    return bool(row.bodies)


def _fill(
    fill: Callable[[SurveyRow, Path], SurveyRow],
    waiting: list[SurveyRow],
    rows: list[SurveyRow],
    words: list[str],
) -> None:
    """Fill rows, each in a process of its own, and keep every one as it comes."""
    packages, target = map(Path, words[:2])
    done = 0

    def keep(place: int, filled: SurveyRow | Crash) -> None:
        nonlocal done
        done += 1
        row = waiting[place]
        told = filled.reason if isinstance(filled, Crash) else "done"
        if fill is validated and not isinstance(filled, Crash):
            told = ", ".join(f"{engine} {verdict}" for engine, verdict in filled.verdicts.items())
        print(f"{fill.__name__} {done}/{len(waiting)} {row.path}: {told}", file=sys.stderr)
        if not isinstance(filled, Crash):  # such a row is tried again by the next run
            rows[rows.index(row)] = filled
            write_whole(target, msgspec.json.format(msgspec.json.encode(rows), indent=1))

    tasks = [Task(fill, (row, packages)) for row in waiting]
    run_tasks(tasks, finished=keep, packages=Path(__file__).parents[1])


def _models(packages: Path) -> Iterator[Path]:
    """Give the files that are models with joints, and not parts that another includes."""
    texts = {
        path: path.read_text(errors="replace")
        for path in sorted([*packages.rglob("*.xml"), *packages.rglob("*.urdf")])
    }
    parts = {
        (path.parent / name).resolve()
        for path, text in texts.items()
        for name in _INCLUDES.findall(text)
    }
    for path, text in texts.items():
        root = _ROOT.search(text)
        if root and _MOVES[root[1]].search(text) and path.resolve() not in parts:
            yield path


def _begun(inside: Path, packages: Path) -> SurveyRow:
    releases = [version(name) for name in ("mbds-xsim", "mujoco", "pybullet", "dartpy")]
    of = f"{inside} {releases} {versions.PHYSICS} {versions.CHECKS} {_REVISION}"
    key = hashlib.sha256((packages / inside).read_bytes() + of.encode()).hexdigest()[:16]
    kind = "URDF" if inside.suffix == ".urdf" else "MJCF"
    return SurveyRow(key, _package(inside), str(inside), kind)


def looked_at(row: SurveyRow, packages: Path) -> SurveyRow:
    """Import a model, and hold it against what two other readers make of it."""
    path = packages / row.path
    begin = time.perf_counter()
    try:
        imported = read_model(path, folder=packages)
    except InputError as error:
        row.refused = str(error).removeprefix(f"{path}: ").replace(str(packages), "…")
        return row
    row.import_s = round(time.perf_counter() - begin, 3)
    mechanism = Mechanism.of(imported.scene)
    row.bodies = mechanism.body_count
    row.degrees_of_freedom = sum(
        {"hinge": 1, "slider": 1, "ball": 3, "fixed": 0}[link.joint.kind] if link.joint else 6
        for link in mechanism.links
    )
    row.dropped, row.approximated = (
        _counts(imported, what) for what in ("dropped", "approximated")
    )
    with suppress(ValueError):  # MuJoCo refuses masses that it was not given for the import
        row.from_compiled = from_compiled(path, imported)
    if row.format == "URDF":
        with suppress(ValueError):
            row.from_second = from_pinocchio(path, imported, packages)
    return row


def validated(row: SurveyRow, packages: Path) -> SurveyRow:
    """Run a model in all engines."""
    begin = time.perf_counter()
    found = verdicts_on(packages / row.path, packages)
    row.verdicts, row.reasons, row.reference = found.verdicts, found.reasons, found.reference
    row.validation_s = round(time.perf_counter() - begin, 1)
    return row


def read_by_engines(row: SurveyRow, packages: Path) -> SurveyRow:
    """Look at what engines' own readers make of a model that is imported."""
    path = packages / row.path
    imported = read_model(path, folder=packages)
    for reading in compared(imported, path, _ENGINES).readings:
        row.readers[reading.engine] = (
            f"refuses: {reading.refused}" if reading.refused else _fields(reading.differences)
        )
        if reading.moved_m is not None:
            row.moved_m[reading.engine] = reading.moved_m
    return row


def _fields(differences: Iterable[Difference]) -> str:
    return ", ".join(dict.fromkeys(difference.field for difference in differences)) or "alike"


def _package(inside: Path) -> str:
    return "example-robot-data" if inside.parts[0] == "cmeel.prefix" else inside.parts[0]


def _counts(imported: Imported, outcome: str) -> dict[str, int]:
    lost = (fate for fate in imported.fates if fate.outcome == outcome and fate.moves)
    counts: Counter[str] = Counter()
    for fate in lost:
        single = fate.properties if len(fate.properties) == 1 else ()
        counts[" ".join((fate.element, *single))] += fate.count
    return dict(counts)


_HEAD = """\
Models in the wheels of pybullet (pybullet_data), dm_control, gymnasium, gymnasium-robotics and
example-robot-data that have joints, each imported, held against what two other readers make of it,
and read by three engines' own readers. Nothing was copied: the files are those of the wheels.

*Deviation* is the largest difference of masses, centres of mass, inertias, axes and places of the
imported bodies and joints, over the model's own size, from MuJoCo's compiled model and from
Pinocchio's reading of URDF. What an engine has otherwise than the file says is what
`mbds-xsim readers MODEL` lists; see [what engines' own readers lose](../../docs/reader-losses.md).

*Verdicts* are on half a second of motion from three starts, at the engines' presets (`matched`,
without a search for better settings), with a minute of processor time for each engine and for the
reference. Imports, deviations and verdicts are of one run; most readings by engines' own readers
are of an earlier run of the same command, of the same files and releases.
"""


def page(rows: list[SurveyRow], causes: list[Cause]) -> None:
    """Print the survey as Markdown."""
    print_head("Models in the wild", "make reports-models-in-the-wild", _HEAD)
    read = [row for row in rows if not row.refused]
    print(f"{len(read)} of {len(rows)} files are imported.\n")
    print("## In short\n")
    print_table("what|>models", _summary(rows, read))
    print("\n## What is lost on import, by models\n")
    lost = Counter(what for row in read for what in row.dropped)
    near = Counter(what for row in read for what in row.approximated)
    told = [("dropped", *pair) for pair in lost.most_common()]
    told += [("approximated", *pair) for pair in near.most_common()]
    print_table("|element and attribute|>models", ((a, b, str(c)) for a, b, c in told))
    print("\n## Model by model\n")
    heads = "model|>dof|>lost|>deviation|>from Pinocchio|mujoco|pybullet|dart|runs in"
    print_table(heads, (_cells(row) for row in read))
    print("\n## Why models do not pass\n")
    print_table("model|engine|verdict|by|why", _failed(read, causes))
    print("\n## Not imported\n")
    print_table(
        "file|why", ((_place(row), in_markdown(row.refused)) for row in rows if row.refused)
    )
    print_made(f"mujoco {version('mujoco')}", f"dart {version('dartpy')}")


def _summary(rows: list[SurveyRow], read: list[SurveyRow]) -> Iterator[tuple[str, str]]:
    still = sum(row.refused.startswith("nothing in it moves") for row in rows)
    yield "files that are no part of another", str(len(rows))
    yield "of these with degrees of freedom", str(len(rows) - still)
    yield "imported", f"{len(read)} ({len(read) / max(len(rows) - still, 1):.0%})"
    yield (
        "imported, nothing of the motion lost",
        str(sum(not (r.dropped or r.approximated) for r in read)),
    )
    for name, key in (("MuJoCo's compiled model", "from_compiled"), ("Pinocchio", "from_second")):
        held = [value for row in read if (value := getattr(row, key)) is not None]
        near = sum(value <= 1e-9 for value in held)
        yield f"as {name} has them to 1e-9 (of those that it reads)", f"{near} of {len(held)}"
    for engine in _ENGINES:
        told = [row.readers[engine] for row in read if engine in row.readers]
        alike = told.count("alike")
        refused = sum(what.startswith("refuses") for what in told)
        yield f"{engine}'s own reader: as the file says", f"{alike} of {len(told)}"
        yield f"{engine}'s own reader: refuses the file", f"{refused} of {len(told)}"
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
    lost = sum(row.dropped.values()) + sum(row.approximated.values())
    told = (
        "–" if value is None else f"{value:.0e}" for value in (row.from_compiled, row.from_second)
    )
    readers = (in_markdown(row.readers.get(engine, "–")) for engine in _ENGINES)
    passed = [engine for engine, verdict in row.verdicts.items() if verdict == "pass"]
    runs = ", ".join(passed) or ("none" if row.verdicts else "–")
    return (_place(row), str(row.degrees_of_freedom), str(lost), *told, *readers, runs)


def _failed(read: list[SurveyRow], causes: list[Cause]) -> Iterator[tuple[str, ...]]:
    for row in read:
        if row.reference:
            yield _place(row), "reference", "ends early", in_markdown(row.reference), ""
        for engine, reason in row.reasons.items():
            known = next((cause.why for cause in causes if cause.explains(row, engine)), "")
            yield _place(row), engine, row.verdicts[engine], in_markdown(reason), in_markdown(known)


def _place(row: SurveyRow) -> str:
    return in_markdown(f"{row.package}: {Path(row.path).parent.name}/{Path(row.path).name}")


if __name__ == "__main__":
    from benchmarks.models_in_the_wild import main  # by a name that other processes know

    main(sys.argv[1:])
