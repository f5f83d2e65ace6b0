"""Sentences that say what an engine's reader lost."""

from __future__ import annotations

from mbds_xsim.base.text import counted
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Cell, Report, Row, Table, columns_of
from mbds_xsim.studies.readers.compare import Difference, Reading, Readings


def present(readings: Readings, command: str) -> Report:
    """Say what each engine makes of a file.

    Args:
        readings: Of the engines.
        command: That made them.
    """
    wrong = [reading.engine for reading in readings.readings if not reading.alike]
    right = [reading.engine for reading in readings.readings if reading.alike]
    return Report(
        title=readings.file,
        what="read alike by all engines" if not wrong else "read otherwise",
        description=f"{readings.format}: {counted(readings.links, 'link')} that can move, "
        f"{counted(readings.joints, 'joint')}",
        conclusion=f"as the file says: {', '.join(right) or 'no engine'}; "
        f"otherwise: {', '.join(wrong) or 'none'}",
        blocks=(_table(readings),),
        command=command,
        verdict="fail" if wrong else "pass",
    )


def _table(readings: Readings) -> Table:
    columns = columns_of("engine", "field", ">wrong", ">of", "for one", "engine has", "file says")
    rows = [row for reading in readings.readings for row in _rows(reading)]
    return Table(columns, tuple(rows), "what engines' own readers make of it", grouped=True)


def _rows(reading: Reading) -> list[Row]:
    if reading.refused:
        cells = (reading.engine, "", "", "", "", f"refuses: {reading.refused}", "")
        return [Row((Cell(reading.engine, "fail"), *map(Cell, cells[1:])), "fail")]
    if reading.alike:
        rest = map(Cell, ("", "0", "", "", "all that the file says", ""))
        return [Row((Cell(reading.engine, "pass"), *rest))]
    rows = [_row(reading.engine, difference) for difference in reading.differences]
    gone = "none" if reading.moved_m is None else f"{quantity.length(reading.moved_m)} off"
    end = map(Cell, ("motion after 1 s", "", "", "", gone, ""))
    return [*rows, Row((Cell(reading.engine, "fail"), *end))]


def _row(engine: str, difference: Difference) -> Row:
    cells = (
        f"{difference.field} of {difference.of}",
        str(difference.count),
        str(difference.among),
        difference.first,
        difference.read,
        difference.stated,
    )
    return Row((Cell(engine, "fail"), *map(Cell, cells)))
