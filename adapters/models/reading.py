"""Parts of a compiled model: bodies, joints, ties, actuators and collision shapes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.scene.imported import Fate

from .drives import Actuators
from .fates import COLLISION
from .geoms import Geoms, touching
from .parts import Drive, Freedom, Mass, Part, Parts, Property
from .resolved import HIGHER, Resolved
from .ties import Ties

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
        self._stated_masses, self._stated_limits = stated, limits or {}
        self._geoms = Geoms(self, shape) if shape else None
        self._ties, self._actuators = Ties(self), Actuators(self)
        self._drives = tuple(self._actuators.drives())
        self._armature, self._damping = map(self._actuators.on_joints, ("armature", "damping"))
        """Armature and damping that actuators add to each joint."""

    def parts(self, name: str, labels: Mapping[str, tuple[str, str]]) -> Parts:
        """Return the model's parts."""
        return Parts(
            name=name,
            parts=tuple(map(self._part, range(1, self.model.nbody))),
            gravity=np.zeros(3) if self.off["GRAVITY"] else np.array(self.model.opt.gravity),
            closings=tuple(self._ties.closings()),
            couplings=tuple(self._ties.couplings()),
            lines=tuple(self._ties.lines()),
            drives=tuple(drive for drive in self._drives if isinstance(drive, Drive)),
            solids=self._geoms.solids() if self._geoms is not None else None,
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
        geoms = touching(self.model)
        if self._geoms is not None:
            yield from self._geoms.fates()
        elif (len(geoms) > 1 or self.model.npair) and not self.off["CONTACT"]:
            names = tuple(self.name("GEOM", g) for g in geoms)
            yield Fate("geom", ("contact",), "dropped", COLLISION, True, names, len(geoms))
        for j in range(self.model.njnt):  # forces that are not linear
            keys = self.higher("jnt", j) + self.higher("dof", int(self.model.jnt_dofadr[j]))
            if keys:
                yield Fate("joint", keys, "dropped", HIGHER, True, (self.name("JOINT", j),))
        yield from self._ties.fates()
        yield from self._actuators.mechanics()
        yield from (fate for fate in self._drives if isinstance(fate, Fate))
