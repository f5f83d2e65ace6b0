"""Ties of a compiled model in addition to its tree: equalities and tendons."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Literal

import mujoco
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.imported import Fate

from .parts import Closing, Line, ModelCoupling
from .resolved import HIGHER, NOT_YET, SWITCHED_OFF, SWITCHES, Resolved

_APART = 1e-9  # [m or turn]: largest gap of an equality that is met at the reference pose
_WEIGHT = 10  # index in `eq_data` of how much the turn counts in a weld
_CONNECT, _WELD, _JOINT, _TENDON = (
    int(getattr(mujoco.mjtEq, f"mjEQ_{kind}")) for kind in ("CONNECT", "WELD", "JOINT", "TENDON")
)


class Ties:
    """Equalities and tendons at the reference pose."""

    def __init__(self, resolved: Resolved) -> None:
        self._model, self._data, self._off = resolved.model, resolved.data, resolved.off
        self._name, self._higher = resolved.name, resolved.higher
        active = [] if self._off["EQUALITY"] else np.flatnonzero(resolved.model.eq_active0).tolist()
        self._meaning = {e: self._means(e) for e in active}
        """What each equality that is switched on stands for."""

    def closings(self) -> Iterator[Closing]:
        """Yield the joints that close loops; two points between the same bodies make a hinge."""
        connects: dict[tuple[int, int], list[Closing]] = defaultdict(list)
        for e, kind in self._meaning.items():
            if kind not in ("fixed", "ball"):
                continue
            (first, point, _), (second, _, _) = self._ends(e)
            name = self._name("EQUALITY", e).removesuffix(" 0")
            closing = Closing(name, kind, (first - 1, second - 1), point, element="equality")
            if kind == "fixed":
                yield closing
                continue
            back = closing.parts[::-1]
            same = connects[back if back in connects else closing.parts]
            # The same point again holds nothing more.
            if all(np.linalg.norm(point - each.anchor) >= _APART for each in same):
                same.append(closing)
        for balls in connects.values():
            if len(balls) != 2:
                yield from balls
                continue
            first_point, second_point = (ball.anchor for ball in balls)
            middle, axis = (first_point + second_point) / 2, second_point - first_point
            yield Closing(balls[0].name, "hinge", balls[0].parts, middle, axis, element="equality")

    def couplings(self) -> Iterator[ModelCoupling]:
        """Yield the joints that follow another."""
        model = self._model
        for e in (e for e, meaning in self._meaning.items() if meaning == "coupling"):
            yield ModelCoupling(
                joint=self._name("JOINT", int(model.eq_obj1id[e])),
                follows=self._name("JOINT", int(model.eq_obj2id[e])),
                polynomial=tuple(model.eq_data[e, :5].tolist()),
            )

    def lines(self) -> Iterator[Line]:
        """Yield tendons between two points, as springs or as links of constant length."""
        model = self._model
        rigid = [e for e, meaning in self._meaning.items() if meaning == "length"]
        longer = {int(model.eq_obj1id[e]): float(model.eq_data[e, 0]) for e in rigid}
        for t in filter(self._straight, range(model.ntendon)):
            sites = model.wrap_objid[model.tendon_adr[t] :][:2]
            first, second = (self._data.site_xpos[site].copy() for site in sites)
            bodies = [int(model.site_bodyid[site]) - 1 for site in sites]
            line = Line(
                name=self._name("TENDON", t),
                parts=(bodies[0], bodies[1]),
                points=(first, second),
                length=float(model.tendon_lengthspring[t, 0]),
                stiffness=self._linear("stiffness", t),
                damping=self._linear("damping", t),
            )
            if line.stiffness or line.damping:
                yield line
            if t in longer:
                length = float(model.tendon_length0[t]) + longer[t]
                yield Line(line.name, line.parts, line.points, length, rigid=True)

    def fates(self) -> Iterator[Fate]:
        """Report equalities and tendons that are not converted, with the reasons."""
        model = self._model
        for e in range(model.neq):
            place = (self._name("EQUALITY", e),)
            if e not in self._meaning:
                yield Fate("equality", (), "kept", SWITCHED_OFF, True, place)
            elif not self._meaning[e]:
                yield Fate("equality", (), "dropped", self._why(e), True, place)
        for t in range(model.ntendon):
            keys = ["frictionloss", "limited", "armature"]
            properties = [key for key in keys if np.any(getattr(model, f"tendon_{key}")[t])]
            if not self._straight(t):
                properties += [key for key in ("stiffness", "damping") if self._linear(key, t)]
            place = (self._name("TENDON", t),)
            if nonlinear := self._higher("tendon", t):
                yield Fate("tendon", nonlinear, "dropped", HIGHER, True, place)
            if properties:
                yield Fate("tendon", tuple(properties), "dropped", NOT_YET, True, place)
            elif not nonlinear and not self._straight(t):
                yield Fate("tendon", (), "dropped", "it exerts nothing by itself", False, place)

    def _linear(self, key: str, t: int) -> float:
        """Return the stiffness or damping of a tendon, which flags may switch off."""
        value = getattr(self._model, f"tendon_{key}")[t]
        return 0.0 if self._off[SWITCHES[key]] else float(value)

    def _straight(self, t: int) -> bool:
        """Whether a tendon goes from one site to another and has one rest length."""
        model = self._model
        first, count = model.tendon_adr[t], model.tendon_num[t]
        kinds = model.wrap_type[first : first + count]
        low, high = model.tendon_lengthspring[t]
        return bool(count == 2 and (kinds == mujoco.mjtWrap.mjWRAP_SITE).all() and low == high)

    def _means(self, e: int) -> Literal["fixed", "ball", "coupling", "length", ""]:
        """Return what an equality stands for; "" if nothing, or if its ends are apart."""
        kind, single = int(self._model.eq_type[e]), self._model.eq_obj2id[e] < 0
        if kind in (_CONNECT, _WELD) and self._gap(e) <= _APART:
            return "fixed" if self._turns(e) else "ball"
        if kind == _JOINT and not single:
            return "coupling"
        straight = kind == _TENDON and single and self._straight(int(self._model.eq_obj1id[e]))
        return "length" if straight else ""

    def _turns(self, e: int) -> bool:
        """Whether an equality holds orientations, too."""
        return bool(self._model.eq_type[e] == _WELD and self._model.eq_data[e, _WEIGHT] != 0)

    def _why(self, e: int) -> str:
        kind = int(self._model.eq_type[e])
        if kind in (_CONNECT, _WELD):
            return f"its two sides are {self._gap(e):.3g} (m or turn) apart at the reference pose"
        if kind == _JOINT:
            return "it holds one joint at a place"
        return f"equalities of tendons and flexes are {NOT_YET}"

    def _ends(self, e: int) -> list[tuple[int, Array, Array]]:
        """Return the bodies of an equality, and the points and turns that it keeps together."""
        model, data, law = self._model, self._data, self._model.eq_data[e]
        ids = (int(model.eq_obj1id[e]), int(model.eq_obj2id[e]))
        if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
            axes = [rotation.from_matrix(data.site_xmat[k].reshape(3, 3)) for k in ids]
            bodies = [int(model.site_bodyid[k]) for k in ids]
            return list(zip(bodies, data.site_xpos[list(ids)], axes, strict=True))
        welds = model.eq_type[e] == _WELD
        places = (law[3:6], law[:3]) if welds else (law[:3], law[3:6])
        first = rotation.multiply(data.xquat[ids[0]], law[6:10]) if welds else data.xquat[ids[0]]
        points = [
            data.xpos[k] + data.xmat[k].reshape(3, 3) @ place
            for k, place in zip(ids, places, strict=True)
        ]
        return list(zip(ids, points, (first, data.xquat[ids[1]]), strict=True))

    def _gap(self, e: int) -> float:
        (_, point, turn), (_, other, other_turn) = self._ends(e)
        gap = float(np.linalg.norm(point - other))
        return gap + 1.0 - abs(float(turn @ other_turn)) if self._turns(e) else gap
