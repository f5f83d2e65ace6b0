"""Redraw charts and maps from the results stored next to them.

python benchmarks/pictures.py reports
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec

from mbds_xsim.base.files import read_file, write_whole
from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.studies.releases import present as releases
from mbds_xsim.studies.releases.steps import History
from mbds_xsim.studies.shift import present as shift
from mbds_xsim.studies.stability import SCHEMA, MapCell, Panel, Survey
from mbds_xsim.studies.stability import present as stability
from mbds_xsim.studies.stability.studies import study_named
from mbds_xsim.studies.stability.verdict import CRITERIA
from mbds_xsim.studies.tradeoff import Tradeoff
from mbds_xsim.studies.tradeoff import present as tradeoff


def main(folder: Path) -> None:
    for stored in stored_results(folder):
        if (picture := picture_of(stored)).is_file():
            write_whole(picture, drawn(stored))


def stored_results(folder: Path) -> Iterator[Path]:
    """Yield the stored results that charts and maps are drawn from."""
    for kind in ("tradeoff", "models", "shift", "lite", "stability"):
        results = sorted((folder / kind).glob("*.json*"))
        yield from results
        tables = (folder / kind).glob("*.csv")
        yield from sorted(table for table in tables if table.with_suffix(".json") not in results)
    yield from folder.glob("releases.json.gz")


def picture_of(stored: Path) -> Path:
    """Return the path of the picture next to a stored result."""
    return stored.with_name(stored.name.partition(".")[0] + ".png")


def drawn(stored: Path) -> bytes:
    """Draw the picture of a stored result."""
    if stored.suffix == ".csv":
        return stability.to_png([sweep_of(stored.read_text("utf-8"))], stored.read_bytes())
    text = read_file(stored)
    if stored.name == "releases.json.gz":
        return releases.to_png(msgspec.json.decode(text, type=list[History]), text)
    if stored.parent.name in ("shift", "lite"):
        return shift.to_png([msgspec.json.decode(text, type=Shift)], text)
    return tradeoff.to_png([msgspec.json.decode(text, type=Tradeoff)], text)


def sweep_of(table: str) -> Survey:
    """Read a map's cells from their CSV; fields that the picture does not show stay empty."""
    cells = [_cell(row) for row in csv.DictReader(io.StringIO(table))]
    study = study_named(cells[0].study)
    panels = _panels(cells)
    return Survey(
        schema=SCHEMA,
        study=study.name,
        sentence=study.sentence,
        quantity=study.quantity,
        unit=study.unit,
        values=tuple(dict.fromkeys(cell.value for cell in cells)),
        steps_s=panels[0].steps_s,
        duration_s=cells[0].duration_s,
        criteria=CRITERIA,
        panels=tuple(panels),
        left_out={},
        unknown={},
        command="",
        versions={},
        machine=cells[0].machine,
        workers=0,
        measured=0,
        kept=len(cells),
        wall_s=0.0,
    )


def _panels(cells: list[MapCell]) -> list[Panel]:
    """Split the cells into panels: each begins at the first value.

    In stored tables, a cell that is the same at matched and at native settings may carry the
    profile that it was run for in both panels. The native panel is the later one.
    """
    parts: list[list[tuple[MapCell, ...]]] = []
    for value, row in itertools.groupby(cells, key=lambda cell: cell.value):
        if value == cells[0].value:
            parts.append([])
        parts[-1].append(tuple(row))
    names = [(part[0][0].engine, part[0][0].method) for part in parts]
    profiles = [part[0][0].profile for part in parts]
    for place, name in enumerate(names):
        if names.count(name) > 1:
            profiles[place] = "native" if name in names[:place] else "matched"
    return [
        Panel(
            engine=part[0][0].engine,
            version=part[0][0].version,
            method=part[0][0].method,
            family=part[0][0].family,
            profile=profile,
            cells=tuple(part),
        )
        for part, profile in zip(parts, profiles, strict=True)
    ]


def _cell(row: dict[str, str]) -> MapCell:
    named = any(isinstance(value, str) for value in study_named(row["study"]).values)
    value = row["value"] if named else float(row["value"])
    may_lack = {field.name for field in msgspec.structs.fields(MapCell) if field.default is None}
    given = {name: text for name, text in row.items() if text or name not in may_lack}
    whole = given | {"key": "", "value": value, "options": json.loads(row["options"])}
    return msgspec.convert(whole, MapCell, strict=False)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
