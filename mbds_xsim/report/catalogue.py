"""Catalogue of engines, with their methods and limits, and of scenes, with their needs.

The page `docs/engines.md` is written from it, and thus from the adapters' claims.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import msgspec

from mbds_xsim.base.errors import EngineFaulty, EngineMissing, InputError
from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.report import quantity
from mbds_xsim.report.files import table_text
from mbds_xsim.scene.budget import Budget
from mbds_xsim.scene.constraints import degrees_of_freedom
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import INTERVALS, Levels
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.claims import ContactLaw, Feature, Method, features_of

_TIMEOUT = 600.0  # time to load a scene [s]
_HEAD = """\
# Engines

This page is written from the adapters by `mbds-xsim engines --markdown > docs/engines.md`; a
test compares the two. `mbds-xsim engines` prints the same for the engines that are installed. Every
claim except the order of the reference's steps is measured: the contract suite
(`mbds_xsim.testing.AdapterContract`) runs each method on cases with exact answers, fits its order
of convergence, and checks that unsupported scenes are refused, with the reason, before the engine
sees them.

Which to use for what: [choose-an-engine.md](choose-an-engine.md). One of your own:
[add-an-engine.md](add-an-engine.md).

## What each can represent

“yes” means with all its methods, “some” not with all of them, “no” with none. The notes give the
reasons.
"""
_SMALLEST = """
## How small a body may be

A scene file may name masses down to 1e-30 kg. Below an engine's limit the scene is refused before
the engine sees it; at the limit bodies still move correctly, which a test checks for each engine.
"""
_CONTACT = """
## What contact is

This table describes the engines' contact laws. What each adapter achieves with them is measured in
[contact.md](contact.md).
"""
_METHODS = """
## Methods and options

Methods of one family are one vote when engines are compared: their agreement is no evidence.
“Order” is the order of convergence, “with loops” the order in scenes whose constraints are solved
in addition to the coordinates. Recorded velocities belong to the frame's time plus “velocity lag”
times the step. A method in single precision is allowed the error that rounding the model and the
start to 24 significant bits causes; beyond that it must keep the same budgets as the others.
"""
_ASPECTS = {
    "non-penetration": "normal",
    "restitution": "restitution",
    "friction": "friction",
    "two bodies' coefficients": "mixing",
}
# Features that add constraints to the coordinates of a tree.
_CONSTRAINED = (
    Feature.LOOP_BALL,
    Feature.LOOP_HINGE,
    Feature.LOOP_SLIDER,
    Feature.LOOP_FIXED,
    Feature.DISTANCE_LINK,
)


class MethodRow(msgspec.Struct, frozen=True):
    """One method of an engine."""

    name: str
    family: str
    order: int
    loop_order: int
    """Order where constraints are solved in addition to the coordinates."""
    velocity_lag: float
    """Lag of recorded velocities [steps]: they belong to (frame time + lag · step)."""
    refuses: dict[str, str]
    """Features that this method lacks, unlike its engine, with the reason."""
    single: bool = False
    """Whether it steps in single precision."""


class OptionRow(msgspec.Struct, frozen=True):
    """One option of an engine."""

    default: float | int | bool | str
    meaning: str


class EngineRow(msgspec.Struct, frozen=True):
    """One engine."""

    engine: str
    version: str
    """Version, or "not installed" if the engine is missing; the rest is empty then."""
    fault: str = ""
    """Reason why an adapter of another package cannot be used; the rest is empty then, too."""
    package: str = ""
    """Distribution that installs it."""
    coordinates: str = ""
    methods: tuple[MethodRow, ...] = ()
    options: dict[str, OptionRow] = {}
    limits: dict[str, str] = {}
    """Features that the engine lacks, with the reason."""
    contact_law: ContactLaw | None = None
    """Law of contact in the engine; None without contact."""
    smallest: str = ""
    """Smallest masses and moments of inertia that it can hold, in words."""


class SceneRow(msgspec.Struct, frozen=True):
    """One scene."""

    scene: str
    dimension: int
    bodies: int
    particles: int
    joints: int
    loops: int
    degrees_of_freedom: int
    needs: tuple[str, ...]
    description: str


def engine_rows() -> list[EngineRow]:
    """List all known engines and the reference; a missing one has no methods."""
    return [_engine_row(name) for name in registry.simulator_names()]


def scene_rows() -> list[SceneRow]:
    """List the built-in scenes."""
    return [scene_row(registry.load_scene(name)) for name in registry.scene_names()]


def scene_row(scene: Scene) -> SceneRow:
    """Summarise a scene."""
    mechanism = Mechanism.of(scene)
    needs = features_of(scene)
    return SceneRow(
        scene=scene.name,
        dimension=scene.dimension,
        bodies=mechanism.body_count,
        particles=scene.particle_count,
        joints=len(mechanism.joints),
        loops=len(mechanism.loops) + len(mechanism.distances),
        degrees_of_freedom=degrees_of_freedom(mechanism),
        needs=tuple(feature.value for feature in Feature if feature in needs),
        description=scene.description,
    )


def told_budgets(scene: Scene) -> str:
    """Describe the budget of the error, and the budgets that are not the usual ones."""
    usual, own = (msgspec.structs.asdict(budget) for budget in (Budget(), scene.budget))
    other = ", ".join(f"{key} {value:g}" for key, value in own.items() if value != usual[key])
    error = quantity.length(scene.budget.error_1s * scene.length)
    return f"error at 1 s {error}; {other or 'all as usual'}"


def told_term(term: object) -> str:
    """Describe a term of a scene's random starts and inputs, without values that are zero."""
    fields = {key: getattr(term, key) for key in term.__struct_fields__}  # type: ignore[attr-defined]
    parts = [f"{key}: {_shown(value)}" for key, value in fields.items() if not _nothing(value)]
    kind = term.__struct_config__.tag  # type: ignore[attr-defined]
    return f"{kind} ({'; '.join(parts)})"


def _nothing(value: object) -> bool:
    """Return whether a value switches nothing on, or a vector or range is zero throughout."""
    zero = isinstance(value, tuple) and all(v == 0.0 or _nothing(v) for v in value)
    return value is False or zero


def _shown(value: object) -> str:
    """Format ranges briefly, by interval and by component."""
    if isinstance(value, Levels):
        return ", ".join(f"{name} {_shown(getattr(value, name))}" for name in INTERVALS)
    if isinstance(value, float):
        return f"{value:g}"
    if not isinstance(value, tuple):
        return str(value)
    if len(value) > 6:
        return f"{value[0]} … {value[-1]}"
    if isinstance(value[0], tuple | Levels):
        spans = zip("xyz", value, strict=True)
        return ", ".join(f"{name} {_shown(span)}" for name, span in spans if not _nothing(span))
    inner = ", ".join(map(_shown, value))
    return inner if isinstance(value[0], str) else f"[{inner}]"


def native_text(scene: Scene, engine: str, settings: Settings, start: int | None = None) -> str:
    """Return exactly what an engine is given: a native file, or a script that simulates it.

    It starts like the trajectory of that number, or without one as the scene itself says.

    Raises:
        InputError: The engine cannot represent the scene, or crashed on it.
    """
    adapter = registry.load_adapter(engine)
    adapter.check(scene, settings)
    (answer,) = run_tasks([Task(_native_text, (scene, engine, settings, start), _TIMEOUT)])
    if isinstance(answer, Crash):
        raise InputError(f"{engine} cannot load the scene: {answer.reason}")
    return str(answer)


def _native_text(scene: Scene, engine: str, settings: Settings, start: int | None) -> str:
    drawn = scene if start is not None else msgspec.structs.replace(scene, sampling=(), noise=0.0)
    with registry.load_adapter(engine).open(scene, settings) as run:
        return run.native(draw_batch(drawn, [start or 0]))


def by_reason(refusals: dict[str, str]) -> dict[str, list[str]]:
    """Group features that are refused for the same reason."""
    grouped: dict[str, list[str]] = {}
    for feature, reason in refusals.items():
        grouped.setdefault(reason, []).append(feature)
    return grouped


def _engine_row(name: str) -> EngineRow:
    try:
        adapter = registry.load_adapter(name)
    except EngineFaulty as error:
        return EngineRow(name, "cannot be used", fault=str(error))
    except EngineMissing:
        return EngineRow(name, "not installed")
    return EngineRow(
        engine=name,
        version=adapter.version(),
        package=adapter.package,
        coordinates=adapter.coordinates,
        methods=tuple(_method_row(method) for method in adapter.methods.values()),
        options={key: OptionRow(o.default, o.meaning) for key, o in adapter.options.items()},
        limits=_in_words(adapter.limits),
        contact_law=adapter.contact_law,
        smallest=adapter.smallest,
    )


def _method_row(method: Method) -> MethodRow:
    return MethodRow(
        name=method.name,
        family=method.family,
        order=method.order,
        loop_order=method.order if method.loop_order is None else method.loop_order,
        velocity_lag=method.velocity_lag,
        refuses=_in_words(method.refuses),
        single=method.single,
    )


def _in_words(refusals: Mapping[Feature, str]) -> dict[str, str]:
    return {feature.value: refusals[feature] for feature in Feature if feature in refusals}


def engines_page(rows: list[EngineRow]) -> str:
    """Return the page in Markdown."""
    notes: list[str] = []
    cells = [[_cell(row, feature.value, notes) for row in rows] for feature in Feature]
    features = ([feature.value, *line] for feature, line in zip(Feature, cells, strict=True))
    parts = [
        _HEAD,
        _table(["", *(row.engine for row in rows)], features),
        "".join(f"[^{k}]: {note}\n" for k, note in enumerate(notes, 1)).rstrip("\n"),
        _SMALLEST,
        "\n".join(f"- **{row.engine}**: {row.smallest}." for row in rows if row.smallest),
        _CONTACT,
        _contact(rows),
        _METHODS,
        *(_engine(row) for row in rows),
    ]
    return "\n".join(parts)


def _cell(row: EngineRow, feature: str, notes: list[str]) -> str:
    """Return whether an engine has a feature, with a note if not, or not with all methods."""
    if feature in row.limits:
        return f"no{_mark(f'{row.engine}: {row.limits[feature]}.', notes)}"
    refusing = {m.name: m.refuses[feature] for m in row.methods if feature in m.refuses}
    if not refusing:
        return "yes"
    reasons = "; ".join(
        f"not with {', '.join(f'`{name}`' for name in names)}: {reason}"
        for reason, names in by_reason(refusing).items()
    )
    share = "no" if len(refusing) == len(row.methods) else "some"
    return f"{share}{_mark(f'{row.engine}, {reasons}.', notes)}"


def _mark(note: str, notes: list[str]) -> str:
    if note not in notes:
        notes.append(note)
    return f"[^{notes.index(note) + 1}]"


def _contact(rows: list[EngineRow]) -> str:
    """Lay out the engines' claims about contact; an engine without contact has no column."""
    laws = {row.engine: row.contact_law for row in rows if row.contact_law is not None}
    return _table(
        ["", *laws],
        ([name, *(getattr(law, key) for law in laws.values())] for name, key in _ASPECTS.items()),
    ).rstrip("\n")


def _engine(row: EngineRow) -> str:
    methods = _table(
        ["method", "family", "order", "with loops", "velocity lag [steps]"],
        (_method(method, row) for method in row.methods),
    )
    options = _table(
        ["option", "default", "meaning"],
        ([f"`{k}`", f"`{o.default}`", o.meaning] for k, o in row.options.items()),
    )
    own = row.package == "mbds-xsim"
    source = "always there" if own else f"`pip install 'mbds-xsim[{row.engine}]'`"
    return (
        f"### {row.engine}\n\n{row.coordinates.capitalize()} coordinates; {source}.\n\n{methods}"
        + (f"\n{options}" if row.options else "")
    )


def _method(method: MethodRow, row: EngineRow) -> list[str]:
    closes = any(f.value not in {**row.limits, **method.refuses} for f in _CONSTRAINED)
    return [
        f"`{method.name}`",
        method.family + (", single precision" if method.single else ""),
        str(method.order),
        str(method.loop_order) if closes else "–",
        f"{method.velocity_lag:g}",
    ]


def _table(head: list[str], lines: Iterable[list[str]]) -> str:
    rows = ([cell.replace("|", "\\|") for cell in line] for line in lines)
    return table_text(head, rows)
