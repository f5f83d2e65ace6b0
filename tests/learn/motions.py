"""Motions of the studies of stability, solved by the reference, and their particles."""

from __future__ import annotations

from mbds_xsim import reference
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.particles import ParticleMotion
from mbds_xsim.learn.trained import particle_motion
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.studies.stability import Study

CLOCK = Clock(0.02, 50)


def solved(study: Study, value: float) -> tuple[Scene, Batch, Trajectory]:
    scene = study.scene(value, CLOCK)
    batch = study.batch(scene)
    return scene, batch, reference.solve(scene, batch)


def particles_of(scene: Scene, batch: Batch, motion: Trajectory) -> ParticleMotion:
    return particle_motion(Graph.of(scene), batch, motion)
