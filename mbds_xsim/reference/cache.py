"""Results kept on disk by content, so that a reference solution is computed once.

Entries stand in the user's cache directory, or where MBDS_XSIM_CACHE says. Their names are
hashes of everything that decides the result, the version of the physics among it. They are never
changed, only replaced whole. Each ends in a checksum of its name and content: one that was damaged,
changed or put under another name is computed again.
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

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import write_whole
from mbds_xsim.base.versions import PHYSICS
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch

Arrays = dict[str, NDArray[Any]]

_PHYSICS = (
    "bodies", "joints", "distance_links", "springs", "gravity", "contacts", "ground", "length",
    "dimension",
)  # fmt: skip
_GEARS = 2
"""Version of scenes with gears alone: before, a gear beside a fixed joint could be left out."""
_BRAKES, _LANDING = 3, 4
"""Of those with dry friction or stops: before, a rest at a stop with friction could be given up,
and with contact there was no solution."""
_SOURCES = ("compiling", "lanes", "traced", "lane_algebra", "noted", "elimination", "tree")
_SEAL = hashlib.sha256().digest_size


def complete(
    what: str,
    scene: Scene,
    batch: Batch,
    rtol: float,
    compute: Callable[[list[int]], list[Arrays]],
    *,
    keep: bool,
    together: int,
) -> Iterator[tuple[int, Arrays]]:
    """Give each row of a batch and its entry, computing and keeping those that are not there.

    One at a time, so that a batch of any size needs no more memory than what is made of it.

    Args:
        what: Kind of result.
        scene: What is simulated.
        batch: Starts and inputs.
        rtol: Tolerance of the result.
        compute: Makes the entries of some rows of the batch.
        keep: Whether the disk is read and written at all.
        together: Largest number of rows computed at once.
    """
    keys = [key_of(what, scene, batch, row, rtol) for row in range(len(batch))] if keep else []
    found = set()
    for row, key in enumerate(keys):
        entry = load(key)
        if entry is not None:
            found.add(row)
            yield row, entry
    missing = [row for row in range(len(batch)) if row not in found]
    for first in range(0, len(missing), together):
        rows = missing[first : first + together]
        for row, entry in zip(rows, compute(rows), strict=True):
            if keep:
                store(keys[row], entry)
            yield row, entry


def directory() -> Path:
    """Where entries stand."""
    chosen = os.environ.get("MBDS_XSIM_CACHE")
    return Path(chosen) if chosen else _home()


def _home() -> Path:
    """The program's part of the user's cache directory."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "mbds-xsim"


@functools.cache
def kernel_folder() -> Path:
    """Where machine code is kept: numba looks at a file's path and time, and not at what it calls.

    The folder's own time is that of its last use.
    """
    here = Path(__file__)
    sources = [here.with_name(f"{name}.py") for name in _SOURCES]
    sources += sorted(here.parents[1].glob("*/*_kernel.py"))
    text = b"".join(path.read_bytes() for path in sources)
    text += str(Path(__file__).parent).encode()
    folder = _home() / "kernels" / hashlib.sha256(text).hexdigest()[:16]
    with suppress(OSError):  # it is not there yet, or is another's
        os.utime(folder)
    return folder


def key_of(what: str, scene: Scene, batch: Batch, row: int, rtol: float) -> str:
    """Name of the entry of one trajectory: a hash of the physics, the start and the inputs."""
    digest = hashlib.sha256()
    physics = [getattr(scene, key) for key in _PHYSICS]
    physics += [scene.servos] if scene.servos else []
    physics += [_GEARS, scene.couplings] if scene.couplings else []
    braked = any(joint.friction or joint.limits for joint in scene.joints)
    physics += [_LANDING if scene.contacts else _BRAKES] if braked else []
    physics += [scene.collisions] if scene.collisions else []
    # Scenes made in Python may hold numpy's numbers.
    digest.update(
        msgspec.json.encode([what, PHYSICS, rtol, scene.clock.frame, physics], enc_hook=float)
    )
    for key in ("position", "orientation", "velocity", "angular_velocity", "force", "torque"):
        array = np.ascontiguousarray(getattr(batch, key)[row])
        digest.update(repr(array.shape).encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def load(key: str) -> Arrays | None:
    """Read an entry; None where there is none that is as it was written."""
    return read_sealed(_path(key))


def sealed(path: Path, arrays: Arrays) -> bytes:
    """Give the bytes of a file of arrays at a path, as npz with a checksum at the end."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)  # type: ignore[arg-type]
    content = stream.getvalue()
    return content + _seal(path, content)


def read_sealed(path: Path) -> Arrays | None:
    """Read what `sealed` gave; None where the path has no such file as it was written."""
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


def store(key: str, arrays: Arrays) -> None:
    """Write an entry; other processes see all of it or nothing."""
    path = _path(key)
    try:
        write_whole(path, sealed(path, arrays))
    except InputError as error:
        warnings.warn(f"reference solutions are not kept: {error}", stacklevel=2)


def _path(key: str) -> Path:
    return directory() / "reference" / key[:2] / f"{key[2:]}.npz"
