"""All the faults."""

from .contact_balls import BALLS
from .contact_car import CAR
from .contact_cube import CUBE
from .driving import DRIVING
from .modelling import MODELLING
from .recorded import RECORDED
from .recording import RECORDING
from .smooth import SMOOTH

__all__ = ["FAULTS"]

FAULTS = (*SMOOTH, *BALLS, *CAR, *CUBE, *RECORDED, *RECORDING, *MODELLING, *DRIVING)
