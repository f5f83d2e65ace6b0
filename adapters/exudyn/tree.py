"""An open tree of hinges and sliders in its own coordinates, for the explicit solvers."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.joint_space import BodyStates, LinkStates, to_bodies, to_links
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism, PlacedJoint, PointPair
from mbds_xsim.simulate.readback import joint_anchors, joint_axes, joint_laws

from .model import Formulation, body_marker, inertia_text

_TYPES = {"hinge": "RevoluteZ", "slider": "PrismaticZ"}


class KinematicTree(Formulation):
    """A tree whose coordinates are the angle or displacement of each link.

    Exudyn puts a link's frame at its joint. The adapter turns its z axis into the joint's, so that
    one joint type serves every axis.
    """

    def __init__(self, mechanism: Mechanism, step: float) -> None:
        super().__init__(mechanism, step)
        self._number = {link.body: k for k, link in enumerate(mechanism.links)}

    def bodies(self) -> Iterator[str]:
        mechanism = self.mechanism
        yield "links = []"
        for link in mechanism.links:
            yield from self._link(link)
        gravity = list(mechanism.scene.gravity)
        rest = [_joint(link).rest for link in mechanism.links]
        offsets = f", jointPositionOffsetVector={rest!r}" if mechanism.compliant else ""
        yield f"tree = mbs.CreateKinematicTree(listOfTreeLinks=links, gravity={gravity!r}{offsets})"
        if mechanism.rotors:
            armature = np.diag([_joint(link).armature for link in mechanism.links]).tolist()
            node = "mbs.GetObject(tree)['nodeNumber']"
            yield (
                "rotors.append(mbs.AddObject(items.ObjectGenericODE2("
                f"nodeNumbers=[{node}], massMatrix={armature!r})))"
            )
        for k in range(mechanism.body_count):
            yield f"frames.append({self.marker(k, np.zeros(3))})"
        yield "centres = frames"

    def _link(self, link: Link) -> Iterator[str]:
        mechanism, joint = self.mechanism, _joint(link)
        frame, above = _frame(joint), np.eye(3)
        offset, parent = joint.anchor, -1
        if link.parent != WORLD_INDEX:
            parent = self._number[link.parent]
            holder = _joint(mechanism.links[parent])
            above, offset = _frame(holder), joint.anchor - holder.anchor
        inertia = frame.T @ mechanism.inertia[link.body] @ frame
        com = frame.T @ -joint.in_child
        law = f", PDcontrol=[{joint.stiffness!r}, {joint.damping!r}]" if joint.complies else ""
        yield f"# {mechanism.scene.bodies[link.body].name!r} on {joint.name!r}"
        yield (
            f"links.append(TreeLink({inertia_text(mechanism.mass[link.body], inertia, com)}, "
            f"jointType=exu.JointType.{_TYPES[joint.kind]}, parent={parent}, "
            f"jointHT={_transform(above.T @ frame, above.T @ offset)}, graphicsDataList=[]{law}))"
        )

    def marker(self, body: int, point: Array) -> str:
        number = self._number[body]
        joint = _joint(self.mechanism.links[number])
        back = _frame(joint).T
        return (
            "mbs.AddMarker(items.MarkerKinematicTreeRigid(objectNumber=tree, "
            f"linkNumber={number}, localHT={_transform(back, back @ (point - joint.in_child))}))"
        )

    def ends(self, pair: PointPair) -> str:
        markers = ", ".join(
            body_marker("Rigid", body, at) if body == WORLD_INDEX else self.marker(body, at)
            for body, at in zip(pair.bodies, pair.in_body, strict=True)
        )
        return f"itemNumbers=[{markers}]"

    def from_bodies(self, bodies: BodyStates) -> tuple[Array, Array]:
        links = to_links(self.mechanism, bodies)
        return links.coordinate, links.rate

    def to_bodies(self, coordinates: Array, velocities: Array) -> BodyStates:
        still = LinkStates.still(coordinates.shape)
        links = dataclasses.replace(still, coordinate=coordinates, rate=velocities)
        return to_bodies(self.mechanism, links)

    def mass_properties(self) -> tuple[Array, Array, Array, Array]:
        tree, back = self._tree(), self._back()
        link = [self._number[body] for body in range(self.mechanism.body_count)]
        inertia = np.array([np.array(tree["linkInertiasCOM"][k]) for k in link])
        places = [marker["localPosition"] for marker in self._markers()]
        off = np.array([tree["linkCOMs"][k] for k in link]) - places
        return (
            np.array(tree["linkMasses"])[link],
            np.swapaxes(back, -1, -2) @ inertia @ back,
            np.einsum("kji,kj->ki", back, off),
            np.tile(tree["gravity"], (len(link), 1)),
        )

    def joint_fields(self, com: Array, turn: Array) -> dict[str, Array]:
        tree, frames = self._tree(), turn @ np.swapaxes(self._back(), -1, -2)
        numbers = self._number
        origin = {k: com[k] - frames[k] @ tree["linkCOMs"][numbers[k]] for k in numbers}

        def ends(link: Link) -> tuple[Array, Array]:
            above = np.array(tree["jointOffsets"][numbers[link.body]])
            if link.parent != WORLD_INDEX:
                above = origin[link.parent] + frames[link.parent] @ above
            return above, origin[link.body]

        def law(link: Link, _joint: PlacedJoint) -> tuple[float, float, float]:
            k = numbers[link.body]
            stiffness, damping = tree["jointPControlVector"][k], tree["jointDControlVector"][k]
            return stiffness, damping, tree["jointPositionOffsetVector"][k]

        geared = [numbers[self.mechanism.carried[joint.index]] for joint in self.mechanism.rotors]
        masses = [rotor["massMatrix"].Convert2DenseMatrix() for rotor in self.objects("rotors")]
        return {
            "joint_axis": joint_axes(self.mechanism, lambda link: frames[link.body][:, 2]),
            "anchor": joint_anchors(self.mechanism, ends),
            "law": joint_laws(self.mechanism, law),
            "armature": np.array([np.diag(mass)[geared] for mass in masses]).ravel(),
        }

    def _tree(self) -> Mapping[str, Any]:
        return self.names["mbs"].GetObject(self.names["tree"])

    def _markers(self) -> list[Mapping[str, Any]]:
        return [self.names["mbs"].GetMarker(frame) for frame in self.names["frames"]]

    def _back(self) -> Array:
        """Read rotations from native frames to link frames off the markers, shape (body, 3, 3)."""
        return np.array([marker["localHT"][:3, :3] for marker in self._markers()])


def _joint(link: Link) -> PlacedJoint:
    assert link.joint is not None  # free bodies are refused
    return link.joint


def _frame(joint: PlacedJoint) -> Array:
    """Return the axes of a link's frame in W at the reference pose, z along the joint's axis."""
    return np.column_stack([*rotation.normal_to(joint.axis), joint.axis])


def _transform(turn: Array, offset: Array) -> str:
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = turn, offset
    return f"np.array({place.tolist()!r})"
