"""XML that programs and people read: numbers with every digit, elements a line each."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree import ElementTree


def numbers(values: Iterable[float]) -> str:
    """Write numbers with every digit and blanks between them."""
    return " ".join(repr(float(value)) for value in values)


def indented(root: ElementTree.Element) -> str:
    """Indent and write."""
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"
