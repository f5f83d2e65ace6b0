"""The main table of a validation and the sentences around it."""

from __future__ import annotations

import math

from mbds_xsim.base.text import counted
from mbds_xsim.checks.consistency import STOPPED, UNMEASURED
from mbds_xsim.measure.result import EngineResult, Evidence, Validation
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Cell, Column
from mbds_xsim.simulate.claims import TRUTH

_ITSELF = (
    "is what the others are held against: its distance to itself is no figure, and it has no vote "
    "as an engine; what is shown are the checks that need no truth, and its cost"
)


def label(result: EngineResult) -> str:
    """Name a row: engine and profile."""
    return f"{result.engine} {result.profile}"


def reference_line(validation: Validation) -> str:
    """Describe how accurate the reference is."""
    reference = validation.reference
    if reference is None:
        return "none: results are compared with each other only"
    cached = f", {reference.cached} from the cache" if reference.cached else ""
    if _is_unknown(validation):
        return "none: the scene starts in contact, which has no unique solution"
    return (
        f"relative tolerance {reference.rtol:.0e}, "
        f"constraint gap {quantity.length(reference.constraint_gap_m)}, "
        f"energy balance {quantity.number(reference.energy_balance)}, "
        f"made in {quantity.span(reference.wall_s)}{cached}{_until(validation)}"
    )


def spent_line(validation: Validation) -> str:
    """List the time spent on each kind of work, summed over all processes."""
    parts = (f"{work} {quantity.span(seconds)}" for work, seconds in validation.spent_s.items())
    return f"{', '.join(parts)} (summed over all processes)"


def _until(validation: Validation) -> str:
    times = ends(validation)
    if not times:
        return ""
    first, last = (f"{time:.2f}" for time in (times[0], times[-1]))
    return f"; up to the first impact, at {first if first == last else f'{first} to {last}'} s"


def _is_unknown(validation: Validation) -> bool:
    """Return whether the reference ends at the start of every trajectory."""
    reference = validation.reference
    return reference is not None and {0.0} == set(reference.known_s)


def ends(validation: Validation) -> list[float]:
    """Return the sorted times of first impacts that leave no unique solution [s]."""
    known = () if validation.reference is None else validation.reference.known_s
    return sorted(time for time in known if time is not None)


def odd_one_out(validation: Validation) -> str:
    """Name the entry that stands apart, or the pair that is furthest apart."""
    if validation.odd_one_out is not None:
        return f"{validation.odd_one_out} stands apart from all other method families"
    pairs = [
        (distance, validation.names[row], validation.names[column])
        for row, distances in enumerate(validation.matrix_m)
        for column, distance in enumerate(distances)
        if column > row and math.isfinite(distance)
    ]
    if not pairs:
        return "none, nothing to compare"
    distance, one, other = max(pairs)
    when = f"{validation.matrix_s:.4g} s"
    return f"none; furthest apart at {when} are {one} and {other}, {quantity.length(distance)}"


def conclusion(validation: Validation) -> str:
    """State the final verdict in one sentence."""
    total, parts = len(validation.engines), []
    of_one = len({result.profile for result in validation.engines}) == 1
    for verdict, word in (("pass", "passed"), ("warn", "with a warning"), ("fail", "failed")):
        results = [result for result in validation.engines if result.verdict == verdict]
        names = ", ".join(result.engine for result in results)
        of = f" ({names})" if of_one and len(results) < total else ""
        parts += [f"{len(results)} of {total} {word}{of}"] if results else []
    sample = f"{counted(len(validation.trajectories), 'trajectory')} of seed {validation.seed}"
    return f"{', '.join(parts) or 'no engine ran'}; {sample}"


def remarks(validation: Validation) -> list[tuple[str, str]]:
    """List the passed checks that could not judge: row and check, and the reason."""
    checks: dict[tuple[str, str], str] = {}
    for result in validation.engines:
        for finding in result.findings:
            if finding.passed and any(word in finding.note for word in (UNMEASURED, STOPPED)):
                checks.setdefault((label(result), finding.note), finding.check)
    pairs = [(f"{row}, {check}", note) for (row, note), check in checks.items()]
    return [*pairs, *((label(r), _ITSELF) for r in validation.engines if r.family == TRUTH)]


def contact_words(validation: Validation, evidence: Evidence) -> str:
    """Describe what is known about the scene's contact."""
    ground = evidence.scene.ground
    assert ground is not None
    if not ends(validation):
        text = "The reference is exact through all contacts: that of a ball has one solution."
    else:
        begin = (
            "The scene starts in contact of several points, which has no unique solution, so that "
            "there is no reference:"
            if _is_unknown(validation)
            else "The reference ends at the first impact: rigid contact of several points, or "
            "beside a centre of mass, has no unique solution. Beyond it (grey)"
        )
        text = (
            f"{begin} engines are held to the laws that every solution keeps, in the checks below, "
            "and to each other; with 20 trajectories or more their distributions are compared."
        )
    return (
        f"{text} The scene's coefficients are {ground.friction:g} of friction and "
        f"{ground.restitution:.4f} of restitution. The plots over time are of the trajectory "
        "chosen above; press on them to go to a time."
    )


def growth_words(validation: Validation, evidence: Evidence, *, known: bool) -> str:
    """Explain how to read the plots of errors, or why there are none."""
    if not known:
        return (
            "The scene starts in contact of several points, which has no unique solution: there is "
            "no error to plot. Engines are compared with each other, and held to the laws of "
            "contact in the checks below."
        )
    hatched = (
        " Hatched: beyond the first impact there is no unique solution, and no error."
        if ends(validation)
        else ""
    )
    whole = evidence.reference.time[-1] >= 1.0
    letters = "The triangle is the budget at 1 s; letters" if whole else "Letters"
    return (
        "RMS distance of the particles to the reference, the worst of each interval's "
        "trajectories. The grey area is what the budget allows once the scene's own sensitivity is "
        "counted: it grows as a disturbance of the start grows, and ends where that is a "
        f"hundredfold and the error is chaos rather than a fault. {letters} are engines' initials, "
        f"dashed lines native settings, or an engine's second ones.{hatched}"
    )


COLUMNS = (
    Column("engine", words=True),
    Column("profile", "Preset of settings", words=True),
    Column("method", "Way of stepping", words=True, narrow=False),
    Column("step", "Integration step"),
    Column("cost", "Wall time per simulated second and trajectory, set-up apart"),
    Column("gap", "Worst distance between the anchor points of a joint"),
    Column("energy", "Worst energy balance over the energy scale"),
    Column("err 1 s", "Worst RMS particle error at 1 s over the low and medium trajectories"),
    Column(
        "err max",
        "Worst RMS particle error over all frames and trajectories; marked where the error "
        "divided by the sensitivity's growth is over its budget",
    ),
    Column("agrees", "Until when all errors stay below 1 % of the scene's length"),
)
"""Columns of the main table."""


def cells_of(result: EngineResult, validation: Validation) -> tuple[Cell, ...]:
    """Fill the columns for an engine; figures over their budgets are marked.

    One that is over its budget by no more than its check is uncertain has passed.
    """
    over = {f.check for f in result.findings if not f.passed and math.isfinite(f.figure)}

    def judged(text: str, check: str) -> Cell:
        return Cell(text, "over" if check in over else "")

    # Error that chaos explains is no fault: the verdict uses the error over the growth.
    error_max = judged(quantity.length(result.error_max_m), "error growth-weighted")
    return (
        *map(Cell, (result.engine, result.profile, result.method)),
        Cell(quantity.pace(result.step_s, result.rtol)),
        Cell(quantity.span(result.wall_per_simulated_s)),
        judged(quantity.length(result.constraint_gap_m), "gap"),
        judged(quantity.number(result.energy_balance), "energy"),
        judged(quantity.length(result.error_1s_m), "error at 1 s"),
        Cell(quantity.NONE) if _is_unknown(validation) else error_max,
        Cell(_agreement(result, validation)),
    )


def _agreement(result: EngineResult, validation: Validation) -> str:
    if result.agreement_time_s is not None:
        return f"{result.agreement_time_s:.2f} s"
    if result.error_max_m is None or _is_unknown(validation):
        return quantity.NONE
    times = ends(validation)
    return f"≥{times[0]:.2f} s" if times else "always"
