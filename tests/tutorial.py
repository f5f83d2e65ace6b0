"""Walk through a page of the docs as its reader does: write its files, run what it says."""

from __future__ import annotations

import doctest
import re
import shlex
from pathlib import Path

from mbds_xsim import __main__ as cli

__all__ = ["PAGES", "walk"]

PAGES = Path(__file__).parents[1] / "docs" / "tutorials"
_BLOCK = re.compile(r"^(?:`([\w.-]+)`:\n\n)?```(toml|xml|sh|python)\n(.*?)^```$", re.M | re.S)
_FAILS = "# exit code 1"


def walk(page: str) -> None:
    """Do all that a tutorial says, in order, in the current folder."""
    names: dict[str, object] = {}
    blocks = _BLOCK.findall((PAGES / page).read_text("utf-8"))
    assert blocks
    for name, kind, text in blocks:
        if kind in ("toml", "xml"):
            Path(name).write_text(text, "utf-8")
        elif kind == "sh":
            for line in text.splitlines():
                words = shlex.split(line, comments=True)
                assert cli._run(words[1:]) == line.endswith(_FAILS), line
        else:
            _run_examples(text, names, page)


def _run_examples(text: str, names: dict[str, object], page: str) -> None:
    test = doctest.DocTestParser().get_doctest(text, names, page, page, 0)
    output: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    ended = runner.run(test, out=output.append, clear_globs=False)
    assert ended.attempted
    assert not ended.failed, "".join(output)
    names |= test.globs
