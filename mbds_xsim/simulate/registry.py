"""Adapters, scene families and scene files, found by entry point."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from importlib.metadata import EntryPoint, PackageNotFoundError, entry_points, version
from importlib.resources import files
from pathlib import Path

from mbds_xsim.base.errors import EngineFaulty, EngineMissing, InputError, UnknownName
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.adapter import Adapter
from mbds_xsim.simulate.plugin import made, stand_in

# In the paper's order; every other size of a family is found by its name too.
PAPER_SCENES = (
    "ballscroll",
    "balldrop",
    "5pendulum",
    "6pendulum",
    "2ladder",
    "3ladder",
    "particlecar",
    "simplecubli",
)


def engine_names() -> list[str]:
    """Names of all known adapters, whether their engine is installed or not."""
    return sorted(_points("mbds_xsim.adapters"))


def installed_engines() -> list[str]:
    """Names of the adapters whose engine can be imported."""
    return [name for name in engine_names() if _lack(name) is None]


def faulty_engines() -> dict[str, str]:
    """Names of adapters of other packages that cannot be used, each with the reason."""
    lacks = {name: _lack(name) for name in engine_names()}
    return {name: str(lack) for name, lack in lacks.items() if isinstance(lack, EngineFaulty)}


def _lack(name: str) -> EngineMissing | None:
    try:
        load_adapter(name)
    except EngineMissing as error:
        return error
    return None


def load_adapter(name: str) -> Adapter:
    """Make an adapter by name.

    Raises:
        UnknownName: No adapter has that name.
        EngineMissing: Its engine is not installed.
        EngineFaulty: It is another package's, and goes wrong before it can be asked anything.
    """
    points = _points("mbds_xsim.adapters")
    if name not in points:
        raise UnknownName.of("engine", name, engine_names())
    other = stand_in(points[name])
    if isinstance(other, str):
        raise EngineFaulty(f"the engine {name} cannot be used: {other}; repair or uninstall it")
    if other is not None:
        return other
    try:
        return made(points[name])
    except ImportError as error:
        msg = (
            f"the engine {name} is not installed ({error}); "
            f"install it with: pip install 'mbds-xsim[{name}]'"
        )
        raise EngineMissing(msg) from error


def scene_names() -> list[str]:
    """Names of the built-in scenes: the paper's, then other single ones and scene files."""
    others = _points("mbds_xsim.single_scenes").keys() | _scene_files().keys()
    return [*PAPER_SCENES, *sorted(others - set(PAPER_SCENES))]


def load_scene(name: str) -> Scene:
    """Make a scene from a built-in name, a family name with a size, or a path to a scene file.

    Raises:
        UnknownName: Nothing of that name exists.
        SceneError: The file is wrong; the text says where.
    """
    from mbds_xsim.scene.file import read_scene

    if name.endswith(".toml") or "/" in name:
        return read_scene(Path(name))
    singles = _points("mbds_xsim.single_scenes")
    if name in singles:
        single: Callable[[], Scene] = singles[name].load()
        return single()
    if name in _scene_files():
        return read_scene(_scene_files()[name])
    match = re.fullmatch(r"([1-9][0-9]{0,3})([a-z]\w*)", name)
    families = _points("mbds_xsim.families")
    if match and match[2] in families:
        family: Callable[[int], Scene] = families[match[2]].load()
        return family(int(match[1]))
    digits = re.match(r"[0-9]*", name)[0]  # type: ignore[index]  # matches any text
    if name[len(digits) :] in families:
        msg = f"no scene is called {name!r}: N of N{name[len(digits) :]} is a number from 1 to 9999"
        raise UnknownName(msg)
    sized = [f"N{family}" for family in sorted(families)]
    raise UnknownName.of("scene", name, [*scene_names(), *sized, "a path to a .toml file"])


def package_version(distribution: str) -> str:
    """Version of an installed distribution, or "not installed"."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"


@functools.cache
def _points(group: str) -> dict[str, EntryPoint]:
    points: dict[str, EntryPoint] = {}
    for point in entry_points(group=group):
        if point.name in points and points[point.name].value != point.value:
            msg = (
                f"two packages register {point.name!r} in {group}: "
                f"{points[point.name].value} and {point.value}; uninstall one"
            )
            raise InputError(msg)
        points[point.name] = point
    return points


@functools.cache
def _scene_files() -> dict[str, Path]:
    found = {}
    for point in _points("mbds_xsim.scenes").values():
        for entry in files(point.value).iterdir():
            if entry.name.endswith(".toml"):
                found[entry.name.removesuffix(".toml")] = Path(str(entry))
    return found
