"""Variants of a data set: how each is made, its shards, and which of these are missing."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.text import counted
from mbds_xsim.base.versions import CHECKS
from mbds_xsim.dataset.hdf5 import attributes_of, variant_files
from mbds_xsim.dataset.layout import AUDIT_SAMPLE, FORMAT, ONE_SIZE, SHARED, SUFFIX, VERSION
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.scene.file import write_scene
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.choice import Contender
from mbds_xsim.simulate.claims import Method
from mbds_xsim.simulate.registry import load_adapter, package_version

_SHARD_BYTES = 2**25  # bytes of motion in a shard; a worker holds about ten times as much
_MOST = 300
_FEWEST, _PART = 16, 8
_BODY_BYTES = 13 * 8  # bytes of a body in a frame
_POINT_BYTES = 2 * 3 * 4


@dataclass(frozen=True, eq=False)
class Variant:
    """A scene in one engine at one setting."""

    scene: Scene
    contender: Contender
    seed: int
    noise: bool

    @property
    def name(self) -> str:
        """Engine and profile, as in the names of the variant's folder and file."""
        return f"{self.contender.engine}-{self.contender.profile}"

    @property
    def method(self) -> Method:
        """The engine's method."""
        return load_adapter(self.contender.engine).methods[self.contender.settings.method]

    @property
    def certified(self) -> bool:
        """Whether all checks decide on publication, not integrity alone."""
        return self.contender.profile == "matched"

    @cached_property
    def recipe(self) -> dict[str, Any]:
        """Attributes that say how the data are made; variants with equal ones have equal data."""
        settings, method = self.contender.settings, self.method
        adapter = load_adapter(self.contender.engine)
        return {
            "format": FORMAT,
            "layout_version": VERSION,
            "scene_name": self.scene.name,
            "scene": write_scene(self.scene, defaults=True),
            "dimension": self.scene.dimension,
            "frame_s": self.scene.clock.frame,
            "steps": self.scene.clock.steps,
            "seed": self.seed,
            "noise": self.noise,
            "engine": self.contender.engine,
            "engine_version": adapter.version(),
            "adapter_revision": adapter.revision,
            "profile": self.contender.profile,
            "certification": "certified" if self.certified else "uncertified",
            "method": method.name,
            "method_family": method.family,
            "method_order": method.order_for(self.scene),
            "step_s": settings.step,
            "options": json.dumps(dict(settings.options), sort_keys=True),
            "contact_time_s": adapter.contact_scales(settings).time,
            "velocity_lag_s": method.velocity_lag * settings.step,
            **({"single_precision": True} if method.single else {}),
            "audit_sample": AUDIT_SAMPLE,
            "checks_version": CHECKS,
            "numpy_version": package_version("numpy"),
            "mbds_xsim_version": package_version("mbds-xsim"),
        }

    def items(self, trajectories: int) -> Iterator[Item]:
        """Yield the shards of the trajectories 0 … trajectories − 1; the scene alone decides them.

        Each has at most an eighth of the trajectories before it, or 16 if that is more. So even few
        trajectories give work to many processes, and a larger set extends a smaller one.
        """
        first = 0
        while first < trajectories:
            size = self._size(first)
            yield Item(self, first, min(size, trajectories - first))
            first += size

    def shard_count(self, trajectories: int) -> int:
        """Return the number of shards of so many trajectories, without going through them all."""
        count = first = 0
        while first < trajectories and self._size(first) < self._most:
            count, first = count + 1, first + self._size(first)
        return count + math.ceil(max(0, trajectories - first) / self._most)

    def _size(self, first: int) -> int:
        return min(self._most, max(_FEWEST, first // _PART))

    @cached_property
    def _most(self) -> int:
        """Largest number of trajectories in a shard."""
        scene = self.scene
        frame = len(scene.bodies) * _BODY_BYTES + scene.particle_count * _POINT_BYTES
        return max(1, min(_SHARD_BYTES // ((scene.clock.steps + 1) * frame), _MOST))

    def folder(self, out: Path) -> Path:
        """Return the folder of the variant's shards."""
        return out / folder_name(self.scene.name) / self.name


@dataclass(frozen=True)
class Item:
    """One shard of a variant: trajectories first … first + count − 1."""

    variant: Variant
    first: int
    count: int

    @property
    def indices(self) -> range:
        """Numbers of the shard's trajectories."""
        return range(self.first, self.first + self.count)

    def path(self, out: Path) -> Path:
        """Return the path of the shard's file."""
        return self.variant.folder(out) / f"{self.first:010d}{SUFFIX}"


def folder_name(scene_name: str) -> str:
    """Return the name of a scene in a form that is safe for a folder."""
    return re.sub(r"[^\w.-]", "_", scene_name).lstrip(".") or "_"


def pending(variant: Variant, trajectories: int, out: Path) -> list[Item]:
    """Return the shards that are not there yet.

    Raises:
        InputError: The folder holds something other than the beginning of these data.
    """
    folder = variant.folder(out)
    items = {item.path(out): item for item in variant.items(trajectories)}
    present = set(folder.glob(f"*{SUFFIX}"))
    beyond = sorted(present - items.keys())
    if beyond:
        raise InputError(
            f"{folder} holds {beyond[0].name}, which does not belong to {trajectories} "
            f"trajectories; ask for {_allowed(beyond[-1])}, or name another --out"
        )
    return [
        item for path, item in items.items() if path not in present or not _is_complete(item, path)
    ]


def _allowed(last: Path) -> str:
    """Describe the numbers of trajectories that a folder allows whose last shard is this one."""
    if not re.fullmatch(r"\d+", last.stem):
        return "as many as before"
    return f"{int(last.stem) + _attributes(last).get('count', 0)} or more"


def check_same_draws(variant: Variant, out: Path) -> None:
    """Raise InputError if another variant in the folder has other starts."""
    folder = variant.folder(out).parent
    others = {path.parent: path for path in folder.glob(f"*/*{SUFFIX}")}
    fault = f"{folder} holds trajectories that cannot be paired with those asked for"
    for path in others.values():
        _check_same(_attributes(path), {key: variant.recipe[key] for key in SHARED}, fault)


def unpaired(variants: Iterable[Variant], trajectories: int, out: Path) -> Iterator[str]:
    """Yield warnings of sets beside the variants whose number of trajectories is another.

    Raises:
        InputError: A set is damaged or lacks shards: it would end the run once all is made.
    """
    asked = {variant.folder(out) for variant in variants}
    beside = (file for scene in {path.parent for path in asked} for file in variant_files(scene))
    for file in sorted(file for file in beside if file.with_suffix("") not in asked):
        count = _read(lambda path: load_dataset(path).attributes, file)["count"]
        if count != trajectories:
            got = counted(count, "trajectory")
            yield f"{file}: {got}, now asked for: {trajectories}; {ONE_SIZE}"


def _is_complete(item: Item, path: Path) -> bool:
    """Return whether a file is this shard; a shorter one, of a smaller set, is made anew."""
    attrs = _attributes(path)
    recipe = {**item.variant.recipe, "first": item.first}
    _check_same(attrs, recipe, f"{path} was made differently")
    if attrs.get("count", 0) > item.count:
        raise InputError(
            f"{path} holds {counted(attrs['count'], 'trajectory')}, needed: {item.count}; it is "
            f"from a larger set or another version; ask for {_allowed(path)}, or name another --out"
        )
    return bool(attrs["count"] == item.count)


def _attributes(path: Path) -> dict[str, Any]:
    return _read(attributes_of, path)


def _read(attributes: Callable[[Path], dict[str, Any]], path: Path) -> dict[str, Any]:
    try:
        return attributes(path)
    except InputError as error:
        raise InputError(f"{error}; delete it to make it anew, or name another --out") from error


def _check_same(attrs: Mapping[str, Any], wanted: Mapping[str, Any], fault: str) -> None:
    """Raise InputError with the fault and the first attribute that differs, if one does."""
    for key, value in wanted.items():
        if attrs.get(key) == value:
            continue
        cause = f"is {attrs.get(key)!r}, now asked for is {value!r}"
        if isinstance(value, str) and "\n" in value:
            cause = "differs from the one given"
        raise InputError(f"{fault}: its {key} {cause}; name another --out")
