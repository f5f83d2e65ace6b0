"""The independent reference: the scene's equations of motion, integrated to high accuracy."""

from mbds_xsim.reference.accelerations import accelerations
from mbds_xsim.reference.sensitivity import sensitivity
from mbds_xsim.reference.solution import solve

__all__ = ["accelerations", "sensitivity", "solve"]
