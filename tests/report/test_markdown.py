"""A validation written as Markdown."""

from __future__ import annotations

from pathlib import Path

from mbds_xsim.report.files import link, to_markdown
from mbds_xsim.studies.validate.present import present

from .conftest import Case


def test_every_row_has_every_column(case: Case) -> None:
    rows = [
        line
        for line in to_markdown([present(case.validation)]).splitlines()
        if line.startswith("|")
    ]
    assert len(rows) == 2 + len(case.validation.engines)
    assert len({row.count("|") for row in rows}) == 1
    for row, result in zip(rows[2:], case.validation.engines, strict=True):
        assert row.startswith(f"| {result.engine} | {result.profile} | {result.method} |")
        assert row.endswith(f"| {result.verdict} |")


def test_failures_and_the_command_are_told(case: Case) -> None:
    text = to_markdown([present(case.validation)])
    for result in case.validation.engines:
        for reason in result.reasons:
            assert reason in text
    assert case.validation.command in text


def test_a_picture_is_linked_whatever_its_name_is() -> None:
    assert link(Path("my pictures/a (2).png"), Path("a.md")) == "my%20pictures/a%20%282%29.png"
    assert link(Path("a.png"), Path("pages/a.md")) == "../a.png"
