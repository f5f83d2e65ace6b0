"""The independent reference: the scene's equations of motion, integrated to high accuracy."""

from mbds_xsim.reference.equations import accelerations
from mbds_xsim.reference.first_impact import FirstImpact
from mbds_xsim.reference.solution import sensitivity, solve

__all__ = ["FirstImpact", "accelerations", "sensitivity", "solve"]
