"""XML of a model's files as written, before a compiler drops what it ignores.

Nothing is resolved here. The elements are read for the report on losses, and anything that no
compiler should be given is refused: documents that define entities or nest without end, files that
include each other, and paths that leave the model's folder.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import read_file

_LARGEST_FILE = 16 * 10**6  # bytes
_DEEPEST = 400  # levels; the compiler accepts 500
_MOST_FILES = 1000
_MACRO = re.compile(r"\$[{(]")
DEFAULT = re.compile(r"\$\(optenv\s+\S+\s+([^()$]*)\)")
"""Macro of xacro for an environment variable with a default, which needs no expansion."""
_FOLDERS = ("meshdir", "texturedir", "assetdir")


def read_source(path: Path, folder: Path) -> Element:
    """Read a model's XML, with the elements of included files in place of the includes.

    Args:
        path: Path of the main file.
        folder: Folder that all files must be in.

    Raises:
        InputError: Something cannot be read or is not allowed.
    """
    reader = _Reader(path.parent, folder.resolve())
    root = reader.document(path, ())
    _refuse_macros(root)
    if root.tag == "mujoco":  # files that other formats name are not read
        reader.check_files(root)
    return root


class _Reader:
    def __init__(self, base: Path, folder: Path) -> None:
        self._base, self._folder, self._read = base, folder, 0

    def document(self, path: Path, above: tuple[Path, ...]) -> Element:
        """Read a file and everything it includes."""
        if path in above:
            raise InputError(f"{path.name} includes itself, by way of {above[-1].name}")
        self._read += 1
        if self._read > _MOST_FILES:
            raise InputError(f"includes more than {_MOST_FILES} files")
        root = _parse(path)
        for element in list(root.iter()):
            for k, child in reversed(list(enumerate(element))):
                if child.tag == "include" and root.tag not in ("robot", "sdf"):
                    element[k : k + 1] = list(self._include(child, path, above))
                elif child.tag == "model" and "file" in child.attrib:
                    child.extend(self._include(child, path, above))
        return root

    def _include(self, include: Element, path: Path, above: tuple[Path, ...]) -> Element:
        name = include.get("file", "")
        places = [self._base / name, path.parent / name]
        file = next((place for place in places if place.is_file()), None)
        if file is None:
            raise InputError(f"{path.name} includes {name!r}, which is not there")
        check_inside(file, self._folder, f"names {name!r}")
        return self.document(file, (*above, path))

    def check_files(self, root: Element) -> None:
        """Raise InputError if an element names a file outside the folder."""
        compilers = list(root.iter("compiler"))
        folders = {compiler.get(key, "") for compiler in compilers for key in _FOLDERS} | {""}
        for element in root.iter():
            for key, name in element.attrib.items():
                if key.startswith("file") and name:
                    for folder in folders:
                        text = f"names {str(Path(folder) / name)!r}"
                        check_inside(self._base / folder / name, self._folder, text)


def check_inside(path: Path, folder: Path, text: str) -> None:
    """Raise InputError, with what the model says of it, if a path leads out of the folder."""
    if not path.resolve().is_relative_to(folder):
        raise InputError(
            f"{text}, which is not in {folder}; if that is intended, "
            "give `mbds-xsim import` a --folder with all files of the model"
        )


def _parse(path: Path) -> Element:
    try:
        content = read_file(path, _LARGEST_FILE + 1).strip(b"\0 \t\r\n")
    except OSError as error:
        raise InputError(f"{path.name} cannot be read ({error.strerror})") from error
    if len(content) > _LARGEST_FILE:
        msg = f"{path.name} is larger than {_LARGEST_FILE // 10**6} MB, which no model's XML needs"
        raise InputError(msg)
    builder, depth = TreeBuilder(), 0
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _DEEPEST:
            raise InputError(f"{path.name} nests elements deeper than {_DEEPEST} levels")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def refuse(*_: object) -> None:
        msg = f"{path.name} defines entities, which may expand without end; write them out"
        raise InputError(msg)

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.EntityDeclHandler, parser.CharacterDataHandler = refuse, builder.data
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, ValueError) as error:
        raise InputError(f"{path.name} is not XML: {error}") from error
    return builder.close()


def _refuse_macros(root: Element) -> None:
    for element in root.iter():
        plain = DEFAULT.sub("", "".join(element.attrib.values()))
        if element.tag.startswith("xacro:") or _MACRO.search(plain):
            msg = f"<{element.tag}> is a macro; expand it first: xacro model.xacro > model.urdf"
            raise InputError(msg)
