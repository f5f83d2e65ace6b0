"""XML for programs and people: numbers with every digit, one line per element."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree import ElementTree


def numbers(values: Iterable[float]) -> str:
    """Write numbers with every digit, separated by spaces."""
    return " ".join(repr(float(value)) for value in values)


def indented(root: ElementTree.Element) -> str:
    """Indent an element in place and return it as text."""
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"
