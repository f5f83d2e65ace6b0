"""Parts of a compiled model: bodies, joints, ties, actuators and collision shapes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.scene.imported import Fate

from .drives import Actuators
from .fates import COLLISION, PAIRING
from .parts import Drive, Freedom, Mass, Pair, Part, Parts, Property, Solid, Solids
from .resolved import HIGHER, Resolved
from .ties import Ties

_KINDS = ("plane", "height field", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh",
          "signed distance field")  # fmt: skip
"""Kinds of geoms, in the order of MuJoCo's `mjtGeom`."""
_AS_PAIRED = "as MuJoCo pairs each shape with the ground"
_NO_MASS = (0.0, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros((3, 3)))


class Reading(Resolved):
    """A compiled model at its reference pose.

    Args:
        model: The compiled model.
        stated: Masses that replace the compiled ones, keyed by body; None if none are replaced.
        shape: The format's word for a shape; "" if there is no ground.
        limits: Limits of joints that the compiler may ignore, keyed by joint.
    """

    def __init__(
        self,
        model: Any,
        stated: Mapping[str, Any] | None = None,
        shape: str = "",
        limits: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        super().__init__(model)
        self._stated_masses, self._stated_limits, self._shape = stated, limits or {}, shape
        self._geoms = np.flatnonzero(model.geom_contype | model.geom_conaffinity).tolist()
        """Shapes that are not only drawn."""
        self._ties, self._actuators = Ties(self), Actuators(self)
        self._drives = tuple(self._actuators.drives())
        self._armature, self._damping = map(self._actuators.on_joints, ("armature", "damping"))
        """Armature and damping that actuators add to each joint."""

    def parts(self, name: str, labels: Mapping[str, tuple[str, str]]) -> Parts:
        """Return the model's parts."""
        solids = map(self._solid, self._geoms)
        return Parts(
            name=name,
            parts=tuple(map(self._part, range(1, self.model.nbody))),
            gravity=np.zeros(3) if self.off["GRAVITY"] else np.array(self.model.opt.gravity),
            closings=tuple(self._ties.closings()),
            couplings=tuple(self._ties.couplings()),
            lines=tuple(self._ties.lines()),
            drives=tuple(drive for drive in self._drives if isinstance(drive, Drive)),
            solids=Solids(self._shape, tuple(solids), self._pair) if self._shape else None,
            labels=labels,
        )

    def _part(self, k: int) -> Part:
        model, data, first = self.model, self.data, self.model.body_jntadr[k]
        return Part(
            name=self.name("BODY", k),
            parent=int(model.body_parentid[k]) - 1,
            position=data.xpos[k].copy(),
            orientation=data.xquat[k].copy(),
            mass=self._mass(k),
            freedoms=tuple(self._freedom(first + j) for j in range(model.body_jntnum[k])),
            named=bool(model.body(k).name),
        )

    def _mass(self, k: int) -> Mass:
        model, place, quat = self.model, self.data.xpos[k], self.data.xquat[k]
        mass, com, turn, tensor = _NO_MASS
        if self._stated_masses is not None:
            mass, com, turn, tensor = self._stated_masses.get(self.name("BODY", k), _NO_MASS)
        elif model.body_mass[k] > 0:
            mass, com, turn = model.body_mass[k], model.body_ipos[k], model.body_iquat[k]
            tensor = np.diag(model.body_inertia[k])
        axes = rotation.matrix(quat) @ rotation.matrix(turn / np.linalg.norm(turn))
        return Mass(float(mass), place + rotation.rotate(quat, com), axes @ tensor @ axes.T)

    def _freedom(self, j: int) -> Freedom:
        kind = ("free", "ball", "slider", "hinge")[self.model.jnt_type[j]]
        has_axis = kind in ("slider", "hinge")
        return Freedom(
            name=self.name("JOINT", j),
            kind=kind,  # type: ignore[arg-type]
            anchor=self.data.xanchor[j].copy(),
            axis=self.data.xaxis[j].copy() if has_axis else np.zeros(3),
            properties=self._properties(j, has_axis),
            named=bool(self.model.joint(j).name),
        )

    def _properties(self, j: int, has_axis: bool) -> dict[str, Property]:
        model, off, name = self.model, self.off, self.name("JOINT", j)
        dof, place = model.jnt_dofadr[j], model.jnt_qposadr[j]
        start = model.qpos0[place] if has_axis else 0.0
        properties: dict[str, Property] = {
            "stiffness": 0.0 if off["SPRING"] else float(model.jnt_stiffness[j]),
            "damping": 0.0 if off["DAMPER"] else float(model.dof_damping[dof] + self._damping[j]),
            "armature": float(model.dof_armature[dof] + self._armature[j]),
            "friction": 0.0 if off["FRICTIONLOSS"] else float(model.dof_frictionloss[dof]),
        }
        if properties["stiffness"] and has_axis:
            properties["rest"] = float(model.qpos_spring[place] - start)
        if model.jnt_limited[j] and not off["LIMIT"]:
            low, high = model.jnt_range[j] - start
            properties["limits"] = (float(low), float(high))
        elif has_axis and name in self._stated_limits:
            properties["limits"] = self._stated_limits[name]
        return {key: value for key, value in properties.items() if value}

    def fates(self) -> Iterator[Fate]:
        """Report the fates of contact, equalities, tendons and actuators that are not servos."""
        if self._shape == "geom":
            yield Fate("geom", PAIRING["geom"], "kept", _AS_PAIRED, True)
        if self._shape and self.model.nexclude:
            yield Fate("exclude", (), "kept", _AS_PAIRED, True)
        several = len(self._geoms) > 1 or self.model.npair
        if several and not (self._shape or self.off["CONTACT"]):
            names = tuple(self.name("GEOM", g) for g in self._geoms)
            yield Fate("geom", ("contact",), "dropped", COLLISION, True, names, len(names))
        for j in range(self.model.njnt):  # forces that are not linear
            keys = self.higher("jnt", j) + self.higher("dof", int(self.model.jnt_dofadr[j]))
            if keys:
                yield Fate("joint", keys, "dropped", HIGHER, True, (self.name("JOINT", j),))
        yield from self._ties.fates()
        yield from self._actuators.mechanics()
        yield from (fate for fate in self._drives if isinstance(fate, Fate))

    def _solid(self, g: int) -> Solid:
        model, data = self.model, self.data
        return Solid(
            name=self._geom_name(g),
            part=int(model.geom_bodyid[g]) - 1,
            kind=_KINDS[model.geom_type[g]],
            size=model.geom_size[g].copy(),
            place=data.geom_xpos[g].copy(),
            axes=data.geom_xmat[g].reshape(3, 3).copy(),
            own=g,
        )

    def _geom_name(self, g: int) -> str:
        geom = self.model.geom(g)
        return geom.name or f"of {self.model.body(geom.bodyid[0]).name or geom.bodyid[0]}"

    def _pair(self, shape: Solid, floor: Solid | None) -> Pair:
        """Return a shape's contact with the ground, by MuJoCo's rules.

        Of the geoms of the highest priority, the largest values count.
        """
        model, g, plane = self.model, shape.own, floor.own if floor is not None else None
        geoms = [g] if plane is None else [g, plane]
        highest = max(model.geom_priority[k] for k in geoms)
        deciding = [k for k in geoms if model.geom_priority[k] == highest]
        dimension = int(max(model.geom_condim[k] for k in deciding))
        friction = None
        if self._shape == "geom":
            slippery = dimension == 1
            friction = 0.0 if slippery else float(max(model.geom_friction[k, 0] for k in deciding))
        return Pair(friction, None, self._apart(g, plane), dimension > 3)

    def _apart(self, g: int, plane: int | None) -> str:
        """Return why a shape passes through the ground, or "" if it does not."""
        model = self.model
        if self.off["CONTACT"]:
            return "contact is switched off in the file"
        if plane is not None:
            first, second = sorted(int(model.geom_bodyid[k]) for k in (plane, g))
            if (first << 16) + second in model.exclude_signature:
                return "the file excludes contact of its body and the ground"
        masks = model.geom_contype, model.geom_conaffinity
        own = [mask[g] for mask in masks]
        other = [1, 1] if plane is None else [mask[plane] for mask in masks]  # a plane's default
        meets = own[0] & other[1] or other[0] & own[1]
        return "" if meets else "by contype and conaffinity it passes through the ground"
