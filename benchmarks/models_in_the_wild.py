"""Survey of published models: losses of each on import, and readings by engines' own readers.

    python -m benchmarks.models_in_the_wild PACKAGES found.json
    python -m benchmarks.models_in_the_wild PACKAGES found.json --validate 60
    python -m benchmarks.models_in_the_wild found.json > reports/wild/models.md

The last form prints one table of all models and writes a page for each wheel, with a section for
each model, next to found.json. The file causes.toml in the same folder is written by hand: it
explains failed verdicts.

PACKAGES is a folder with the installed wheels of the extra `wild`; nothing is copied from it.
Findings are stored under a key of the model's content and the versions, so that an interrupted run
continues. `--validate` also runs models in all engines: that many, smallest first. Engines' own
readers come last. Each model has a process of its own; as many run at a time as there are cores.
"""

from __future__ import annotations

import hashlib
import itertools
import re
import site
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from benchmarks.harness import stored
from benchmarks.survey import READERS, Cause, SurveyRow, print_page, write_wheels
from benchmarks.validated_model import verdicts_on
from mbds_xsim.base import rotation, versions
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import write_whole
from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.scene.imported import Imported
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.simulate.registry import read_model
from mbds_xsim.studies.readers import Difference, compare_imported

_MOVES = {
    "mujoco": re.compile(r"<(joint|freejoint|include)\b"),
    "robot": re.compile(r"<joint[^>]*type\s*=\s*.(revolute|continuous|prismatic|floating|planar)"),
}
_INCLUDES = re.compile(r"<include\s+file\s*=\s*[\"']([^\"']+)")
_FREEDOMS = {"hinge": 1, "slider": 1, "ball": 3, "fixed": 0}
_ROOT = re.compile(r"<(mujoco|robot)\b")
_REVISION = 4
"""Revision of the findings; raise it to survey all models anew."""


def main(words: list[str]) -> None:
    """Run the survey, or present its findings."""
    if len(words) == 1:
        file = Path(words[0])
        by_hand = file.with_name("causes.toml").read_bytes()
        causes = msgspec.toml.decode(by_hand, type=dict[str, list[Cause]])["causes"]
        found = stored(file, list[SurveyRow])
        print_page(found, causes)
        write_wheels(found, causes, file.parent)
        return
    packages, target = map(Path, words[:2])
    old = stored(target, list[SurveyRow]) if target.exists() else []
    by_key = {row.key: row for row in old}
    rows = [_begun(path.relative_to(packages), packages) for path in _models(packages)]
    rows = [by_key.get(row.key, row) for row in rows]
    _fill(looked_at, [row for row in rows if not (row.refused or row.bodies)], rows, words)
    imported = [row for row in rows if row.bodies]
    if "--validate" in words:
        most = int(words[words.index("--validate") + 1])
        smallest = sorted(imported, key=lambda row: row.degrees_of_freedom)[:most]
        _fill(validated, [row for row in smallest if not row.verdicts], rows, words)
    _fill(read_by_engines, [row for row in rows if row.bodies and not row.readers], rows, words)


def _fill(
    fill: Callable[[SurveyRow, Path], SurveyRow],
    waiting: list[SurveyRow],
    rows: list[SurveyRow],
    words: list[str],
) -> None:
    """Fill rows, each in a process of its own, and store every one as it comes."""
    packages, target = map(Path, words[:2])
    done = itertools.count(1)

    def keep(place: int, filled: SurveyRow | Crash) -> None:
        row, note = waiting[place], "done"
        if isinstance(filled, Crash):  # such a row is tried again by the next run
            note = filled.reason
        else:
            if fill is validated:
                note = ", ".join(" ".join(pair) for pair in filled.verdicts.items())
            rows[rows.index(row)] = filled
            write_whole(target, b"[\n%b\n]\n" % b",\n".join(map(msgspec.json.encode, rows)))
        print(f"{fill.__name__} {next(done)}/{len(waiting)} {row.path}: {note}", file=sys.stderr)

    tasks = [Task(fill, (row, packages)) for row in waiting]
    run_tasks(tasks, finished=keep, packages=Path(__file__).parents[1])


def _models(packages: Path) -> Iterator[Path]:
    """Yield the files that are models with joints and are not included by another file."""
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
    """Import a model, and compare it with two other readings of its file."""
    path = packages / row.path
    try:
        imported = read_model(path, folder=packages)
    except InputError as error:
        row.refused = str(error).removeprefix(f"{path}: ").replace(str(packages), "…")
        return row
    mechanism = Mechanism.of(imported.scene)
    row.bodies = mechanism.body_count
    row.degrees_of_freedom = sum(
        _FREEDOMS[link.joint.kind] if link.joint else 6 for link in mechanism.links
    )
    lost = [fate for fate in imported.fates if fate.moves and fate.outcome != "kept"]
    row.kept = imported.count("kept")
    row.lost = tuple(msgspec.structs.replace(fate, places=()) for fate in lost)
    with suppress(ValueError):  # MuJoCo refuses some masses that the import takes as written
        row.from_compiled = from_compiled(path, imported)
    if row.format == "URDF":
        with suppress(ValueError):
            row.from_second = from_pinocchio(path, imported, packages)
    return row


Reading = dict[str, tuple[float, Array, Array, Array, Array]]
"""By joint: mass, centre of mass and inertia of what it holds, its place and its axis."""


def from_compiled(path: Path, imported: Imported) -> float:
    """Return the deviation from MuJoCo's compiled model, with bodies fixed together merged."""
    import mujoco

    spec = mujoco.MjSpec.from_file(str(path))
    if path.suffix == ".urdf":
        spec.compiler.inertiafromgeom = 0
        spec.compiler.fusestatic = False  # fusing would drop the inertia of bodies without mass
        for item in [*spec.geoms, *spec.meshes]:
            spec.delete(item)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    reading = {}
    for j in range(model.njnt):
        body = model.jnt_bodyid[j]
        last = model.body_jntadr[body] + model.body_jntnum[body] - 1 == j
        own = np.flatnonzero(model.body_weldid == body) if last else np.array([], dtype=int)
        pose = data.xanchor[j].copy(), data.xaxis[j].copy()
        reading[model.joint(j).name] = (*_together(model, data, own), *pose)
    return max([0.0, *_deviations(imported, reading)])


def from_pinocchio(path: Path, imported: Imported, packages: Path) -> float:
    """Return the deviation from Pinocchio's reading of a URDF, which merges such bodies too."""
    site.addsitedir(str(packages))
    import pinocchio

    model = pinocchio.buildModelFromUrdf(str(path))
    data = model.createData()
    pose = pinocchio.neutral(model)
    pinocchio.computeJointJacobians(model, data, pose)
    reading = {}
    for j in range(1, model.njoints):
        place, body = data.oMi[j], model.inertias[j]
        jacobian = pinocchio.getJointJacobian(model, data, j, pinocchio.LOCAL_WORLD_ALIGNED)
        column = np.reshape(jacobian, (6, -1))[:, model.joints[j].idx_v]
        axis = column[3:] if np.linalg.norm(column[3:]) > 0 else column[:3]
        com = place.act(body.lever)
        inertia = place.rotation @ body.inertia @ place.rotation.T
        reading[model.names[j]] = (body.mass, com, inertia, place.translation.copy(), axis)
    return max([0.0, *_deviations(imported, reading)])


def _together(model: Any, data: Any, bodies: Any) -> tuple[float, Array, Array]:
    mass = model.body_mass[bodies]
    if not mass.sum() > 0:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    turns = [data.xmat[body].reshape(3, 3) for body in bodies]
    # `data.xipos` would round a centre of mass near the frame's origin to the origin.
    arms = [turn @ model.body_ipos[body] for turn, body in zip(turns, bodies, strict=True)]
    places = data.xpos[bodies] + np.array(arms)
    com, inertia = mass @ places / mass.sum(), np.zeros((3, 3))
    for own, body, turn, arm in zip(mass, bodies, turns, places - com, strict=True):
        axes = turn @ rotation.matrix(model.body_iquat[body])
        inertia += axes @ np.diag(model.body_inertia[body]) @ axes.T
        inertia += own * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return float(mass.sum()), com, inertia


def _deviations(imported: Imported, reading: Reading) -> Iterator[float]:
    """Yield relative deviations of masses, centres of mass, inertias, places and axes of joints.

    Bodies are matched by the joint that holds them.
    """
    scene, mechanism = imported.scene, Mechanism.of(imported.scene)
    mended = {  # bodies whose mass is not as stated in the file
        place.split(":")[0]
        for fate in imported.fates
        if fate.outcome == "approximated" and fate.element == "inertial"
        for place in fate.places
    }
    index = {body.name: k for k, body in enumerate(scene.bodies) if body.name not in mended}
    for joint in (joint for joint in scene.joints if joint.name in reading):
        mass, com, inertia, anchor, axis = reading[joint.name]
        yield float(np.linalg.norm(np.array(joint.anchor) - anchor)) / scene.length
        if joint.axis is not None:
            yield float(np.linalg.norm(np.array(joint.axis) - axis))
        if joint.child in index and mass > 0:
            k, scale = index[joint.child], float(np.linalg.norm(inertia))
            yield abs(float(mechanism.mass[k]) / mass - 1)
            yield float(np.linalg.norm(mechanism.com[k] - com)) / scene.length
            yield float(np.linalg.norm(mechanism.inertia[k] - inertia)) / scale


def validated(row: SurveyRow, packages: Path) -> SurveyRow:
    """Run a model in all engines."""
    result = verdicts_on(packages / row.path, packages)
    row.verdicts, row.reasons, row.reference = result.verdicts, result.reasons, result.reference
    return row


def read_by_engines(row: SurveyRow, packages: Path) -> SurveyRow:
    """Compare the readings of the engines' own readers with an imported model."""
    path = packages / row.path
    imported = read_model(path, folder=packages)
    for reading in compare_imported(imported, path, READERS).readings:
        row.readers[reading.engine] = (
            f"refuses: {reading.refused}" if reading.refused else _fields(reading.differences)
        )
        if reading.differences:
            row.differences[reading.engine] = reading.differences
        if reading.moved_m is not None:
            row.moved_m[reading.engine] = reading.moved_m
    return row


def _fields(differences: Iterable[Difference]) -> str:
    return ", ".join(dict.fromkeys(difference.field for difference in differences)) or "alike"


def _package(inside: Path) -> str:
    return "example-robot-data" if inside.parts[0] == "cmeel.prefix" else inside.parts[0]


if __name__ == "__main__":
    from benchmarks.models_in_the_wild import main  # by a name that other processes know

    main(sys.argv[1:])
