"""What makes of the model's listing a program that runs to the end: the start and the frames."""

from __future__ import annotations

from collections.abc import Iterator

from mbds_xsim.mechanism import Mechanism
from mbds_xsim.shapes import THIN, shapes

__all__ = ["graphics_listing", "script"]

_START = """
# Inputs are left out: of a frame, loads of `forces` and `torques` by mbs.SetLoadParameter.
start = exu.ConfigurationType.Initial
mbs.systemData.SetODE2Coordinates({coordinates!r}, start)
mbs.systemData.SetODE2Coordinates_t({velocities!r}, start)
"""
_MEMORY = "mbs.systemData.SetDataCoordinates({memory!r}, start)\n"
_RUN = """
# To watch it: container.renderer.Start(); container.renderer.DoIdleTasks()
for _ in range({count}):
    next_frame()
kinds = exu.OutputVariableType
for body, frame in enumerate(frames):  # centre of mass, rotation matrix, velocity, angular velocity
    told = (kinds.Position, kinds.RotationMatrix, kinds.Velocity, kinds.AngularVelocity)
    print(body, *(mbs.GetMarkerOutput(frame, kind).tolist() for kind in told))
"""


def graphics_listing(mechanism: Mechanism) -> Iterator[str]:
    """Lines that give rigid bodies something to be seen by."""
    parts: dict[int, list[str]] = {body: [] for body in range(mechanism.body_count)}
    for shape in shapes(mechanism):
        begin, *ends = shape.points
        parts[shape.body].append(
            f"graphics.Cylinder({begin!r}, {ends[0]!r}, {shape.radius!r})"
            if ends
            else f"graphics.Sphere({begin!r}, {shape.radius!r})"
        )
    yield "import exudyn.graphics as graphics"
    yield ""
    size = 2.0 * THIN * mechanism.scene.length
    yield f"container.visualizationSettings.connectors.defaultSize = {size!r}"
    for body, drawn in parts.items():
        made = ", ".join(drawn)
        yield f"mbs.SetObjectParameter(bodies[{body}], 'VgraphicsData', [{made}])"


def script(
    coordinates: list[float], velocities: list[float], memory: list[float] | None, count: int
) -> str:
    """Write the start and the frames.

    Args:
        coordinates: At the start.
        velocities: At the start.
        memory: What the contacts' nodes hold at the start; None without contact.
        count: Frames.
    """
    start = _START.format(coordinates=coordinates, velocities=velocities)
    if memory is not None:
        start += _MEMORY.format(memory=memory)
    return start + _RUN.format(count=count)
