"""MuJoCo Warp (https://github.com/google-deepmind/mujoco_warp): MuJoCo's equations as kernels that
step whole batches, in single precision."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import ClassVar

from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.adapter import Adapter, Profile, Run, Settings
from mbds_xsim.simulate.claims import CONTACTS, Option, named

from ..mujoco import MuJoCo

__all__ = ["MuJoCoWarp"]

_METHOD, _LOOP, _LINK, _DEVICE = "RK4", "loop_time_constant", "link_time_constant", "device"
_SHARED = (_LOOP, _LINK)
_NO_CONTACT = (
    "all trajectories share one step, and near the ground impacts need one fifty times shorter"
)


class MuJoCoWarp(Adapter):
    """MuJoCo Warp: MuJoCo's tree joints and soft constraints; many trajectories cost like a few."""

    name = "mujoco-warp"
    package = "mujoco-warp"
    revision = 3
    methods: ClassVar = named(dataclasses.replace(MuJoCo.methods[_METHOD], single=True))
    options: ClassVar = {
        **{name: MuJoCo.options[name] for name in _SHARED},
        _DEVICE: Option("cpu", "the device, by Warp's name: cpu, or cuda:0 for the first GPU"),
    }
    sweeps: ClassVar = {name: MuJoCo.sweeps[name] for name in _SHARED}
    limits: ClassVar = {**MuJoCo.limits, **dict.fromkeys(CONTACTS, _NO_CONTACT)}
    coordinates = "reduced"
    smallest = MuJoCo.smallest

    def cannot_hold(self, scene: Scene) -> str:
        return MuJoCo().cannot_hold(scene)

    def settings(self, scene: Scene, profile: Profile) -> Settings:
        own = MuJoCo().settings(scene, profile)
        options = {name: value for name, value in own.options.items() if name in self.options}
        return Settings(_METHOD, own.step, options)

    def load(self, scene: Scene, settings: Settings) -> Run:
        from ..mujoco.spinless import SpinlessRun
        from ..mujoco.state import slim_axes
        from .run import WarpRun, stepping

        option = partial(self.option, settings)
        count = settings.substeps(scene.clock.frame)
        steps = stepping(scene.clock.frame / count, option(_LOOP), option(_LINK))
        mechanism = Mechanism.of(scene)
        idle = slim_axes(mechanism)
        run = partial(WarpRun, mechanism, steps, count, option(_DEVICE))
        # Rods without inertia about themselves make mass matrices too ill-conditioned for 24 bits.
        return SpinlessRun(mechanism, idle, run) if idle.any() else run()
