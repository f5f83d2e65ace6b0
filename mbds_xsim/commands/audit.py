"""`mbds-xsim audit`: check trajectories from anywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Exit, Option

from mbds_xsim.commands import shared


@shared.command(
    "data",
    epilog="Examples:  mbds-xsim audit lab.csv --scene 6pendulum  ·  "
    "mbds-xsim audit model.npz --scene 6pendulum --index 0-9 --seed 0",
)
def audit(
    file: Annotated[Path, Argument(metavar="FILE", help="Of trajectories: npz, CSV, HDF5.")],
    scene: Annotated[
        str | None,
        Option(help="A built-in name, a family with a size, or a file; else the file's own."),
    ] = None,
    index: Annotated[
        str | None, Option(help="Numbers of the starts, as 0-9,15: compares with them, too.")
    ] = None,
    seed: Annotated[int | None, Option(help="Seed of those starts.", min=0)] = None,
    noise: Annotated[
        bool | None, Option(help="Whether their random forces acted.", show_default=False)
    ] = None,
    order: Annotated[
        int | None, Option(help="Order of the method that made it; else first.", min=1)
    ] = None,
    step: Annotated[
        float | None, Option(help="Its integration step [s]; else the frame.", min=1e-12)
    ] = None,
    velocity_lag: Annotated[
        float | None, Option(help="Velocities belong to frame time + lag [s].")
    ] = None,
    contact_time: Annotated[
        float | None, Option(help="Over which it spreads an impact [s].", min=0.0)
    ] = None,
    json: shared.JsonFile = None,
    html: shared.HtmlFile = None,
    opened: shared.Opened = False,
) -> None:
    """Check trajectories from anywhere: another engine, a lab, a learned model."""
    from mbds_xsim.dataset.audit import audit_file
    from mbds_xsim.dataset.foreign import Provenance
    from mbds_xsim.dataset.read import parse_numbers
    from mbds_xsim.report.terminal import print_report
    from mbds_xsim.studies.audit.present import present

    console = shared.console_for(json)
    shared.check_targets(json=json, html=html)
    origin = Provenance(
        index=None if index is None else tuple(parse_numbers(index, "--index")),
        seed=seed,
        noise=noise,
        step_s=step,
        method_order=order,
        velocity_lag_s=velocity_lag,
        contact_time_s=contact_time,
    )
    audited = audit_file(file, None if scene is None else shared.scene_named(scene), origin)
    report = present(audited, shared.command_line())
    print_report(report, console)
    shared.deliver([report], audited.file, console, html=html, opened=opened)
    shared.write_json(shared.encoded(audited, "audit"), json)
    raise Exit(0 if audited.verdict == "pass" else 1)
