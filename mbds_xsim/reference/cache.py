"""Results kept on disk by content, so that a reference solution is computed once.

Entries are stored in the user's cache directory, or in the folder that MBDS_XSIM_CACHE names. Their
names are hashes of everything that decides the result, including the version of the physics. They
are never changed, only replaced whole. Each ends in a checksum of its name and content: an entry
that was damaged, changed or renamed is computed again.
"""

from __future__ import annotations

import functools
import hashlib
import io
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.errors import InputError, Notice
from mbds_xsim.base.files import write_whole
from mbds_xsim.base.versions import PHYSICS
from mbds_xsim.reference.elimination import with_short_loops
from mbds_xsim.reference.tree import tree_of
from mbds_xsim.scene.constraints import degrees_of_freedom
from mbds_xsim.scene.fixed import fixed_spheres
from mbds_xsim.scene.joint_space import BodyStates, joint_coordinate
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch

Arrays = dict[str, NDArray[Any]]

_PHYSICS = (
    "bodies", "joints", "distance_links", "springs", "gravity", "contacts", "ground", "length",
    "dimension",
)  # fmt: skip
_GEARS = 2
"""Extra version of scenes with gears: before it, a gear next to a fixed joint could be left out."""
_BRAKES, _LANDING = 5, 6
"""Extra versions of scenes with dry friction or stops, without and with contact: before them, a
joint could stop and move on, or give way and stop, inside one step without being noticed."""
_DAMPED = 1
"""Extra version of scenes with dampers: before it, one start chose the method of all in a batch."""
_IDLE = 1
"""Extra version of scenes whose closures all follow from the tree: before it, one carried loads."""
_HALF_TURN = 1
"""Extra version of trajectories that start with a sprung, driven or otherwise counted hinge at π:
before it, rounding could make that −π."""
_FIXED = 1
"""Extra version of scenes with spheres fixed to the world: before it, these ended at the ground."""
_SOURCES = ("compiling", "lanes", "traced", "lane_algebra", "noted", "elimination", "tree")
_NEAR = 1e-9  # rad
_SEAL = hashlib.sha256().digest_size


def complete(
    kind: str,
    scene: Scene,
    batch: Batch,
    rtol: float,
    compute: Callable[[list[int]], list[Arrays]],
    *,
    keep: bool,
    together: int,
) -> Iterator[tuple[int, Arrays]]:
    """Yield each row of a batch and its entry, computing and storing those that are missing.

    Entries come one at a time, so that a batch of any size needs little memory of its own.

    Args:
        kind: Kind of result.
        scene: Scene that is simulated.
        batch: Starts and inputs.
        rtol: Tolerance of the result.
        compute: Function that computes the entries of some rows of the batch.
        keep: Whether the disk is read and written at all.
        together: Largest number of rows computed at once.
    """
    keys = [key_of(kind, scene, batch, row, rtol) for row in range(len(batch))] if keep else []
    stored = set()
    for row, key in enumerate(keys):
        entry = load(key)
        if entry is not None:
            stored.add(row)
            yield row, entry
    missing = [row for row in range(len(batch)) if row not in stored]
    for first in range(0, len(missing), together):
        rows = missing[first : first + together]
        for row, entry in zip(rows, compute(rows), strict=True):
            if keep:
                store(keys[row], entry)
            yield row, entry


def directory() -> Path:
    """Return the folder of the entries, as an absolute path."""
    chosen = os.environ.get("MBDS_XSIM_CACHE")
    return Path(chosen).absolute() if chosen else _home()


def _home() -> Path:
    """Return the program's folder in the user's cache directory."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base).absolute() if base else Path.home() / ".cache") / "mbds-xsim"


@functools.cache
def kernel_folder() -> Path:
    """Return the folder of machine code, named by all sources: numba checks only the calling file.

    The folder's modification time is that of its last use.
    """
    here = Path(__file__)
    sources = [here.with_name(f"{name}.py") for name in _SOURCES]
    sources += sorted(here.parents[1].glob("*/*_kernel.py"))
    text = b"".join(path.read_bytes() for path in sources)
    text += str(Path(__file__).parent).encode()
    folder = _home() / "kernels" / hashlib.sha256(text).hexdigest()[:16]
    with suppress(OSError):  # it is missing, or belongs to another user
        os.utime(folder)
    return folder


def key_of(kind: str, scene: Scene, batch: Batch, row: int, rtol: float) -> str:
    """Return the name of a trajectory's entry: a hash of the physics, the start and the inputs."""
    digest = hashlib.sha256()
    physics = [getattr(scene, key) for key in _PHYSICS]
    physics += [scene.servos] if scene.servos else []
    physics += [_GEARS, scene.couplings] if scene.couplings else []
    braked = any(joint.friction or joint.limits for joint in scene.joints)
    physics += [_LANDING if scene.contacts else _BRAKES] if braked else []
    physics += [scene.collisions] if scene.collisions else []
    damping = [joint.damping for joint in scene.joints]
    damping += [spring.damping for spring in scene.springs]
    damping += [servo.damping for servo in scene.servos]
    physics += ["damped", _DAMPED] if any(damping) else []
    physics += ["idle", _IDLE] if _has_idle_closures(Mechanism.of(scene)) else []
    physics += ["half turn", _HALF_TURN] if _starts_at_half_turn(scene, batch, row) else []
    physics += ["fixed", _FIXED] if scene.ground and len(fixed_spheres(scene)) else []
    # Scenes made in Python may hold numpy numbers.
    digest.update(
        msgspec.json.encode([kind, PHYSICS, rtol, scene.clock.frame, physics], enc_hook=float)
    )
    for key in ("position", "orientation", "velocity", "angular_velocity", "force", "torque"):
        array = np.ascontiguousarray(getattr(batch, key)[row])
        digest.update(repr(array.shape).encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


@functools.lru_cache(maxsize=64)
def _has_idle_closures(mechanism: Mechanism) -> bool:
    """Whether the joints and links that close loops take no freedom from the tree."""
    if not (mechanism.loops or mechanism.distances):
        return False
    tree = tree_of(with_short_loops(mechanism))
    return tree.size - tree.place_count == degrees_of_freedom(mechanism)


def _starts_at_half_turn(scene: Scene, batch: Batch, row: int) -> bool:
    mechanism = Mechanism.of(scene)
    hinges = [joint for joint in mechanism.counted if joint.kind == "hinge"]
    if not hinges:
        return False
    start = BodyStates.of(mechanism, batch[[row]])
    angles = [joint_coordinate(joint, start.position, start.native) for joint in hinges]
    return bool(np.max(angles) > np.pi - _NEAR)


def load(key: str) -> Arrays | None:
    """Read an entry; None if it is missing or not as it was written."""
    return read_sealed(_path(key))


def sealed(path: Path, arrays: Arrays) -> bytes:
    """Return the bytes of a file of arrays at a path: npz with a checksum at the end."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)  # type: ignore[arg-type]
    content = stream.getvalue()
    return content + _seal(path, content)


def read_sealed(path: Path) -> Arrays | None:
    """Read a file made by `sealed`; None if it is missing or not as it was written."""
    try:
        whole = path.read_bytes()
    except OSError:
        return None
    content, seal = whole[:-_SEAL], whole[-_SEAL:]
    if seal != _seal(path, content):
        return None
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def _seal(path: Path, content: bytes) -> bytes:
    return hashlib.sha256(f"{path.parent.name}/{path.name}".encode() + content).digest()


def write(key: str, arrays: Arrays) -> None:
    """Write an entry; other processes see all of it or nothing.

    Raises:
        InputError: It cannot be written.
    """
    path = _path(key)
    write_whole(path, sealed(path, arrays))


def store(key: str, arrays: Arrays) -> None:
    """Write the entry of a reference solution, or warn that it is not kept."""
    try:
        write(key, arrays)
    except InputError as error:
        # Without the entry's own path, so that it is shown once.
        cause = getattr(error.__cause__, "strerror", error)
        msg = f"reference solutions are not kept: cannot write to {directory()}: {cause}"
        warnings.warn(msg, Notice, stacklevel=2)


def _path(key: str) -> Path:
    return directory() / "reference" / key[:2] / f"{key[2:]}.npz"
