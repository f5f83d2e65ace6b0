"""Adapters, scenes, and readers and writers of other formats, found by entry point.

Adapters of other packages are called in separate processes and never imported here, since a
package may raise, hang, take all memory or end the process when it is imported or called. A first
process makes its adapter and returns its claims; a class with these claims stands in for it here.
Readers of models, and other packages' writers, are called in such processes, too.
"""

from __future__ import annotations

import functools
import pickle
import re
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import EntryPoint, PackageNotFoundError, entry_points
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, get_type_hints

import msgspec

from mbds_xsim.base.errors import (
    EngineFaulty,
    EngineMissing,
    InputError,
    SceneError,
    UnknownName,
    Unsupported,
    check_name,
)
from mbds_xsim.base.isolate import Crash, Task, in_worker, run_tasks
from mbds_xsim.base.text import in_utf8
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.adapter import Adapter, Profile, Run, Settings, version_of
from mbds_xsim.simulate.claims import ContactScales, check_claims

if TYPE_CHECKING:
    from mbds_xsim.scene.imported import Imported, Written

T = TypeVar("T")

# In the paper's order; other sizes of a family are found by name, too.
PAPER_SCENES = (
    "ballscroll", "balldrop", "5pendulum", "6pendulum", "2ladder", "3ladder", "particlecar",
    "simplecubli",
)  # fmt: skip

REFERENCE = "reference"
"""Name of the reference solver, the only simulator with an adapter that is no engine."""

_OURS = "mbds-xsim"
_TRUTH = EntryPoint(REFERENCE, "mbds_xsim.reference.adapter:Reference", "mbds_xsim.adapters")

Reader = Callable[[Path, Path, bool, bool], "Imported"]
"""Function of the file, the folder that its paths must not leave, whether its base floats, and
whether its shapes touch the ground. Its entry point is named after the files' suffix. It raises
`InputError` with a line that does not name the file."""

Writer = Callable[[Scene], "Written"]
"""Function that writes a scene; raises `InputError` if the format cannot express it."""

_READING = 300.0  # time limit for reading or writing a model [s]
_TIMEOUT = 60.0  # time limit for an adapter's import or answer [s]


def engine_names() -> list[str]:
    """Return the names of all known adapters, whether or not their engine is installed."""
    return sorted(registered("mbds_xsim.adapters"))


def simulator_names() -> list[str]:
    """Return the names of all engines and of the reference."""
    return [*engine_names(), REFERENCE]


def is_foreign(name: str) -> bool:
    """Return whether another package registers the adapter."""
    return _owner(registered("mbds_xsim.adapters")[name]) != _OURS


def installed_engines() -> list[str]:
    """Return the names of the adapters whose engine can be imported."""
    return [name for name in engine_names() if _lack(name) is None]


def faulty_engines() -> dict[str, str]:
    """Return the adapters of other packages that cannot be used, each with the reason."""
    lacks = {name: _lack(name) for name in engine_names()}
    return {name: str(lack) for name, lack in lacks.items() if isinstance(lack, EngineFaulty)}


def _lack(name: str) -> EngineMissing | None:
    try:
        load_adapter(name)
    except EngineMissing as error:
        return error
    return None


def load_adapter(name: str) -> Adapter:
    """Make an adapter by name; the reference has one too.

    Raises:
        UnknownName: No adapter has that name.
        EngineMissing: Its engine is not installed.
        EngineFaulty: The adapter is another package's, and fails before it can answer.
    """
    if name == REFERENCE:
        return made(_TRUTH)
    check_name("engine", name, simulator_names())
    point = registered("mbds_xsim.adapters")[name]
    if is_foreign(name) and not in_worker():  # a task already has a process of its own
        return _stand_in(point)
    try:
        adapter = made(point)
        if not is_foreign(name):  # a foreign one may lack a package
            version_of(adapter.package)  # adapters import their engine late
        return adapter
    except ImportError as error:
        command = f"pip install 'mbds-xsim[{name}]'"
        msg = f"the engine {name} is not installed ({error}); install it with: {command}"
        raise EngineMissing(msg) from error


def scene_names() -> list[str]:
    """Return the names of built-in scenes: the paper's, then other single ones and scene files."""
    others = registered("mbds_xsim.single_scenes").keys() | _scene_files().keys()
    return [*PAPER_SCENES, *sorted(others - set(PAPER_SCENES))]


def load_scene(name: str) -> Scene:
    """Make a scene from a built-in name, a family name with a size, or the path of a file.

    Raises:
        UnknownName: Nothing of that name exists.
        SceneError: The file is wrong; the text says where.
    """
    from mbds_xsim.scene.file import read_scene

    if is_model(name):
        return read_model(Path(name)).scene
    if name.lower().endswith(".toml") or "/" in name:
        return read_scene(Path(name))
    singles = registered("mbds_xsim.single_scenes")
    if name in singles:
        return singles[name].load()()
    if name in _scene_files():
        return read_scene(_scene_files()[name])
    match = re.fullmatch(r"([1-9][0-9]{0,3})([a-z]\w*)", name)
    families = registered("mbds_xsim.families")
    if match and match[2] in families:
        return families[match[2]].load()(int(match[1]))
    digits = re.match(r"[0-9]*", name)[0]  # type: ignore[index]  # matches any text
    if name[len(digits) :] in families:
        msg = f"no scene is called {name!r}: N of N{name[len(digits) :]} is a number from 1 to 9999"
        raise UnknownName(msg)
    sized = [f"N{family}" for family in sorted(families)]
    raise UnknownName.of(
        "scene", name, [*scene_names(), *sized, "a path to a .toml file", "a model in a file"]
    )


def is_model(name: str) -> bool:
    """Return whether a reader for files with such a name is registered."""
    return Path(name).suffix[1:].lower() in registered("mbds_xsim.model_readers")


def read_model(
    path: Path, *, folder: Path | None = None, floating: bool = False, ground: bool = False
) -> Imported:
    """Read a model and check that its mechanism assembles and its starts can be drawn.

    Args:
        path: Path of the file.
        folder: Folder in which files named in the model must lie; by default the model's own.
        floating: Whether a base that the file does not attach is free, not fixed in the world.
        ground: Whether its collision shapes touch the ground.

    Raises:
        InputError: The file is invalid; one line names it, the fault and its place.
    """
    readers = registered("mbds_xsim.model_readers")
    suffix = path.suffix[1:].lower()
    check_name("format of models", suffix, sorted(readers))
    if not path.is_file():
        raise InputError(f"{path}: cannot be read (no such file); give the path of a model")
    if in_utf8(str(path.absolute())) != str(path.absolute()):
        raise InputError(f"{path}: got a path that is not UTF-8, which readers need; rename it")
    inside = (folder or path.parent).absolute()
    arguments = (readers[suffix], path.absolute(), inside, floating, ground)
    (answer,) = run_tasks([Task(_read, arguments, _READING)], workers=1)
    if isinstance(answer, Crash):
        raise SceneError(f"{path}: {answer.reason}")
    return answer


def _read(point: EntryPoint, path: Path, folder: Path, floating: bool, ground: bool) -> Imported:
    from mbds_xsim.scene.file import check_starts

    reader: Reader = point.load()
    imported = reader(path, folder, floating, ground)
    check_starts(imported.scene)
    return imported


def write_model(scene: Scene, kind: str) -> Written:
    """Write a scene in another format.

    Args:
        scene: The scene.
        kind: Name of the format.

    Raises:
        InputError: The format cannot express the scene, or another package's writer fails; the
            message says why.
    """
    writers = registered("mbds_xsim.model_writers")
    check_name("format of models", kind, sorted(writers))
    if _owner(writers[kind]) == _OURS:
        return _write(writers[kind], scene)
    (answer,) = run_tasks([Task(_write, (writers[kind], scene), _READING)], workers=1)
    if isinstance(answer, Crash):
        why = "" if answer.refused else f"the writer of {kind}, {writers[kind].value}, fails: "
        raise InputError(f"{why}{answer.reason}")
    return answer


def _write(point: EntryPoint, scene: Scene) -> Written:
    from mbds_xsim.scene.imported import Written

    writer: Writer = point.load()
    written = writer(scene)
    if not isinstance(written, Written):
        raise TypeError(f"it gives {written!r:.60}, not {Written.__name__}")
    return written


def package_version(distribution: str) -> str:
    """Return the version of an installed distribution, or "not installed"."""
    try:
        return version_of(distribution)
    except PackageNotFoundError:
        return "not installed"


@functools.cache
def registered(group: str) -> dict[str, EntryPoint]:
    """Return the entry points that packages register in a group, by name."""
    points: dict[str, EntryPoint] = {}
    for point in entry_points(group=group):
        if point.name in points and points[point.name].value != point.value:
            both = f"{points[point.name].value} and {point.value}"
            raise InputError(
                f"two packages register {point.name!r} in {group}: {both}; uninstall one"
            )
        points[point.name] = point
    return points


@functools.cache
def _scene_files() -> dict[str, Path]:
    paths = {}
    for point in registered("mbds_xsim.scenes").values():
        for entry in files(point.value).iterdir():
            if entry.name.endswith(".toml"):
                paths[entry.name.removesuffix(".toml")] = Path(str(entry))
    return paths


_CLAIMED = {key: hint.__args__[0] for key, hint in get_type_hints(Adapter).items()}
_Claims: Any = msgspec.defstruct("_Claims", [*_CLAIMED.items(), ("installed", str)])
"""Claims of an adapter: the class variables of `Adapter`, and its engine's version."""


class _StandIn(Adapter):
    """Stand-in for another package's adapter, with its claims."""

    point: ClassVar[EntryPoint]
    installed: ClassVar[str]
    """Version of the engine."""

    def version(self) -> str:
        return self.installed

    def settings(self, scene: Scene, profile: Profile) -> Settings:
        answer = _ask(_preset, self.point, scene, profile)
        if isinstance(answer, Crash):
            reason = answer.reason if answer.refused else f"gives no settings: {answer.reason}"
            raise Unsupported(f"{self.name} {profile}: {reason}")
        return answer

    def cannot_hold(self, scene: Scene) -> str:
        answer = _ask(_called, self.point, "cannot_hold", str, scene)
        return f"its adapter fails: {answer.reason}" if isinstance(answer, Crash) else str(answer)

    def contact_scales(self, settings: Settings) -> ContactScales:
        answer = _ask(_called, self.point, "contact_scales", ContactScales, settings)
        if isinstance(answer, Crash):
            raise Unsupported(f"{self.name} does not say how it resolves contact: {answer.reason}")
        return answer

    def load(self, scene: Scene, settings: Settings) -> Run:
        return made(self.point).load(scene, settings)


def made(point: EntryPoint) -> Adapter:
    """Import an adapter and make an instance.

    Raises:
        TypeError: The entry point gives something else.
    """
    adapter = point.load()()
    if not isinstance(adapter, Adapter):
        raise TypeError(
            f"the entry point {point.name!r} gives {type(adapter).__name__}, not an Adapter"
        )
    return adapter


def _stand_in(point: EntryPoint) -> Adapter:
    """Make the stand-in for another package's adapter."""
    answer = _ask(_claims, point)
    if isinstance(answer, Crash):
        why = f"{point.value} of the package {_owner(point)}: {answer.reason}"
        raise EngineFaulty(f"the engine {point.name} cannot be used: {why}; repair or uninstall it")
    return type(point.name, (_StandIn,), answer | {"point": point})()


@functools.cache  # a package's metadata is otherwise read each time
def _owner(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else "(unknown)"


def _ask(function: Any, point: EntryPoint, *arguments: Any) -> Any:
    return _answer(function, point, pickle.dumps(arguments))


@functools.cache
def _answer(function: Any, point: EntryPoint, arguments: bytes) -> Any:
    (answer,) = run_tasks([Task(function, (point, *pickle.loads(arguments)), _TIMEOUT)], workers=1)
    return answer


def _claims(point: EntryPoint) -> dict[str, Any]:
    """Return an adapter's claims; raise an error if one is missing or of the wrong type."""
    adapter = made(point)
    values = {key: getattr(adapter, key) for key in _CLAIMED if key != "package"}
    raw = _Claims(**values, package=getattr(adapter, "package", ""), installed=adapter.version())
    claims = msgspec.json.decode(msgspec.json.encode(raw), type=_Claims)
    if claims.name != point.name:
        raise ValueError(f"its name is {claims.name!r}, that of the entry point {point.name!r}")
    if not claims.installed:
        raise ValueError("it has no version")
    check_claims(claims.methods, claims.options, claims.sweeps, claims.cut)
    return msgspec.structs.asdict(claims)


def _preset(point: EntryPoint, scene: Scene, profile: Profile) -> Settings:
    adapter = made(point)
    settings = _typed(adapter.settings(scene, profile), Settings)
    with suppress(Unsupported):  # another of its methods may support the scene
        adapter.check(scene, settings)
    _called(point, "contact_scales", ContactScales, settings)
    return settings


def _called(point: EntryPoint, method: str, kind: type[T], argument: Scene | Settings) -> T:
    """Call a method of an adapter; its answer must be of a kind."""
    return _typed(getattr(made(point), method)(argument), kind)


def _typed(value: object, kind: type[T]) -> T:
    """Convert a value so that its fields have the types of a class."""
    if not isinstance(value, kind):
        raise TypeError(f"it gives {value!r:.60}, not {kind.__name__}")
    return msgspec.json.decode(msgspec.json.encode(value), type=kind)
