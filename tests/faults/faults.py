"""All the faults."""

from .contact import CONTACT
from .driving import DRIVING
from .modelling import MODELLING
from .recording import RECORDING
from .smooth import SMOOTH

__all__ = ["FAULTS"]

FAULTS = (*SMOOTH, *CONTACT, *RECORDING, *MODELLING, *DRIVING)
