"""The page on the checks names every check, with its budget."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest

from mbds_xsim.checks import CHECKS
from mbds_xsim.checks import consistency as consistency_module
from mbds_xsim.measure import judge
from mbds_xsim.scene.budget import Budget

PAGE = (Path(__file__).parents[2] / "docs" / "checks.md").read_text("utf-8")


def _anchors(page: str) -> list[str]:
    headings = re.findall(r"^#+ (.*)$", page, flags=re.MULTILINE)
    return [heading.lower().replace(" ", "-") for heading in headings]


@pytest.mark.parametrize("name", [check.name for check in CHECKS])
def test_every_check_has_a_section_and_a_row(name: str) -> None:
    assert f"\n### {name}\n" in PAGE
    assert f"\n| [{name}](#{name.replace(' ', '-')}) |" in PAGE


def test_the_checks_against_others_are_there() -> None:
    consistency = re.findall(r'"(consistency of \w+)"', inspect.getsource(consistency_module))
    errors = re.findall(r'Finding.of\(\s*"(.*?)"', inspect.getsource(judge))
    assert len(consistency) == 2
    assert len(errors) == 3
    for name in (*consistency, *errors, "vote", "read-back"):
        assert f"\n| [{name}](#" in PAGE


def test_every_budget_is_named_with_its_default() -> None:
    for key in Budget.__struct_fields__:
        rows = [line for line in PAGE.splitlines() if f"`{key}`" in line and line.startswith("| [")]
        assert rows, key
        powers = {float(number) for number in re.findall(r"\d+e-\d+", " ".join(rows))}
        assert getattr(Budget(), key) in powers, key


def test_checks_of_positions_are_listed_for_files_without_velocities() -> None:
    page = (Path(__file__).parents[2] / "docs" / "data-commands.md").read_text("utf-8")
    (listed,) = re.findall(r"^\| states of bodies without velocities \| (.*) \|$", page, re.M)
    names = [check.name for check in CHECKS if check.of_positions]
    assert listed.split(", ") == [*names, "errors against the reference"]


def test_links_within_the_page_lead_somewhere() -> None:
    links = set(re.findall(r"\]\(#([^)]*)\)", PAGE))
    assert links <= set(_anchors(PAGE))


def test_links_to_other_pages_lead_somewhere() -> None:
    for target in set(re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", PAGE)):
        assert (Path(__file__).parents[2] / "docs" / target).exists(), target
