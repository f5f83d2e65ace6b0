"""Model files of one shape over a floor, in each format."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array

SHAPES = {
    "sphere": (0.1,),
    "capsule": (0.05, 0.2),
    "box": (0.2, 0.15, 0.1),
    "cylinder": (0.2, 0.1),
}
"""Half-sizes of the shapes [m]."""
PLACE, ANGLES = (0.3, -0.2, 2.0), (0.4, -0.3, 0.7)
INERTIA = " ".join(f'{key}="{float(key[1] == key[2])}"' for key in
                    ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))  # fmt: skip


def words(values: object) -> str:
    return " ".join(map(repr, np.array(values).tolist()))


def turn() -> Array:
    """Return the turn by `ANGLES` about the axes of W, one after another, wxyz."""
    about_x, about_y, about_z = (rotation.from_vector(v) for v in np.diag(ANGLES))
    return rotation.multiply(about_z, rotation.multiply(about_y, about_x))


def mjcf(kind: str, size: tuple[float, ...]) -> str:
    return (
        '<mujoco><worldbody><body name="b"><freejoint/><inertial pos="0 0 0" mass="1" '
        f'diaginertia="1 1 1"/><geom name="s" type="{kind}" size="{words(size)}" '
        f'pos="{words(PLACE)}" quat="{words(turn())}"/></body></worldbody></mujoco>'
    )


def urdf(kind: str, size: tuple[float, ...]) -> str:
    solid = f'<box size="{words(2 * np.array(size))}"/>'
    if kind != "box":
        length = f' length="{2 * size[1]}"' if len(size) > 1 else ""
        solid = f'<{kind} radius="{size[0]}"{length}/>'
    return (
        f'<robot name="r"><link name="b"><inertial><mass value="1"/><inertia {INERTIA}/>'
        f'</inertial><collision><origin xyz="{words(PLACE)}" rpy="{words(ANGLES)}"/>'
        f"<geometry>{solid}</geometry></collision></link></robot>"
    )


BODY = (
    "<inertial><mass>1</mass><inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz><ixy>0</ixy><ixz>0</ixz>"
    "<iyz>0</iyz></inertia></inertial>"
)


def solid(
    kind: str, size: tuple[float, ...], pose: object = (0,) * 6, surface: str = "", name: str = "s"
) -> str:
    inside = f"<size>{words(2 * np.array(size))}</size>"
    if kind != "box":
        length = f"<length>{2 * size[1]}</length>" if len(size) > 1 else ""
        inside = f"<radius>{size[0]}</radius>{length}"
    return (
        f'<collision name="{name}"><pose>{words(pose)}</pose><geometry><{kind}>{inside}</{kind}>'
        f"</geometry><surface>{surface}</surface></collision>"
    )


def link(inside: str, name: str = "b", height: float = 0.0) -> str:
    return (
        f'<model name="{name}"><pose>0 0 {height!r} 0 0 0</pose><link name="{name}">{BODY}{inside}'
        "</link></model>"
    )


def plane(surface: str = "", height: float = 0.0) -> str:
    return (
        f'<model name="floor"><static>1</static><pose>0 0 {height!r} 0 0 0</pose><link name="f">'
        '<collision name="ground"><geometry><plane><normal>0 0 2</normal></plane></geometry>'
        f"<surface>{surface}</surface></collision></link></model>"
    )


def sdf(kind: str, size: tuple[float, ...]) -> str:
    """Return a file whose model has the last of the turns, and its shape the others."""
    *_, yaw = ANGLES
    place = rotation.rotate(rotation.from_vector(np.array([0, 0, -yaw])), np.array(PLACE))
    shape = solid(kind, size, (*place, *ANGLES[:2], 0.0))
    return world(link(shape).replace("0.0 0 0 0</pose>", f"0 0 0 {yaw}</pose>", 1))


def world(*models: str) -> str:
    return f'<sdf version="1.9"><world name="w">{"".join(models)}</world></sdf>'


HEAD = (
    '#usda 1.0\n(\n    metersPerUnit = 1\n    kilogramsPerUnit = 1\n    upAxis = "Z"\n)\n'
    'def PhysicsScene "scene"\n{\n}\n'
)
ORDER = 'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]\n'
APIS = '"PhysicsCollisionAPI", "MaterialBindingAPI"'
USD_NAMES = {"sphere": "Sphere", "capsule": "Capsule", "box": "Cube", "cylinder": "Cylinder"}


def prim(
    kind: str,
    size: tuple[float, ...],
    place: object = (0.0, 0.0, 0.0),
    turn: object = (1.0, 0.0, 0.0, 0.0),
    more: str = "",
    name: str = "s",
) -> str:
    """Return a shape in its body; a box is a cube of edge 2, scaled."""
    dims = f"double radius = {size[0]}\n"
    dims += f'double height = {2 * size[1]}\nuniform token axis = "Z"\n' if len(size) > 1 else ""
    order = ORDER
    if kind == "box":
        dims = f"float3 xformOp:scale = {size}\n"
        order = ORDER.replace('orient"]', 'orient", "xformOp:scale"]')
    stand = f"double3 xformOp:translate = {tuple(place)}\nquatd xformOp:orient = {tuple(turn)}\n"  # type: ignore[arg-type]
    return (
        f'def {USD_NAMES[kind]} "{name}" (prepend apiSchemas = [{APIS}])\n'
        f"{{\n{dims}{stand}{order}{more}}}\n"
    )


def xform(inside: str, name: str = "b", height: float = 0.0, apis: str = "") -> str:
    return (
        f'def Xform "{name}" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"{apis}])'
        f"\n{{\nfloat physics:mass = 1\nfloat3 physics:diagonalInertia = (1, 1, 1)\n"
        f"double3 xformOp:translate = (0, 0, {height!r})\n"
        f'uniform token[] xformOpOrder = ["xformOp:translate"]\n{inside}}}\n'
    )


def floor(more: str = "", height: float = 0.0) -> str:
    return (
        f'def Plane "floor" (prepend apiSchemas = [{APIS}])\n{{\n'
        f'uniform token axis = "Z"\ndouble3 xformOp:translate = (0, 0, {height!r})\n'
        f'uniform token[] xformOpOrder = ["xformOp:translate"]\n{more}}}\n'
    )


def usda(kind: str, size: tuple[float, ...]) -> str:
    return HEAD + xform(prim(kind, size, PLACE, turn().tolist()))


FORMATS = {"xml": mjcf, "urdf": urdf, "sdf": sdf, "usda": usda}
