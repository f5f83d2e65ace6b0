"""All the faults."""

from .contact import CONTACT
from .smooth import SMOOTH

__all__ = ["FAULTS"]

FAULTS = (*SMOOTH, *CONTACT)
