"""Terminal tables of what there is: engines, scenes, one scene."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mbds_xsim.catalogue import EngineRow, SceneRow, by_reason
from mbds_xsim.counted import counted
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.sampling_terms import INTERVALS, Levels
from mbds_xsim.scene import Scene

__all__ = ["print_engines", "print_scene", "print_scenes"]


def print_engines(rows: list[EngineRow], console: Console) -> None:
    """Print one block an engine: its methods, and what it and they cannot do."""
    for row in rows:
        coordinates = f", {row.coordinates} coordinates" if row.coordinates else ""
        console.print(Text.assemble((row.engine, "bold"), f" {row.version}{coordinates}"))
        if row.fault:
            console.print(Text(f"  {row.fault}"))
        grid = Table.grid(padding=(0, 2, 0, 0), pad_edge=False)
        grid.add_column(no_wrap=True)
        grid.add_column(overflow="fold")
        for method in row.methods:
            grid.add_row(f"  {method.name}", f"{method.family}, order {method.order}")
        _add_refusals(grid, "  cannot", row.limits)
        for method in row.methods:
            _add_refusals(grid, f"  {method.name} cannot", method.refuses)
        console.print(grid)
        console.print()


def _add_refusals(grid: Table, who: str, refusals: dict[str, str]) -> None:
    for reason, features in by_reason(refusals).items():
        grid.add_row(who, f"{', '.join(features)}: {reason}")
        who = ""


def print_scenes(rows: list[SceneRow], console: Console) -> None:
    """Print one line a scene, and the mean number of particles."""
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("scene")
    for column in ("dim", "bodies", "particles", "joints", "loops", "dof"):
        table.add_column(column, justify="right")
    table.add_column("needs", overflow="fold")
    for row in rows:
        table.add_row(
            row.scene,
            f"{row.dimension}D",
            str(row.bodies),
            str(row.particles),
            str(row.joints),
            str(row.loops),
            str(row.degrees_of_freedom),
            ", ".join(row.needs),
        )
    console.print(table)
    console.print("Families of any size: Npendulum, Nladder; or the path of a scene file.")


def print_scene(scene: Scene, row: SceneRow, console: Console) -> None:
    """Print what a scene is, what it needs and how its starts are drawn."""
    mechanism = Mechanism.of(scene)
    clock = scene.clock
    lines = [
        Text.assemble((scene.name, "bold"), f"  {scene.description}"),
        *([f"source: {scene.source}"] if scene.source else []),
        f"{counted(row.bodies, 'body')}, {counted(row.particles, 'particle')}, "
        f"{mechanism.mass.sum():g} kg, "
        f"{counted(row.degrees_of_freedom, 'degree of freedom', 'degrees of freedom')}, "
        f"{scene.dimension}D",
        f"{counted(row.joints, 'joint')}; loops closed by: "
        + (", ".join(joint.name for joint in mechanism.loops) or "none"),
        f"{counted(clock.steps, 'step')} of {clock.frame:g} s ({clock.duration:g} s); length "
        f"{scene.length:g} m; noise {scene.noise:g} N",
        f"needs: {', '.join(row.needs) or 'nothing'}",
        *(f"draws {_term(term)}" for term in scene.sampling),
    ]
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True)


def _term(term: object) -> str:
    fields = {key: getattr(term, key) for key in term.__struct_fields__}  # type: ignore[attr-defined]
    parts = [f"{key}: {_shown(value)}" for key, value in fields.items() if not _nothing(value)]
    kind = term.__struct_config__.tag  # type: ignore[attr-defined]
    return f"{kind} ({'; '.join(parts)})"


def _nothing(value: object) -> bool:
    """Whether a value switches nothing on, or a vector or range is zero all over."""
    return value is False or (isinstance(value, tuple) and not any(v != 0.0 for v in _flat(value)))


def _flat(value: object) -> list[object]:
    return [w for v in value for w in _flat(v)] if isinstance(value, tuple) else [value]


def _shown(value: object) -> str:
    """Give ranges, by interval and by component, in few words."""
    if isinstance(value, Levels):
        return ", ".join(f"{name} {_shown(getattr(value, name))}" for name in INTERVALS)
    if isinstance(value, float):
        return f"{value:g}"
    if not isinstance(value, tuple):
        return str(value)
    if len(value) > 6:
        return f"{value[0]} … {value[-1]}"
    if isinstance(value[0], tuple | Levels):
        spans = zip("xyz", value, strict=True)
        return ", ".join(f"{name} {_shown(span)}" for name, span in spans if not _nothing(span))
    inner = ", ".join(map(_shown, value))
    return inner if isinstance(value[0], str) else f"[{inner}]"
