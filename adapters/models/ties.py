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


class Ties:
    """Equalities and tendons at the reference pose."""

    def __init__(self, resolved: Resolved) -> None:
        self._model, self._data, self._off = resolved.model, resolved.data, resolved.off
        self._name, self._higher = resolved.name, resolved.higher
        model, active = resolved.model, not resolved.off["EQUALITY"]
        self._active = [e for e in range(model.neq) if active and model.eq_active0[e]]
        kinds = mujoco.mjtEq
        self._points = (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD))
        rigid = [e for e in self._active if self._rigid(e)]
        self._longer = {int(model.eq_obj1id[e]): float(model.eq_data[e, 0]) for e in rigid}
        """Length of each rigid tendon in excess of that at the reference pose [m], by index."""

    def closings(self) -> Iterator[Closing]:
        """Yield the joints that close loops; two points between the same bodies make a hinge."""
        connects: dict[tuple[int, int], list[Closing]] = defaultdict(list)
        for e in self._active:
            if kind := self._holds(e):
                (first, point), (second, _) = self._ends(e)
                name = self._name("EQUALITY", e).removesuffix(" 0")
                closing = Closing(name, kind, (first - 1, second - 1), point)
                if kind == "ball":
                    back = closing.parts[::-1]
                    same = connects[back if back in connects else closing.parts]
                    # The same point again holds nothing more.
                    if all(np.linalg.norm(point - each.anchor) >= _APART for each in same):
                        same.append(closing)
                else:
                    yield closing
        for balls in connects.values():
            if len(balls) != 2:
                yield from balls
                continue
            first_point, second_point = (ball.anchor for ball in balls)
            middle, axis = (first_point + second_point) / 2, second_point - first_point
            yield Closing(balls[0].name, "hinge", balls[0].parts, middle, axis)

    def couplings(self) -> Iterator[ModelCoupling]:
        """Yield the joints that follow another."""
        model = self._model
        for e in self._active:
            followed = int(model.eq_obj2id[e])
            if model.eq_type[e] == mujoco.mjtEq.mjEQ_JOINT and followed >= 0:
                yield ModelCoupling(
                    joint=self._name("JOINT", int(model.eq_obj1id[e])),
                    follows=self._name("JOINT", followed),
                    polynomial=tuple(model.eq_data[e, :5].tolist()),
                )

    def lines(self) -> Iterator[Line]:
        """Yield tendons between two points, as springs or as links of constant length."""
        model = self._model
        for t in range(model.ntendon):
            if not self._straight(t):
                continue
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
            if t in self._longer:
                length = float(model.tendon_length0[t]) + self._longer[t]
                yield Line(line.name, line.parts, line.points, length, rigid=True)

    def fates(self) -> Iterator[Fate]:
        """Report equalities and tendons that are not converted, with the reasons."""
        model = self._model
        for e in {*range(model.neq)}.difference(self._active):
            place = (self._name("EQUALITY", e),)
            yield Fate("equality", (), "kept", SWITCHED_OFF, True, place)
        for e in self._active:
            couples = model.eq_type[e] == mujoco.mjtEq.mjEQ_JOINT and model.eq_obj2id[e] >= 0
            if not (self._holds(e) or self._rigid(e) or couples):
                name = self._name("EQUALITY", e)
                yield Fate("equality", (), "dropped", self._why(e), True, (name,))
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

    def _rigid(self, e: int) -> bool:
        """Whether an equality keeps a straight tendon at one length."""
        model = self._model
        return bool(
            model.eq_type[e] == mujoco.mjtEq.mjEQ_TENDON
            and model.eq_obj2id[e] < 0
            and self._straight(int(model.eq_obj1id[e]))
        )

    def _holds(self, e: int) -> Literal["fixed", "ball", ""]:
        """Return the joint that an equality stands for; "" if none, or if its ends are apart."""
        kind = int(self._model.eq_type[e])
        if kind not in self._points or self._gap(e) > _APART:
            return ""
        return "fixed" if self._turns(e) else "ball"

    def _turns(self, e: int) -> bool:
        """Whether an equality holds orientations, too."""
        kind, weight = self._model.eq_type[e], self._model.eq_data[e, _WEIGHT]
        return bool(kind == mujoco.mjtEq.mjEQ_WELD and weight != 0)

    def _why(self, e: int) -> str:
        if int(self._model.eq_type[e]) in self._points:
            return f"its two sides are {self._gap(e):.3g} (m or turn) apart at the reference pose"
        if int(self._model.eq_type[e]) == mujoco.mjtEq.mjEQ_JOINT:
            return "it holds one joint at a place"
        return f"equalities of tendons and flexes are {NOT_YET}"

    def _ends(self, e: int) -> tuple[tuple[int, Array], tuple[int, Array]]:
        """Return the bodies of an equality, and the points that it keeps together, in W."""
        model, data = self._model, self._data
        ids = (int(model.eq_obj1id[e]), int(model.eq_obj2id[e]))
        if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
            first, second = ((int(model.site_bodyid[k]), data.site_xpos[k].copy()) for k in ids)
            return first, second
        places = model.eq_data[e, :3], model.eq_data[e, 3:6]
        if model.eq_type[e] == mujoco.mjtEq.mjEQ_WELD:
            places = places[::-1]
        first, second = (
            (k, data.xpos[k] + data.xmat[k].reshape(3, 3) @ place)
            for k, place in zip(ids, places, strict=True)
        )
        return first, second

    def _gap(self, e: int) -> float:
        model, data = self._model, self._data
        (first, point), (second, other) = self._ends(e)
        gap = float(np.linalg.norm(point - other))
        if not self._turns(e):
            return gap
        if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
            turn, other_turn = np.zeros((2, 4))
            mujoco.mju_mat2Quat(turn, data.site_xmat[model.eq_obj1id[e]])
            mujoco.mju_mat2Quat(other_turn, data.site_xmat[model.eq_obj2id[e]])
        else:
            turn = rotation.multiply(data.xquat[first], model.eq_data[e, 6:10])
            other_turn = data.xquat[second]
        return gap + 1.0 - abs(float(turn @ other_turn))
