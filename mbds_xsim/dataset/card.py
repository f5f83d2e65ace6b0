"""What lies beside the data sets of a scene for those who find them: a card, and metadata.

The metadata are in the Croissant format of MLCommons, version 1.0, which lists the files with their
checksums and, as inline records, the arrays in them: Croissant itself has no way into an HDF5 file.
See http://mlcommons.org/croissant/1.0. What a publisher adds to either stays when they are written
again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mbds_xsim.base.files import put
from mbds_xsim.base.text import in_markdown, sentence
from mbds_xsim.dataset.hdf5 import open_hdf5
from mbds_xsim.dataset.layout import FIELDS, FORMAT, JOINT, SPLITS, VERSION, variant_files
from mbds_xsim.dataset.read import Dataset, load_dataset
from mbds_xsim.dataset.shard import causes
from mbds_xsim.dataset.summary import counts_of, rejected_beside
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.simulate.claims import RTOL, TRUTH

CARD = "README.md"
CROISSANT = "croissant.json"
_HDF5 = "application/x-hdf5"
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{
        term: f"cr:{term}"
        for term in (
            "citeAs", "column", "equivalentProperty", "extract", "field", "fileObject",
            "fileProperty", "fileSet", "format", "includes", "isLiveDataset", "jsonPath", "key",
            "md5", "parentField", "path", "recordSet", "references", "regex", "repeated",
            "replace", "samplingRate", "separator", "source", "subField", "transform",
        )
    },
}  # fmt: skip

_TYPES = {str: "sc:Text", int: "sc:Integer"}


def write_card(folder: Path) -> None:
    """Write the card and the metadata of all data sets of one scene; the same for the same data.

    What a publisher added to those that are there is kept.

    Raises:
        InputError: They cannot be written.
    """
    for name, content in descriptions(folder).items():
        put(folder / name, _with_additions(folder / name, content))


def descriptions(folder: Path) -> dict[str, bytes]:
    """Give the card and the metadata that the data in a folder have.

    Raises:
        InputError: The data cannot be read.
    """
    sets = [load_dataset(path) for path in variant_files(folder)]
    joint = folder / JOINT
    return {CARD: _card(sets, joint).encode(), CROISSANT: _croissant(sets, joint)}


def missing_lines(text: str, wanted: str) -> Iterator[tuple[int, str]]:
    """Give the first line, with its number, that a text does not have after those before it."""
    rest = iter(text.split("\n"))
    for number, line in enumerate(wanted.split("\n"), 1):
        if line not in rest:  # takes lines up to it
            yield number, line
            return


def _with_additions(path: Path, content: bytes) -> bytes:
    """Give the new content of a card or of metadata, with what only a publisher can have added.

    Metadata keep the entries that the data do not give. A card that still says all that the data
    give stays as it is; where the data have changed it is written anew.
    """
    try:
        old = path.read_bytes()
        if path.suffix != ".json":
            return content if any(missing_lines(old.decode(), content.decode())) else old
        there, ours = json.loads(old), json.loads(content)
    except (OSError, ValueError):
        return content
    if not isinstance(there, dict) or there.keys() <= ours.keys():
        return content
    added = {key: value for key, value in there.items() if key not in ours}
    return _json(ours | added)


def _json(metadata: dict[str, Any]) -> bytes:
    return (json.dumps(metadata, indent=2, ensure_ascii=False) + "\n").encode()


def _card(sets: Sequence[Dataset], joint: Path) -> str:
    attrs, scene = in_markdown(sets[0].attributes), sets[0].scene
    noise = "with" if attrs["noise"] and scene.noise else "without"
    rest = sentence(in_markdown(scene.description))
    with open_hdf5(joint) as file:
        valid = np.asarray(file["valid_in_all"][()])
    digest = hashlib.sha256(sets[0].attributes["scene"].encode()).hexdigest()
    example = sets[0].path.name
    made = "".join(_row(data) for data in sets)
    rejected = "".join(_rejections(data) for data in sets)
    return f"""# {in_markdown(scene.name)}: simulated trajectories

{rest}{scene.dimension}D, bodies: {len(scene.bodies)}, points: {len(sets[0]["graph/point_body"])};
{attrs["steps"]} steps of {attrs["frame_s"]:g} s a trajectory, SI units, z up. Starts and inputs are
those of seed {attrs["seed"]}, {noise} random forces: trajectory i is the same start in every file,
in the speed interval low, medium or high by i mod 3.

| file | engine | method | step [s] | | drawn | published | rejected |
| --- | --- | --- | --- | --- | --- | --- | --- |
{made}
{valid.sum()} of {len(valid)} are published in all of them (`{joint.name}`). *Certified*: every
check of every trajectory held, and the engine's model read back as the scene. *Uncertified*: what
an ordinary user of the engine gets; the figures of the checks are stored all the same.
{_truth(sets)}{rejected}
## Split

{_split(sets)}

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
{attrs["layout_version"]}; SHA-256 of the scene {digest[:16]}…. `{CROISSANT}` has the files'
checksums; who publishes the data adds `license`, `url`, `creator` and `datePublished` there.
"""


def _split(sets: Sequence[Dataset]) -> str:
    """Say what decides the part of a trajectory, and whether it has the same one in all files."""
    parts = "the first 80 % train, then 10 % validation, 10 % test."
    if len({data.attributes["count"] for data in sets}) == 1:
        return f"By index, so the same in every file: {parts}"
    return (
        f"By index, of as many as were drawn for a file: {parts}\n"
        "Files of other numbers have other parts: what one tests with, another may train on."
    )


def _each(sets: Sequence[Dataset], key: str) -> str:
    return " and ".join(sorted({str(data.attributes[key]) for data in sets}))


def _row(data: Dataset) -> str:
    attrs = in_markdown(data.attributes)
    return (
        f"| `{data.path.name}` | {attrs['engine']} {attrs['engine_version']} | {attrs['method']} "
        f"| {_pace(data)} | {attrs['certification']} | {attrs['count']} "
        f"| {attrs['published']} | {attrs['rejected']} |\n"
    )


def _pace(data: Dataset) -> str:
    """Give the step, or the tolerance of a method that chooses its steps."""
    options = json.loads(data.attributes["options"])
    if _is_truth(data):
        return f"{RTOL} {options[RTOL]:g}"
    return f"{data.attributes['step_s']:.6g}"


def _is_truth(data: Dataset) -> bool:
    return bool(data.attributes["method_family"] == TRUTH)


def _truth(sets: Sequence[Dataset]) -> str:
    """Say of data that no engine made what they are; nothing where there are none."""
    names = " and ".join(f"`{data.path.name}`" for data in sets if _is_truth(data))
    return (
        f"{names}: made by the reference of mbds-xsim, which engines are held against, and not by "
        "an engine. All checks were made all the same; the distance to the reference, of three "
        "trajectories, is that of two tolerances there.\n"
        if names
        else ""
    )


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


def _croissant(sets: Sequence[Dataset], joint: Path) -> bytes:
    """Describe the data sets of one scene; the same data give the same bytes.

    What only a publisher knows is left out: license, url, creator and datePublished.
    """
    scene = sets[0].scene
    engines = ", ".join(dict.fromkeys(data.attributes["engine"] for data in sets))
    text = (
        f"Trajectories of {scene.name} ({scene.description or 'a multibody scene'}) in {engines}, "
        f"each checked; {FORMAT} {VERSION}."
    )
    metadata = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": f"mbds-xsim-{scene.name}",
        "description": text,
        "keywords": ["multibody dynamics", "simulation", *engines.split(", ")],
        "distribution": [*_distribution(sets, joint)],
        "recordSet": [_records("arrays", _arrays()), _records("counts", _counts(sets))],
    }
    return _json(metadata)


def _distribution(sets: Sequence[Dataset], joint: Path) -> Iterator[dict[str, Any]]:
    """The joined files, and the shards that they read from."""
    for path in (*(data.path for data in sets), joint):
        yield _node(
            "FileObject",
            path.name,
            contentUrl=path.name,
            contentSize=f"{path.stat().st_size} B",
            encodingFormat=_HDF5,
            sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        )
    for data in sets:
        folder = data.path.stem
        yield _node(
            "FileSet",
            f"{folder}-shards",
            description=f"the trajectories of {data.path.name}, which has their checksums",
            encodingFormat=_HDF5,
            includes=f"{folder}/*.h5",
        )


def _records(name: str, rows: Sequence[dict[str, str | int]]) -> dict[str, Any]:
    """Put a table into the metadata itself."""
    fields = [
        _node("Field", f"{name}/{key}", dataType=_TYPES[type(value)])
        for key, value in rows[0].items()
    ]
    data = [{f"{name}/{key}": value for key, value in row.items()} for row in rows]
    return _node("RecordSet", name, field=fields, data=data)


def _node(kind: str, name: str, **more: Any) -> dict[str, Any]:
    return {"@type": f"cr:{kind}", "@id": name, "name": name, **more}


def _arrays() -> list[dict[str, str | int]]:
    """Datasets of the HDF5 files, as `docs/dataset-layout.md` lists them."""
    return [
        {
            "path": field.name,
            "axes": ", ".join(field.axes),
            "type": field.dtype,
            "unit": field.unit,
            "meaning": field.meaning,
        }
        for field in FIELDS.values()
        if "joined" in field.kinds
    ]


def _counts(sets: Sequence[Dataset]) -> list[dict[str, str | int]]:
    """Trajectories of each file, part of the split, and interval."""
    return [
        {"file": data.path.name, "split": part, "interval": interval, "trajectories": number}
        for data in sets
        for part, counts in counts_of(data).items()
        for interval, number in counts.items()
        if part in SPLITS and interval in INTERVALS
    ]
