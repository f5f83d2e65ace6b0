"""A shift study on the terminal: the matrices of one frame, and the answers."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table as Grid
from rich.text import Text

from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.report.shift_markdown import protocol
from mbds_xsim.report.shift_matrix import trained_models
from mbds_xsim.report.shift_tables import tables

__all__ = ["print_shift"]


def print_shift(shift: Shift, console: Console) -> None:
    """Print a matrix for each model, and the answers."""
    console.print(Text.assemble("\n", (shift.scene, "bold"), f": {protocol(shift)}."))
    for table, _ in zip(tables(shift), trained_models(shift), strict=False):
        grid = Grid(title=f"{table.title} [m²]", title_justify="left", box=None)
        for place, heading in enumerate(table.heading):
            grid.add_column(heading, justify="right" if place else "left")
        for row in table.rows:
            grid.add_row(*row)
        console.print(grid)
    for answer in shift.answers:
        console.print(Text.assemble((answer.question, "bold"), f" {answer.answer}."))
    for name, reason in shift.left_out.items():
        console.print(f"{name} left out: {reason}", highlight=False)
