"""`mbds-xsim engines`, `scenes` and `show`: what there is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mbds_xsim.commands.shared import (
    JsonFile,
    SceneName,
    check_targets,
    command,
    console_for,
    encoded,
    progress_on,
    scene_named,
    write_json,
)
from mbds_xsim.errors import InputError

__all__ = ["engines", "scenes", "show"]


@command("check")
def engines(
    json: JsonFile = None,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Print the page docs/engines.md instead.")
    ] = False,
) -> None:
    """List the engines, their methods, and what each cannot do."""
    from mbds_xsim.catalogue import engine_rows
    from mbds_xsim.report.engines_page import engines_page
    from mbds_xsim.report.lists import print_engines

    if markdown and json:
        msg = "engines gives one form at a time; choose one of --markdown and --json"
        raise InputError(msg)
    check_targets(json=json)
    rows = engine_rows()
    if markdown:
        print(engines_page(rows), end="")
    else:
        print_engines(rows, console_for(json))
    write_json(encoded(rows), json)


@command("check")
def scenes(json: JsonFile = None) -> None:
    """List the built-in scenes: size, degrees of freedom, what each needs of an engine."""
    from mbds_xsim.catalogue import scene_rows
    from mbds_xsim.report.lists import print_scenes

    check_targets(json=json)
    rows = scene_rows()
    print_scenes(rows, console_for(json))
    write_json(encoded(rows), json)


@command(
    "check",
    epilog="Examples:  mbds-xsim show 3ladder --png ladder.png  ·  "
    "mbds-xsim show 5pendulum --native mujoco > pendulum.xml  ·  "
    "mbds-xsim show 5pendulum --start 2 --native dart | python",
)
def show(
    scene: SceneName,
    toml: Annotated[bool, typer.Option("--toml", help="Print it as a scene file.")] = False,
    native: Annotated[
        str | None,
        typer.Option(metavar="ENGINE", help="Print exactly what this engine is given, to run."),
    ] = None,
    settings: Annotated[
        str, typer.Option(help="With --native: matched, native, or a file of `match --out`.")
    ] = "matched",
    png: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw it into a file.")] = None,
    start: Annotated[
        int | None,
        typer.Option(
            help="With --png or --native: as this trajectory starts, not as the scene is written.",
            min=0,
        ),
    ] = None,
    json: JsonFile = None,
) -> None:
    """Say what a scene is and needs, draw it, or print what an engine is given."""
    from mbds_xsim.catalogue import native_text, scene_row
    from mbds_xsim.report.lists import print_scene
    from mbds_xsim.scene_file import write_scene

    if sum(map(bool, (toml, native, json))) > 1:
        msg = "show gives one form at a time; choose one of --toml, --native and --json"
        raise InputError(msg)
    if start is not None and png is None and native is None:
        msg = f"--start: got {start}, which says what is drawn or given; add --png or --native"
        raise InputError(msg)
    check_targets(json=json, png=png)
    loaded = scene_named(scene)
    if png is not None:
        from mbds_xsim.report.draw import draw_scene

        draw_scene(loaded, png, start=start)
    if native is not None:
        from mbds_xsim.choice import Choice
        from mbds_xsim.measure.quick import searched

        console = console_for(Path("-"))
        choice = Choice.parse(engines=native, profiles=settings)
        with progress_on(console) as progress:
            choice = searched(loaded, choice, progress=progress)
        (contender,), _ = choice.contenders(loaded)
        print(native_text(loaded, native, contender.settings, start))
    elif toml:
        print(write_scene(loaded), end="")
    else:
        row = scene_row(loaded)
        print_scene(loaded, row, console_for(json))
        write_json(encoded(row), json)
