"""Metadata of the data sets of a scene in the Croissant format of MLCommons, version 1.0.

It lists the files with their checksums and, as inline records, the arrays in them: Croissant
itself has no way into an HDF5 file. See http://mlcommons.org/croissant/1.0.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from mbds_xsim.dataset.layout import FIELDS, FORMAT, VERSION
from mbds_xsim.dataset.read import Dataset
from mbds_xsim.dataset.split import NAMES
from mbds_xsim.dataset.summary import counts_of
from mbds_xsim.sampling_terms import INTERVALS

__all__ = ["croissant"]

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


def croissant(sets: Sequence[Dataset], joint: Path) -> bytes:
    """Describe the data sets of one folder; the same data give the same bytes.

    What only a publisher knows is left out: license, url, creator and datePublished.

    Args:
        sets: Data sets of one scene.
        joint: The file that says what is valid in all of them.
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
    return (json.dumps(metadata, indent=2, ensure_ascii=False) + "\n").encode()


def _distribution(sets: Sequence[Dataset], joint: Path) -> Iterator[dict[str, Any]]:
    """The joined files, and the shards that they read from."""
    for path in (*(data.path for data in sets), joint):
        yield {
            "@type": "cr:FileObject",
            "@id": path.name,
            "name": path.name,
            "contentUrl": path.name,
            "contentSize": f"{path.stat().st_size} B",
            "encodingFormat": _HDF5,
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        }
    for data in sets:
        folder = data.path.stem
        yield {
            "@type": "cr:FileSet",
            "@id": f"{folder}-shards",
            "name": f"{folder}-shards",
            "description": f"the trajectories of {data.path.name}, which has their checksums",
            "encodingFormat": _HDF5,
            "includes": f"{folder}/*.h5",
        }


def _records(name: str, rows: Sequence[dict[str, str | int]]) -> dict[str, Any]:
    """Put a table into the metadata itself."""
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"{name}/{key}",
                "name": f"{name}/{key}",
                "dataType": _TYPES[type(value)],
            }
            for key, value in rows[0].items()
        ],
        "data": [{f"{name}/{key}": value for key, value in row.items()} for row in rows],
    }


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
        for field in FIELDS
        if "joined" in field.kinds
    ]


def _counts(sets: Sequence[Dataset]) -> list[dict[str, str | int]]:
    """Trajectories of each file, part of the split, and interval."""
    return [
        {"file": data.path.name, "split": part, "interval": interval, "trajectories": number}
        for data in sets
        for part, counts in counts_of(data).items()
        for interval, number in counts.items()
        if part in NAMES and interval in INTERVALS
    ]
