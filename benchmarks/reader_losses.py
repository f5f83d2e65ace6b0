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

_HEAD = """# What engines' own readers lose

MuJoCo, PyBullet and DART read models themselves, and each reads other things of them.
`mbds-xsim readers MODEL` lets each engine load a file with its default options, compares what it
has read with what the file says, field by field, and reports how far the bodies are after one
second from where the file's own values put them. It exits with 1 if any engine differs.

Each of these losses has a minimal file in `tests/models/losses`. This page is generated from them
by `python -m benchmarks.reader_losses > docs/reader-losses.md`; a test compares the two.
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


def _chapter(name: str) -> Iterator[str]:
    text = (FOLDER / name).read_text("utf-8")
    comment, _, model = text.partition("-->\n")
    sentence, *links = comment.removeprefix("<!-- ").strip().split("\n")
    yield f"\n## {sentence.rstrip('.')}\n"
    yield f"`mbds-xsim readers tests/models/losses/{name}`" + "".join(
        f", reported at <{link.strip()}>" for link in links
    )
    yield f"\n```xml\n{model}```\n"
    yield "| engine | field | for | it has | file says |\n| :-- | :-- | :-- | :-- | :-- |"
    for engine, loss in shown(name, compare(FOLDER / name, ENGINES)):
        if isinstance(loss, str):
            yield f"| {engine} | – | – | refuses: {in_markdown(loss)} | – |"
        else:
            cells = (f"{loss.field} of {loss.of}", loss.first or "–", loss.read, loss.stated)
            yield f"| {engine} | {' | '.join(map(in_markdown, cells))} |"


def page() -> str:
    """Return the whole page."""
    return "\n".join([_HEAD.rstrip(), *(line for name in SHOWN for line in _chapter(name))]) + "\n"


if __name__ == "__main__":
    print(page(), end="")
