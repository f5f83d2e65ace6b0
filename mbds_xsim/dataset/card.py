"""What lies beside the data sets of a scene for those who find them: a card, and metadata."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.dataset.additions import with_additions
from mbds_xsim.dataset.croissant import croissant
from mbds_xsim.dataset.durable import put
from mbds_xsim.dataset.join import JOINT, causes
from mbds_xsim.dataset.layout import SUFFIX
from mbds_xsim.dataset.opened import opened
from mbds_xsim.dataset.read import Dataset, load_dataset
from mbds_xsim.dataset.summary import counts_of, rejected_beside
from mbds_xsim.safe_text import in_markdown, sentence

__all__ = ["CARD", "CROISSANT", "descriptions", "write_card"]

CARD = "README.md"
CROISSANT = "croissant.json"


def write_card(folder: Path) -> None:
    """Write the card and the metadata of all data sets of one scene; the same for the same data.

    What a publisher added to those that are there is kept.

    Raises:
        InputError: They cannot be written.
    """
    for name, content in descriptions(folder).items():
        put(folder / name, with_additions(folder / name, content))


def descriptions(folder: Path) -> dict[str, bytes]:
    """Give the card and the metadata that the data in a folder have.

    Raises:
        InputError: The data cannot be read.
    """
    files = (path for path in sorted(folder.glob(f"*{SUFFIX}")) if path.name != JOINT)
    sets = [load_dataset(path) for path in files]
    joint = folder / JOINT
    return {CARD: _card(sets, joint).encode(), CROISSANT: croissant(sets, joint)}


def _card(sets: Sequence[Dataset], joint: Path) -> str:
    told, scene = in_markdown(sets[0].attributes), sets[0].scene
    noise = "with" if told["noise"] else "without"
    rest = sentence(in_markdown(scene.description))
    valid = _valid(joint)
    digest = hashlib.sha256(sets[0].attributes["scene"].encode()).hexdigest()
    example = sets[0].path.name
    made = "".join(_row(data) for data in sets)
    rejected = "".join(_rejections(data) for data in sets)
    return f"""# {in_markdown(scene.name)}: simulated trajectories

{rest}{scene.dimension}D, bodies: {len(scene.bodies)}, points: {len(sets[0]["graph/point_body"])};
{told["steps"]} steps of {told["frame_s"]:g} s a trajectory, SI units, z up. Starts and inputs are
those of seed {told["seed"]}, {noise} random forces: trajectory i is the same start in every file,
in the speed interval low, medium or high by i mod 3.

| file | engine | method | step [s] | | drawn | published | rejected |
| --- | --- | --- | --- | --- | --- | --- | --- |
{made}
{valid.sum()} of {len(valid)} are published in all of them (`{joint.name}`). *Certified*: every
check of every trajectory held, and the engine's model read back as the scene. *Uncertified*: what
an ordinary user of the engine gets; the figures of the checks are stored all the same.
{rejected}
## Split

By index, so the same in every file: the first 80 % train, then 10 % validation, 10 % test.

| file | part | low | medium | high |
| --- | --- | --- | --- | --- |
{"".join(_parts(data) for data in sets)}
## Use

```python
import mbds_xsim

data = mbds_xsim.load_dataset("{example}")
position = data.position[0]  # (frame, point, axis) of the first trajectory
windows = data.windows(7, split="train")
```

Any HDF5 library reads the files; the shards in the folders belong to them. `mbds-xsim inspect .`
shows the figures of the checks, `mbds-xsim verify .` checks all of it again from the files alone,
`mbds-xsim export . --out DIR --format csv` writes it in other forms.

## Limits

Simulated, not measured: what agrees with the reference is the scene's own equations, rigid bodies
and ideal joints among them. Beyond the time at which neighbouring motions part, a trajectory is one
of many that the scene allows. Rejected trajectories are missing in the file where they were
rejected; if hard motions are rejected more often, what is left is biased towards easy ones.

## Versions

mbds-xsim {_each(sets, "mbds_xsim_version")}, numpy {_each(sets, "numpy_version")}, layout
{told["layout_version"]}; SHA-256 of the scene {digest[:16]}…. `{CROISSANT}` has the files'
checksums; who publishes the data adds `license`, `url`, `creator` and `datePublished` there.
"""


def _each(sets: Sequence[Dataset], key: str) -> str:
    return " and ".join(sorted({str(data.attributes[key]) for data in sets}))


def _valid(joint: Path) -> NDArray[np.bool_]:
    with opened(joint) as file:
        return np.asarray(file["valid_in_all"][()])


def _row(data: Dataset) -> str:
    told = in_markdown(data.attributes)
    cells = (
        f"`{data.path.name}`",
        f"{told['engine']} {told['engine_version']}",
        told["method"],
        f"{told['step_s']:.6g}",
        told["certification"],
        told["count"],
        told["published"],
        told["rejected"],
    )
    return f"| {' | '.join(map(str, cells))} |\n"


def _rejections(data: Dataset) -> str:
    """One line on what was rejected by what, nothing where all passed."""
    names = [file.name for file in data.files]
    found = causes(rejected_beside(data), names).most_common()
    if not found:
        return ""
    which = ", ".join(f"{cause} {count}" for cause, count in sorted(found))
    return f"\nRejected from `{data.path.name}` by the check that failed first: {which}.\n"


def _parts(data: Dataset) -> str:
    rows = counts_of(data).items()
    return "".join(
        f"| `{data.path.name}` | {part} | {' | '.join(map(str, counts.values()))} |\n"
        for part, counts in rows
    )
