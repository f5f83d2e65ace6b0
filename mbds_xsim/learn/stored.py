"""Files of `torch.save`, read without trust: no code of theirs runs, nothing is made of a size that
they only name.

`torch.load(weights_only=True)` runs no code, but makes what a file asks for (`bytearray(10**11)` in
20 bytes), takes the stated sizes of arrays for true, and unpacks what is packed. So the archive is
looked at first: entries as they are in the file, of the checksums that it states, and a pickle that
names nothing but arrays and dictionaries. Arrays are then mapped, not made, and copied once their
shapes are known to lie within the file.
"""

from __future__ import annotations

import pickletools
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mbds_xsim.errors import InputError

__all__ = ["array", "arrays", "read_stored"]

_LONGEST = 1 << 24  # of the pickle, which holds names and shapes [bytes]
_PROTOCOL = 2
_NAMED = {
    "torch._utils _rebuild_tensor_v2",
    "collections OrderedDict",
    *(f"torch {kind}Storage" for kind in ("Float", "Double", "BFloat16", "Long", "Byte", "Bool")),
}
"""All that a file of this project names: functions, and the types of arrays."""


def read_stored(path: Path, what: str, remedy: str) -> dict[str, Any]:
    """Read a file of `torch.save`; its arrays still lie in the file: copy them by `array`.

    Args:
        path: File to read.
        what: It should be: "trained model".
        remedy: What else is to be done.

    Raises:
        InputError: It cannot be read, is damaged, or is no such file.
    """
    try:
        _check_archive(path)
        whole = torch.load(path, weights_only=True, map_location="cpu", mmap=True)
    except OSError as error:
        msg = f"{path}: no {what} can be read ({error.strerror or error})"
        raise InputError(msg) from error
    except Exception as error:  # whatever a file makes torch say, it tells a user nothing
        msg = f"{path}: no {what}, or a damaged one; {remedy}"
        raise InputError(msg) from error
    if not isinstance(whole, dict):
        msg = f"{path}: no {what}, or a damaged one; {remedy}"
        raise InputError(msg)
    return whole


def array(value: object) -> Tensor:
    """Copy an array out of a file.

    Raises:
        ValueError: It is none, or has more numbers than the file has for it.
    """
    if type(value) is not Tensor or value.layout is not torch.strided or value.device.type != "cpu":
        msg = f"got {type(value).__name__}, allowed is an array"
        raise ValueError(msg)
    if value.numel() * value.element_size() > value.untyped_storage().nbytes():
        msg = f"got an array of shape {tuple(value.shape)} whose numbers are not all in the file"
        raise ValueError(msg)
    return value.clone()


def arrays(value: object) -> dict[str, Tensor]:
    """Copy arrays by name out of a file.

    Raises:
        ValueError: They are none.
    """
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        msg = f"got {type(value).__name__}, allowed are arrays by name"
        raise ValueError(msg)
    return {key: array(item) for key, item in value.items()}


def _check_archive(path: Path) -> None:
    """Raise unless the file holds what it says, and says nothing that makes more of it."""
    if path.exists() and not path.is_file():  # a pipe would be waited for
        msg = "not a regular file"
        raise OSError(msg)
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        names = [entry.filename for entry in entries]
        pickles = [name for name in names if name.endswith("/data.pkl")]
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise ValueError("packed")
        if len(set(names)) < len(names) or len(pickles) != 1:
            raise ValueError("ambiguous")
        if archive.getinfo(pickles[0]).file_size > _LONGEST:
            raise ValueError("too long")
        if archive.testzip() is not None:
            raise ValueError("checksum")
        _check_names(archive.read(pickles[0]))


def _check_names(content: bytes) -> None:
    for opcode, argument, _ in pickletools.genops(content):
        if opcode.name == "PROTO" and argument != _PROTOCOL:  # torch warns of others
            msg = f"protocol {argument}"
            raise ValueError(msg)
        imports = opcode.name in ("GLOBAL", "STACK_GLOBAL", "INST", "EXT1", "EXT2", "EXT4")
        if imports and argument not in _NAMED:
            msg = f"names {argument}"
            raise ValueError(msg)
