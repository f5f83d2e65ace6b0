"""Scenes as MJCF."""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.frame import optional
from mbds_xsim.base.xml import indented, numbers
from mbds_xsim.scene.imported import Fate, Written
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene

from .writing import dropped_fate, first_targets, without_servos, written

_LACKS = {"joints.restitution": "a softness of limits stands for it in MuJoCo"}
_NO_LAW = "a joint that closes a loop is an equality, on which nothing acts"


def write(scene: Scene) -> Written:
    """Write MJCF; see `mbds_xsim.simulate.registry`.

    Raises:
        InputError: A slider closes a loop, or MuJoCo is not installed.
    """
    optional("mujoco", "writing MJCF", "mujoco")
    from ..mujoco.model import CLOSING_POINTS, add_servo, mechanics

    mechanism = without_servos(scene)
    for joint in mechanism.loops:
        if joint.kind not in CLOSING_POINTS:
            msg = f"the joint {joint.name!r} is a {joint.kind} that closes a loop; MJCF closes "
            raise InputError(msg + "them by ball joints, hinges and welds")
    root = Element("mujoco", model=scene.name)
    SubElement(root, "compiler", angle="radian", autolimits="false")
    SubElement(root, "option", gravity=numbers(scene.gravity))
    mechanics(root, mechanism, np.zeros((mechanism.body_count, 3)), {}, {})
    loops = {joint.name for joint in mechanism.loops}
    servos = [servo for servo in scene.servos if servo.joint not in loops]
    if servos:
        actuators = SubElement(root, "actuator")
        for servo in servos:  # command 0 keeps its first target, other commands move it
            push = servo.stiffness * servo.position[0] + servo.damping * servo.velocity[0]
            add_servo(actuators, servo, push, gainprm=repr(servo.stiffness or servo.damping))
    fates = [*_loops(mechanism), *first_targets(scene)]
    fates += [dropped_fate("servos", _NO_LAW, s.joint) for s in scene.servos if s.joint in loops]
    return written(indented(root), scene, _LACKS, fates)


def _loops(mechanism: Mechanism) -> Iterator[Fate]:
    for joint in mechanism.loops:
        reason = "its points are held together by a soft solver"
        yield Fate("joints", (), "approximated", reason, True, (joint.name,))
        if joint.complies:
            yield dropped_fate("joints", _NO_LAW, joint.name, "stiffness", "damping")
    for pair in mechanism.distances:
        reason = "a tendon of constant length, held by a soft solver"
        yield Fate("distance_links", (), "approximated", reason, True, (pair.name,))
    for tie in mechanism.couplings:
        reason = "an equality of two joints, held by a soft solver"
        yield Fate("couplings", (), "approximated", reason, True, (tie.name,))
