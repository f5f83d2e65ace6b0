"""Page that lists all stored reports: a one-sentence summary of each, and how it was made.

python -m benchmarks.reports_page reports > reports/README.md
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from benchmarks.harness import print_table

CHAPTERS = (
    ("Validation", "make reports-validate", "[0-9a-z]*.md"),
    ("How near the budgets", "make reports-pages", "margins.md"),
    ("Speed against accuracy", "make reports-tradeoff", "tradeoff/*.md"),
    ("Where methods fail", "make reports-stability", "stability/*.md"),
    ("Where models fail, and at what price", "make reports-models", "models/*.md"),
    ("What published models lose", "make reports-models-in-the-wild", "wild/models.md"),
    ("No more than a scene needs", "make reports-ablation", "ablation.md"),
    ("Data sets", "make reports-data reports-data-full", "data.md"),
    ("Release by release", "make reports-releases", "releases.md"),
    ("What the adapters cost", "make reports-overhead", "adapter-overhead.md"),
    ("Models under a change of engine", "make reports-shift", "shift/*.md"),
    ("Models trained until level", "make reports-lite", "lite/*.md"),
    ("The paper's tables", "make reports-paper-tables", "paper-tables.md"),
    ("What energies are given", "make reports-models", "energy-rollouts.md"),
    ("Speed of learned models", "make reports-learn-speed", "learn-speed.md"),
    ("On a GPU", "make reports-learn-speed-gpu", "learn-speed-gpu.md"),
)
_COMMAND = re.compile(r"(?:Made by `|Written by: )(.+?)(?:`| -->)")
# Output files are dropped from commands: they are linked next to the report.
_WRITES = re.compile(r" (?:--(?:json|csv|png|rollouts|markdown)|>) \S+")
_SENTENCE = re.compile(r".+?\.(?=\s|$)")
_SHORT = 260  # characters
_NO_PROSE = ("#", "|", "-", "<", "!")
_DATA = (".png", ".csv", ".json", ".json.gz")

_HEAD = """\
# Reports

Results of runs that take too long for a test, each with the command that made it. `make reports`
makes most of them again, in a day or two on a quiet machine; releases, published models and
training on a GPU have targets of their own, and so has each other chapter. To see what differs
between a new result and a stored one, use [`mbds-xsim diff`](../docs/diff.md).
"""


def main(folder: Path) -> None:
    print(_HEAD)
    for heading, target, pattern in CHAPTERS:
        others = {"README.md", *(other for _, _, other in CHAPTERS if other != pattern)}
        pages = {*folder.glob(pattern)} - {folder / other for other in others}
        if pages:
            print(f"## {heading}\n\n`{target}`\n")
            rows = (row(page, folder) for page in sorted(pages, key=_place))
            print_table("report|in short|data|command", rows)
            print()


def row(page: Path, folder: Path) -> list[str]:
    """Return a table row: the page's summary, files next to it, and the command that made it."""
    text = page.read_text("utf-8")
    match = _COMMAND.search(text)
    return [
        link("in short" if page.stem == "README" else page.stem, page, folder),
        lead(text).replace("|", "\\|"),
        ", ".join(link(file.suffixes[0][1:], file, folder) for file in beside(page)),
        f"`{_WRITES.sub('', match[1])}`" if match else "",
    ]


def _place(page: Path) -> tuple[bool, Path]:
    """Return a sort key that puts the summary of a folder first."""
    return page.stem != "README", page


def link(name: str, file: Path, folder: Path) -> str:
    return f"[{name}]({file.relative_to(folder).as_posix()})"


def beside(page: Path) -> list[Path]:
    """Return files of other kinds with the same name."""
    return [file for kind in _DATA if (file := page.with_suffix(kind)).is_file()]


def lead(text: str) -> str:
    """Return the first sentence of prose, and the second if both are short."""
    paragraphs = (part.strip() for part in text.split("\n\n"))
    prose = (part for part in paragraphs if part and not part.startswith(_NO_PROSE))
    first = " ".join(next(prose, "").split())
    sentences = [sentence.strip() for sentence in _SENTENCE.findall(first)]
    both = " ".join(sentences[:2])
    summary = both if len(both) <= _SHORT else sentences[0]
    return f"{summary[:1].upper()}{summary[1:]}"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
