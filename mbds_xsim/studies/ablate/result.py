"""What `ablate` found: the figures of each effect, the floor they are held to, model sizes."""

from __future__ import annotations

from typing import Literal

import msgspec

SCHEMA = "mbds-xsim/ablate/1"

Verdict = Literal["needed", "not needed", "not resolvable", "not possible"]
"""The change is above the floor, or where engines have parted clearly above their distance; below
the floor; not to be told, as motions can be compared for less than 1 s; there is no such scene,
start or simulation."""


class Floor(msgspec.Struct, frozen=True):
    """What a change must exceed: the engines' own disagreement, or the budget if that is larger."""

    disagreement_1s_m: float | None
    """Largest RMS particle distance of two engines at 1 s, low and medium starts [m]; None where
    motions cannot be compared for so long."""
    disagreement_m: float
    """The same over all starts and judged frames, over max(1, growth) [m]."""
    budget_1s_m: float
    budget_m: float

    @property
    def at_1s(self) -> float:
        """What a change at 1 s must exceed [m]."""
        return max(self.disagreement_1s_m or 0.0, self.budget_1s_m)

    @property
    def overall(self) -> float:
        """What a growth-weighted change must exceed [m]."""
        return max(self.disagreement_m, self.budget_m)


class Row(msgspec.Struct, frozen=True):
    """One effect, dropped or halved."""

    effect: str
    factor: float
    """0: dropped, 0.5: halved."""
    left: str
    """What is left without the effect."""
    verdict: Verdict
    sentence: str
    change_1s_m: float | None = None
    """RMS particle change at 1 s, worst of the low and medium starts [m]."""
    change_1s_median_m: float | None = None
    change_m: float | None = None
    """Largest RMS particle change over max(1, growth), worst of the starts [m]."""
    change_median_m: float | None = None
    over_floor: float | None = None
    """The larger of the two changes over its floor."""
    over_disagreement: float | None = None
    """The larger of the two changes over the engines' disagreement."""


class Size(msgspec.Struct, frozen=True):
    """The native model of one engine, and what it has more than the scene needs."""

    engine: str
    coordinates: int
    """Velocity coordinates."""
    constraints: int
    contact_pairs: int
    more_coordinates: int
    """Beyond joint coordinates (in the plane, beyond the degrees of freedom)."""
    more_constraints: int
    """Beyond the independent conditions of closed loops."""
    more_pairs: int
    """Beyond contact spheres."""


class Ablation(msgspec.Struct, frozen=True, kw_only=True):
    """A scene's effects."""

    schema: str = SCHEMA
    scene: str
    description: str
    judge: str
    """What simulated both scenes: the reference, or an engine with its method and step."""
    judged_s: tuple[float, float]
    """Shortest and longest time over which a start was compared [s]."""
    ends: str
    """What ends the comparison before the last frame; empty where nothing does."""
    duration_s: float
    length_m: float
    floor: Floor
    floor_engines: tuple[str, ...]
    """Engines whose disagreement is the floor."""
    failed: dict[str, str]
    """Engines that failed on these starts, with the first reason; they are no part of the floor
    unless fewer than two pass."""
    left_out: dict[str, str]
    """Engines that cannot do the scene, with the reason."""
    rows: tuple[Row, ...]
    degrees_of_freedom: int
    joint_coordinates: int
    """Fewest coordinates of a model that opens closed loops."""
    loop_conditions: int
    """Independent conditions that close them."""
    contact_spheres: int
    sizes: tuple[Size, ...]
    trajectories: tuple[int, ...]
    seed: int
    versions: dict[str, str]
    machine: str
    command: str
    wall_s: float
