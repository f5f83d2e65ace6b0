"""USD stages of rigid bodies and joints, for the tests of their reader."""

from __future__ import annotations

from pathlib import Path

from mbds_xsim.scene.imported import Imported
from mbds_xsim.simulate.registry import read_model

HEAD = '#usda 1.0\n(\n    metersPerUnit = {}\n    kilogramsPerUnit = {}\n    upAxis = "{}"\n)\n'
SCENE = 'def PhysicsScene "scene"\n{\n}\n'
_MASS = """        float physics:mass = 2
        point3f physics:centerOfMass = (0, 0, -0.5)
        float3 physics:diagonalInertia = (0.5, 0.5, 0.25)
"""
_ORDER = '        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]\n'
_APIS = '(prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"])'


def rigid(name: str, place: str, turn: str = "(1, 0, 0, 0)", inside: str = _MASS) -> str:
    return (
        f'def Xform "{name}" {_APIS}\n{{\n        double3 xformOp:translate = {place}\n'
        f"        quatd xformOp:orient = {turn}\n{_ORDER}{inside}}}\n"
    )


def joined(kind: str, name: str, ends: tuple[str, str], inside: str = "") -> str:
    first, second = (
        f"    rel physics:body{k} = </{end}>\n" if end else "" for k, end in enumerate(ends)
    )
    return f'def Physics{kind}Joint "{name}"\n{{\n{first}{second}{inside}}}\n'


def read(here: Path, *parts: str, units: tuple[float, float, str] = (1, 1, "Z")) -> Imported:
    (here / "model.usda").write_text(HEAD.format(*units) + SCENE + "".join(parts))
    return read_model(here / "model.usda")


PLACE = "    point3f physics:localPos0 = (1, 2, 3)\n"
ARM = (
    rigid("upper", "(1, 2, 3)", "(0.8, 0, 0.6, 0)"),
    rigid("fore", "(1.96, 2, 3.28)", "(0.8, 0, 0.6, 0)"),
    joined(
        "Revolute",
        "shoulder",
        ("", "upper"),
        '    uniform token physics:axis = "Y"\n    point3f physics:localPos0 = (1, 2, 3)\n'
        "    quatf physics:localRot0 = (1, 0, 0, 0)\n"
        "    float physics:lowerLimit = -90\n    float physics:upperLimit = 180\n",
    ),
    joined("Prismatic", "rail", ("upper", "fore"), '    uniform token physics:axis = "Z"\n'),
)

_AXES = ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")


def general(*free: tuple[str, float, float], more: str = "") -> str:
    """Return a general joint of the world and `rod` that locks all but some axes."""
    limits = {axis: (1.0, -1.0) for axis in _AXES} | {axis: span for axis, *span in free}
    inside = "".join(
        f"    float limit:{axis}:physics:{side} = {value}\n"
        for axis, span in limits.items()
        for side, value in zip(("low", "high"), span, strict=True)
    )
    applied = ", ".join(f'"PhysicsLimitAPI:{axis}"' for axis in _AXES)
    applied += ', "PhysicsDriveAPI:transX", "PhysicsDriveAPI:rotX"'
    head, _, rest = joined("", "general", ("", "rod"), inside + more).partition("\n")
    return f"{head} (prepend apiSchemas = [{applied}])\n{rest}"
