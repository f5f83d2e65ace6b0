"""How a model is trained: optimiser, schedule of its rate, batch."""

from __future__ import annotations

import math

import msgspec

from mbds_xsim import bounds

__all__ = ["Cosine", "Decay", "Plateau", "Recipe"]


class Plateau(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag=True):
    """Lower the rate where the validation loss stops falling."""

    patience: int = 3
    """Validations without improvement that are waited for."""
    factor: float = 0.8


class Decay(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag=True):
    """Lower the rate exponentially, from the recipe's to a tenth and on, never below a floor."""

    tenth: int = 5_000_000
    """Steps in which the part above the floor falls to a tenth."""
    floor: float = 1e-6

    def at(self, rate: float, step: int, steps: int) -> float:
        """Rate of a step, from the recipe's."""
        del steps
        return self.floor + (rate - self.floor) * 0.1 ** (step / self.tenth)


class Cosine(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag=True):
    """Lower the rate along half a cosine, to zero behind the last step a run may take.

    Source: Loshchilov and Hutter, SGDR, ICLR 2017, without restarts.
    """

    def at(self, rate: float, step: int, steps: int) -> float:
        """Rate of a step of so many, from the recipe's."""
        return 0.5 * rate * (1.0 + math.cos(math.pi * step / steps))


class Recipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Adam, its rate and what becomes of it."""

    rate: float = 1e-4
    betas: tuple[float, float] = (0.9, 0.999)
    batch: int = 64
    """Windows a step."""
    horizon: int = 1
    """Frames to come in a window. GNS and SGNN learn from one of them, see `pushforward`."""
    schedule: Plateau | Decay | Cosine | None = None
    clip: float | None = None
    """Largest norm of a gradient; longer ones are shortened to it."""
    skip: bool = False
    """Whether a step whose gradient is no number is not taken, and the run goes on. One of which
    that is most steps since a validation has diverged."""

    def __post_init__(self) -> None:
        bounds.positive("rate", self.rate)
        bounds.at_least_one("batch", self.batch)
        bounds.at_least_one("horizon", self.horizon)
