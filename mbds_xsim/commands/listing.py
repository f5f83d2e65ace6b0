"""`mbds-xsim engines`, `scenes` and `show`: what there is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.text import counted
from mbds_xsim.commands import shared
from mbds_xsim.report.blocks import Block, Remark, Remarks, Text, table_of

if TYPE_CHECKING:
    from mbds_xsim.report.catalogue import EngineRow, SceneRow
    from mbds_xsim.scene.scene import Scene


@shared.command("check")
def engines(
    json: shared.JsonFile = None,
    markdown: Annotated[
        bool, Option("--markdown", help="Print the page docs/engines.md instead.")
    ] = False,
) -> None:
    """List the engines, their methods, and what each cannot do."""
    from mbds_xsim.report.catalogue import engine_rows, engines_page

    if markdown and json:
        msg = "engines gives one form at a time; choose one of --markdown and --json"
        raise InputError(msg)
    shared.check_targets(json=json)
    rows = engine_rows()
    if markdown:
        print(engines_page(rows), end="")
    else:
        shared.answer((block for row in rows for block in _about_engine(row)), rows, json)


@shared.command("check")
def scenes(json: shared.JsonFile = None) -> None:
    """List the built-in scenes: size, degrees of freedom, what each needs of an engine."""
    from mbds_xsim.report.catalogue import scene_rows

    shared.check_targets(json=json)
    rows = scene_rows()
    shared.answer(_about_scenes(rows), rows, json)


@shared.command("check")
def show(
    scene: shared.SceneName,
    toml: Annotated[bool, Option("--toml", help="Print it as a scene file.")] = False,
    native: Annotated[
        str | None,
        Option(metavar="ENGINE", help="Print exactly what this engine is given, to run."),
    ] = None,
    settings: Annotated[
        str, Option(help="With --native: matched, native, or a file of `match --out`.")
    ] = "matched",
    png: Annotated[Path | None, Option(metavar="FILE", help="Draw it into a file.")] = None,
    start: Annotated[
        int | None,
        Option(
            help="With --png or --native: as this trajectory starts, not as the scene is written.",
            min=0,
            max=10**15,
        ),
    ] = None,
    json: shared.JsonFile = None,
) -> None:
    """Say what a scene is and needs, draw it, or print what an engine is given.

    Examples:
        mbds-xsim show 3ladder --png ladder.png
        mbds-xsim show 5pendulum --native mujoco > pendulum.xml
        mbds-xsim show 5pendulum --start 2 --native dart | python
    """
    from mbds_xsim.report.catalogue import native_text, scene_row
    from mbds_xsim.scene.file import write_scene

    if sum(map(bool, (toml, native, json))) > 1:
        msg = "show gives one form at a time; choose one of --toml, --native and --json"
        raise InputError(msg)
    if start is not None and png is None and native is None:
        msg = f"--start: got {start}, which says what is drawn or given; add --png or --native"
        raise InputError(msg)
    shared.check_targets(json=json, png=png)
    loaded = shared.scene_named(scene)
    if png is not None:
        from mbds_xsim.report.draw import draw_scene

        draw_scene(loaded, png, start=start)
    if native is not None:
        from mbds_xsim.measure.quick import searched
        from mbds_xsim.simulate.choice import Choice

        console = shared.console_for(Path("-"))
        choice = Choice.parse(engines=native, profiles=settings)
        with shared.progress_on(console) as progress:
            choice = searched(loaded, choice, progress=progress)
        (contender,), _ = choice.contenders(loaded)
        print(native_text(loaded, native, contender.settings, start))
    elif toml:
        print(write_scene(loaded), end="")
    else:
        row = scene_row(loaded)
        shared.answer(_about_scene(loaded, row), row, json)


def _about_engine(row: EngineRow) -> Iterator[Block]:
    """Say what an engine's methods are, and what it and they cannot do."""
    coordinates = f", {row.coordinates} coordinates" if row.coordinates else ""
    yield Text(f"{row.engine} {row.version}{coordinates}", "strong")
    if row.fault:
        yield Text(row.fault)
    yield Remarks.of((m.name, f"{m.family}, order {m.order}") for m in row.methods)
    yield Remarks(tuple(_refusals("cannot", row.limits)))
    for method in row.methods:
        yield Remarks(tuple(_refusals(f"{method.name} cannot", method.refuses)))
    yield Text("")


def _refusals(who: str, refusals: dict[str, str]) -> Iterator[Remark]:
    from mbds_xsim.report.catalogue import by_reason

    for reason, features in by_reason(refusals).items():
        yield Remark(who, f"{', '.join(features)}: {reason}")


def _about_scenes(rows: list[SceneRow]) -> Iterator[Block]:
    yield table_of(
        ["scene", ">dim", ">bodies", ">particles", ">joints", ">loops", ">dof", "needs"],
        [
            [
                row.scene,
                f"{row.dimension}D",
                *map(str, (row.bodies, row.particles, row.joints, row.loops)),
                str(row.degrees_of_freedom),
                ", ".join(row.needs),
            ]
            for row in rows
        ],
    )
    yield Text("Families of any size: Npendulum, Nladder; or the path of a scene file.")


def _about_scene(scene: Scene, row: SceneRow) -> Iterator[Block]:
    """Say what a scene is, what it needs and how its starts are drawn."""
    from mbds_xsim.scene.mechanism import Mechanism

    mechanism, clock = Mechanism.of(scene), scene.clock
    loops = ", ".join(joint.name for joint in mechanism.loops) or "none"
    freedom = counted(row.degrees_of_freedom, "degree of freedom", "degrees of freedom")
    yield Text(f"{scene.name}  {scene.description}", "strong")
    if scene.source:
        yield Text(f"source: {scene.source}")
    yield Text(
        f"{counted(row.bodies, 'body')}, {counted(row.particles, 'particle')}, "
        f"{mechanism.mass.sum():g} kg, {freedom}, {scene.dimension}D"
    )
    yield Text(f"{counted(row.joints, 'joint')}; loops closed by: {loops}")
    yield Text(
        f"{counted(clock.steps, 'step')} of {clock.frame:g} s ({clock.duration:g} s); length "
        f"{scene.length:g} m; noise {scene.noise:g} N"
    )
    yield Text(f"needs: {', '.join(row.needs) or 'nothing'}")
    yield from (Text(f"draws {_term(term)}") for term in scene.sampling)


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
    from mbds_xsim.scene.sampling_terms import INTERVALS, Levels

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
