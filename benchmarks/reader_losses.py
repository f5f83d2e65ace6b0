"""Page about losses in engines' own readers: a minimal file for each, read by all of them.

python -m benchmarks.reader_losses > docs/reader-losses.md
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mbds_xsim.base.text import in_markdown
from mbds_xsim.studies.readers import Difference, Readings, compare

FOLDER = Path(__file__).parents[1] / "tests" / "models" / "losses"
ENGINES = ("mujoco", "pybullet", "dart")

# Fields that each file shows as lost, by engine; "" where the engine refuses the file.
SHOWN: dict[str, dict[str, str]] = {
    "inertia-from-shape.urdf": {"pybullet": "inertia"},
    "inertia-without-shape.urdf": {"pybullet": "inertia"},
    "no-inertial.urdf": {"pybullet": "mass", "dart": "mass"},
    "mass-from-shape.urdf": {"mujoco": "mass"},
    "mimic.urdf": {"pybullet": "coupling"},
    "long-axis.urdf": {"pybullet": "axis"},
    "limits.urdf": {"dart": "enforcement of limits"},
    "package.urdf": {"mujoco": "", "pybullet": "", "dart": ""},
    "inertia-turned.sdf": {"dart": "inertia"},
    "continuous.sdf": {"dart": "existence"},
    "loop.sdf": {"dart": "loop"},
    "loop.xml": {"pybullet": "loop", "dart": "loop"},
    "damping.xml": {"pybullet": "damping"},
    "armature.xml": {"pybullet": "armature", "dart": "armature"},
    "spring.xml": {"pybullet": "stiffness", "dart": "stiffness"},
    "friction.xml": {"pybullet": "friction", "dart": "friction"},
    "mass.xml": {"pybullet": "mass"},
    "geometry.xml": {"dart": "inertia"},
    "ends.xml": {"dart": "anchor"},
    "degrees.xml": {"dart": "limits"},
    "degrees-unsaid.xml": {"pybullet": "limits", "dart": "limits"},
    "off-centre.xml": {"pybullet": "centre of mass", "dart": "centre of mass"},
    "no-type.xml": {"pybullet": "existence"},
    "default-range.xml": {"pybullet": ""},
    "site.xml": {"dart": ""},
}

_FORMATS = {"urdf": "URDF", "sdf": "SDF", "xml": "MJCF"}

_HEAD = """# What engines' own readers lose

MuJoCo, PyBullet and DART read models themselves, each with losses of its own and mostly without a
message. Of the {count} minimal files below, {losing}.
[`import`](import.md) reads a file itself and gives each engine the same scene. To see what your own
file loses, run

```sh
mbds-xsim readers my-robot.urdf      # exits with 1 if any engine differs
```

It loads the file in each engine with default options, compares every field with the file, and
reports how far the bodies are after one second from where the file's own values put them.

The examples are in `tests/models/losses`. This page is generated from them by
`python -m benchmarks.reader_losses > docs/reader-losses.md`; a test compares the two.
"""


def shown(name: str, readings: Readings) -> Iterator[tuple[str, Difference | str]]:
    """Yield the losses that a file shows: engine, and the difference or why it refuses."""
    for reading in readings.readings:
        field = SHOWN[name].get(reading.engine)
        if field == "":
            yield reading.engine, reading.refused
        for difference in reading.differences:
            if difference.field == field:
                yield reading.engine, difference


def _rows(name: str) -> Iterator[str]:
    comment = (FOLDER / name).read_text("utf-8").partition("-->\n")[0]
    sentence, *links = comment.removeprefix("<!-- ").strip().split("\n")
    told = sentence.rstrip(". ") + "".join(f" ([report]({link.strip()}))" for link in links)
    engines: dict[tuple[str, ...], list[str]] = {}
    for engine, loss in shown(name, compare(FOLDER / name, ENGINES)):
        engines.setdefault(_cells(loss), []).append(engine)
    for number, (cells, those) in enumerate(engines.items()):
        first = (told, f"`{name}`") if number == 0 else ("", "")
        yield f"| {' | '.join((*first, ', '.join(those), *map(in_markdown, cells)))} |"


def _cells(loss: Difference | str) -> tuple[str, str, str]:
    if isinstance(loss, str):
        return "the file", f"refuses: {loss}", "–"
    return f"{loss.field} of {loss.first or loss.of}", loss.read, loss.stated


def page() -> str:
    """Return the whole page."""
    counts = (sum(engine in lost for lost in SHOWN.values()) for engine in ENGINES)
    losing = "MuJoCo misreads or refuses {}, PyBullet {} and DART {}".format(*counts)
    lines = [_HEAD.rstrip().format(count=len(SHOWN), losing=losing)]
    for ending, format_ in _FORMATS.items():
        lines += [f"\n## {format_}\n", "| loss | example | engine | of | it has | file says |"]
        lines += ["| :-- | :-- | :-- | :-- | :-- | :-- |"]
        lines += [row for name in SHOWN if name.endswith(ending) for row in _rows(name)]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(page(), end="")
