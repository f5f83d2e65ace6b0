"""Description of the data sets of a scene, stored next to them: a card, and metadata.

The metadata are in the Croissant format of MLCommons, version 1.0
(http://mlcommons.org/croissant/1.0). They list the files with their checksums and, as inline
records, the arrays in them: Croissant itself cannot describe the content of an HDF5 file.
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
from mbds_xsim.dataset.hdf5 import ROUNDING, open_hdf5, variant_files
from mbds_xsim.dataset.layout import FIELDS, FORMAT, JOINT, SPLITS, VERSION
from mbds_xsim.dataset.read import Dataset, load_dataset
from mbds_xsim.dataset.summary import causes_of, counts_of
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

    A publisher's additions are kept: in the metadata always, in the card until the data change.

    Raises:
        InputError: The data cannot be read, or the files cannot be written.
    """
    for name, content in descriptions(folder).items():
        put(folder / name, _with_additions(folder / name, content))


def descriptions(folder: Path) -> dict[str, bytes]:
    """Return the card and the metadata of the data in a folder, keyed by file name.

    Raises:
        InputError: The data cannot be read.
    """
    sets = [load_dataset(path) for path in variant_files(folder)]
    joint = folder / JOINT
    return {CARD: _card(sets, joint).encode(), CROISSANT: _croissant(sets, joint)}


def missing_lines(text: str, wanted: str) -> Iterator[tuple[int, str]]:
    """Yield the first wanted line, with its number, that a text lacks or has in another order."""
    rest = iter(text.split("\n"))
    for number, line in enumerate(wanted.split("\n"), 1):
        if line not in rest:  # consumes the text up to this line
            yield number, line
            return


def _with_additions(path: Path, content: bytes) -> bytes:
    """Return the new content of a card or of metadata, with the additions of a publisher.

    Metadata keep the entries that the data do not give. A card that still has every line that the
    data give stays as it is; otherwise it is written anew, without additions.
    """
    try:
        old = path.read_bytes()
        if path.suffix != ".json":
            return content if any(missing_lines(old.decode(), content.decode())) else old
        stored, entries = json.loads(old), json.loads(content)
    except (OSError, ValueError):
        return content
    if not isinstance(stored, dict) or stored.keys() <= entries.keys():
        return content
    added = {key: value for key, value in stored.items() if key not in entries}
    return _json(entries | added)


def _json(metadata: dict[str, Any]) -> bytes:
    return (json.dumps(metadata, indent=2, ensure_ascii=False) + "\n").encode()


def _card(sets: Sequence[Dataset], joint: Path) -> str:
    attrs, scene = in_markdown(sets[0].attributes), sets[0].scene
    noise = "with" if attrs["noise"] and scene.noise else "without"
    intro = sentence(in_markdown(scene.description))
    with open_hdf5(joint) as file:
        valid = np.asarray(file["valid_in_all"][()])
    digest = hashlib.sha256(sets[0].attributes["scene"].encode()).hexdigest()
    example = next((data for data in sets if len(data)), sets[0]).path.name
    empty = " and ".join(f"`{data.path.name}`" for data in sets if data.lack)
    but = f" but {empty}, without any" if empty else ""
    rows = "".join(_row(data) for data in sets)
    rejected = "".join(_rejections(data) for data in sets)
    return f"""# {in_markdown(scene.name)}: simulated trajectories

{intro}{scene.dimension}D, bodies: {len(scene.bodies)}, points: {len(sets[0]["graph/point_body"])};
{attrs["steps"]} steps of {attrs["frame_s"]:g} s a trajectory, SI units, z up. Starts and inputs are
those of seed {attrs["seed"]}, {noise} random forces: trajectory i is the same start in every file,
in the speed interval low, medium or high by i mod 3.

| file | engine | method | step [s] | | drawn | published | rejected |
| --- | --- | --- | --- | --- | --- | --- | --- |
{rows}
{valid.sum()} of {len(valid)} are published in all of them{but} (`{joint.name}`). *Certified*: every
check of every trajectory held, and the engine's model read back as the scene. *Uncertified*: at an
engine's native settings, those that an ordinary user gets, or at other named settings; only finite
numbers and the start decided, and the figures of all checks are stored.
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

Simulated, not measured: the reference solves the scene's own equations, which assume rigid bodies
and ideal joints. Beyond the time at which neighbouring motions part, a trajectory is one of many
that the scene allows. Rejected trajectories are missing in the file where they were rejected; if
hard motions are rejected more often, what is left is biased towards easy ones.{_rounding(sets)}

## Versions

mbds-xsim {_each(sets, "mbds_xsim_version")}, numpy {_each(sets, "numpy_version")}, layout
{attrs["layout_version"]}; SHA-256 of the scene {digest[:16]}…. `{CROISSANT}` has the files'
checksums; who publishes the data adds `license`, `url`, `creator` and `datePublished` there.
"""


def _rounding(sets: Sequence[Dataset]) -> str:
    """Say by how much float32 rounds positions, if by more than gaps may have; else nothing."""
    largest = 0.0
    for path in (path for data in sets for path in data.files):
        with open_hdf5(path) as file:
            largest = max(largest, float(file["position"].attrs.get(ROUNDING, 0.0)))
    if largest <= sets[0].scene.budget.gap:
        return ""
    return (
        f" In `position`, float32 rounds by up to {largest:.1g} m here; `body/position` is exact."
    )


def _split(sets: Sequence[Dataset]) -> str:
    """Describe the split, and whether a trajectory is in the same part in all files."""
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
    """Return the step, or the tolerance of the reference, which chooses its own steps."""
    if _is_truth(data):
        return f"{RTOL} {json.loads(data.attributes['options'])[RTOL]:g}"
    return f"{data.attributes['step_s']:.6g}"


def _is_truth(data: Dataset) -> bool:
    return bool(data.attributes["method_family"] == TRUTH)


def _truth(sets: Sequence[Dataset]) -> str:
    """Describe data made by the reference and not by an engine; empty if there are none."""
    names = " and ".join(f"`{data.path.name}`" for data in sets if _is_truth(data))
    return (
        f"{names}: made by the reference of mbds-xsim, which engines are held against, and not by "
        "an engine. All checks were made all the same; the distance to the reference, of three "
        "trajectories, is that of two tolerances there.\n"
        if names
        else ""
    )


def _rejections(data: Dataset) -> str:
    """Return a line that counts rejections by check; empty if all trajectories passed."""
    counts = sorted(causes_of(data).items())
    if not counts:
        return ""
    listing = ", ".join(f"{cause} {count}" for cause, count in counts)
    return f"\nRejected from `{data.path.name}` by the check that failed first: {listing}.\n"


def _parts(data: Dataset) -> str:
    return "".join(
        f"| `{data.path.name}` | {part} | {' | '.join(map(str, counts.values()))} |\n"
        for part, counts in counts_of(data).items()
    )


def _croissant(sets: Sequence[Dataset], joint: Path) -> bytes:
    """Describe the data sets of one scene; the same data give the same bytes.

    Entries that only a publisher knows are left out: license, url, creator and datePublished.
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
    """Yield the joined files, the joint file, and the shards that the joined files read from."""
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
    """Return a table as inline records of the metadata."""
    fields = [
        _node("Field", f"{name}/{key}", dataType=_TYPES[type(value)])
        for key, value in rows[0].items()
    ]
    data = [{f"{name}/{key}": value for key, value in row.items()} for row in rows]
    return _node("RecordSet", name, field=fields, data=data)


def _node(kind: str, name: str, **more: Any) -> dict[str, Any]:
    return {"@type": f"cr:{kind}", "@id": name, "name": name, **more}


def _arrays() -> list[dict[str, str | int]]:
    """List the datasets of the joined files, as in `docs/dataset-layout.md`."""
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
    """Count the trajectories of each file, part of the split, and interval."""
    return [
        {"file": data.path.name, "split": part, "interval": interval, "trajectories": number}
        for data in sets
        for part, counts in counts_of(data).items()
        for interval, number in counts.items()
        if part in SPLITS and interval in INTERVALS
    ]
