"""The scenes in which one effect is weaker, with starts paired with the full scene's."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mbds_xsim.assembly import check_joints
from mbds_xsim.errors import SceneError
from mbds_xsim.joint_space import BodyStates
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.sampling import draw_batch
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch
from mbds_xsim.study.ablate_effects import Effect

__all__ = ["Variant", "variants_of"]


@dataclass(frozen=True, eq=False)
class Variant:
    """An effect made weaker: the scene and its starts, or why there are none."""

    effect: Effect
    factor: float
    scene: Scene
    batch: Batch
    reason: str = ""


def variants_of(scene: Scene, effects: Sequence[Effect], batch: Batch, seed: int) -> list[Variant]:
    """Weaken each effect that a scene has, by each of its factors.

    Args:
        scene: The full scene.
        effects: What may be weakened.
        batch: Starts and inputs of the full scene.
        seed: Seed of these.
    """
    found = []
    for effect in effects:
        for factor in effect.factors:
            try:
                ablated = effect.weaken(scene, factor)
                if ablated is None:
                    continue
                starts = _starts(scene, ablated, effect, factor, batch, seed)
            except SceneError as error:
                reason = str(error).removeprefix("sampling: ").split(", allowed")[0]
                found.append(Variant(effect, factor, scene, batch, reason))
            else:
                found.append(Variant(effect, factor, ablated, starts))
    return found


def _starts(
    scene: Scene, ablated: Scene, effect: Effect, factor: float, batch: Batch, seed: int
) -> Batch:
    if effect.starts == "redrawn":
        return draw_batch(ablated, batch.index, seed=seed)
    if effect.starts == "in plane":
        return dataclasses.replace(batch, force=batch.force * [1.0, factor, 1.0])
    return _kept(scene, ablated, batch)


def _kept(scene: Scene, ablated: Scene, batch: Batch) -> Batch:
    """Give the full scene's starts and inputs to the ablated one; raise where joints forbid it."""
    mechanism, other = Mechanism.of(scene), Mechanism.of(ablated)
    native = mechanism.native_rotation(batch.orientation)
    check_joints(other, BodyStates(batch.position, native, batch.velocity, batch.angular_velocity))
    torque = np.zeros((len(batch), batch.steps, len(other.hinges)))
    columns = {joint.name: k for k, joint in enumerate(mechanism.hinges)}
    for k, joint in enumerate(other.hinges):
        if joint.name in columns:
            torque[:, :, k] = batch.torque[:, :, columns[joint.name]]
    return dataclasses.replace(batch, torque=torque)
