"""Checks that read only what is published: scene, inputs and trajectory."""

from mbds_xsim.checks.audit import CHECKS, audit, audited
from mbds_xsim.checks.finding import Finding
from mbds_xsim.checks.record import Record

__all__ = ["CHECKS", "Finding", "Record", "audit", "audited"]
