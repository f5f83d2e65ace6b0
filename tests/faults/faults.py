"""All the faults."""

from .contact import CONTACT
from .driving import DRIVING
from .modelling import MODELLING
from .recorded import RECORDED
from .recording import RECORDING
from .smooth import SMOOTH

__all__ = ["FAULTS"]

FAULTS = (*SMOOTH, *CONTACT, *RECORDED, *RECORDING, *MODELLING, *DRIVING)
