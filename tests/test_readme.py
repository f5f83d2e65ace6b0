"""README and the page of reports state the stored results, and their links exist."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from PIL import Image

from benchmarks.page_picture import settings_line
from benchmarks.pictures import picture_of, stored_results, sweep_of
from mbds_xsim.base.files import read_file
from mbds_xsim.report.files import rows_csv, to_markdown
from mbds_xsim.report.themed import SOURCE, checksum
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.studies.stability import MapCell
from mbds_xsim.studies.stability.present import present
from mbds_xsim.studies.stability.studies import STUDIES

_ROOT = Path(__file__).parents[1]
_LINK = re.compile(r"\]\(([^)#]+)")
_PICTURE = re.compile(r"!\[[^\]]*\]\(([^)]+)\)")
_TABLE = re.compile(r"<!-- choose-table: begin -->\n(.*)<!-- choose-table: end -->", re.DOTALL)


def _printed(script: str, *words: str) -> str:
    command = [sys.executable, "-m", f"benchmarks.{script}", *words]
    return subprocess.run(command, cwd=_ROOT, check=True, capture_output=True, text=True).stdout


def test_the_table_of_readme_is_that_of_the_reports() -> None:
    (table,) = _TABLE.findall((_ROOT / "README.md").read_text("utf-8"))

    assert table.strip() == _printed("choose_table", "reports/tradeoff").strip(), "make readme"


@pytest.mark.parametrize(
    ("page", "script"),
    {
        "README.md": "reports_page reports",
        "margins.md": "margins reports",
        "paper-tables.md": "paper_tables reports/shift reports/lite",
        "shift/README.md": "shift_summary reports/shift",
    }.items(),
)
def test_a_page_says_what_the_stored_results_say(page: str, script: str) -> None:
    text = (_ROOT / "reports" / page).read_text("utf-8")

    assert text == _printed(*script.split()), f"python -m benchmarks.{script} > reports/{page}"


def test_all_scenes_and_studies_are_reported() -> None:
    command = ["make", "-n", "reports-tradeoff", "reports-stability"]
    commands = subprocess.run(command, cwd=_ROOT, check=True, capture_output=True, text=True).stdout
    (scenes,) = re.findall(r"for scene in (.+);", commands)
    (studies,) = re.findall(r"for study in (.+);", commands)

    assert studies.split() == list(STUDIES)
    assert {f"{scene}.md" for scene in scenes.split()} == {
        page.name for page in (_ROOT / "reports").glob("*.md") if page.with_suffix(".json").exists()
    }


@pytest.mark.parametrize("page", ["README.md", "reports/README.md"])
def test_links_lead_somewhere(page: str) -> None:
    path = _ROOT / page
    targets = [t for t in _LINK.findall(path.read_text("utf-8")) if "://" not in t]

    assert targets
    assert [target for target in targets if not (path.parent / target).exists()] == []


def test_what_is_cited_is_what_is_built() -> None:
    version = tomllib.loads((_ROOT / "pyproject.toml").read_text())["project"]["version"]

    assert f"\nversion: {version}\n" in (_ROOT / "CITATION.cff").read_text("utf-8")
    assert f"\n## {version}\n" in (_ROOT / "CHANGELOG.md").read_text("utf-8")


def _told(picture: Path) -> str:
    with Image.open(picture) as image:
        return str(image.info.get(SOURCE, ""))


def test_charts_and_maps_are_those_of_the_stored_results() -> None:
    stored = list(stored_results(_ROOT / "reports"))
    stale = [
        str(result) for result in stored if _told(picture_of(result)) != checksum(read_file(result))
    ]

    assert len(stored) > 30
    assert stale == [], "make pictures"


def test_the_picture_of_all_scenes_is_of_the_page(tmp_path: Path) -> None:
    words = ("shift_summary", "reports/shift", "--png")
    _printed(*words, str(tmp_path / "factors.png"))
    folder = _ROOT / "reports/shift"
    sources = {_told(path / "factors.png") for path in (folder, tmp_path)}

    wanted = f"python -m benchmarks.{' '.join(words)} reports/shift/factors.png"
    page = folder / "README.md"
    assert sources == {checksum(page.read_bytes())}, f"{wanted} > reports/shift/README.md"


def test_the_pictures_of_pages_show_what_is_stored() -> None:
    """Pictures of trainings, rollouts, contact and costs are exempt: their data are not stored."""
    kept = {picture_of(result) for result in stored_results(_ROOT / "reports")}
    pages = [_ROOT / "README.md", *(_ROOT / "docs").glob("*.md")]
    shown = {
        (page.parent / picture).resolve()
        for page in pages
        for picture in _PICTURE.findall(page.read_text("utf-8"))
    }
    rest = {picture.name for picture in shown - {picture.resolve() for picture in kept}}

    assert len(shown & {picture.resolve() for picture in kept}) > 4
    assert rest == {
        "6pendulum-curves.png",
        "ant-on-the-ground.png",
        "contact-friction.png",
        "contact-restitution.png",
        "factors.png",
        "growth-of-cost.png",
        "validate-3ladder.png",
    }


def test_the_first_picture_is_of_the_settings_in_use() -> None:
    scene = load_scene("3ladder")
    contenders, _ = Choice.parse(engines="dart,exudyn,mujoco,pybullet").contenders(scene)
    now = [
        settings_line(each.engine, each.settings.method, each.settings.step, each.settings.options)
        for each in contenders
    ]

    assert _told(_ROOT / "docs/images/validate-3ladder.png").splitlines() == now, "make readme"


@pytest.mark.parametrize("study", STUDIES)
def test_the_page_of_a_map_says_what_its_cells_say(study: str) -> None:
    """Lines about left-out engines and how the map was made are exempt: cells do not know them."""
    base = _ROOT / "reports" / "stability" / study
    table = base.with_suffix(".csv").read_text("utf-8")
    sweep = sweep_of(table)

    fresh, stored = to_markdown([present(sweep)]), base.with_suffix(".md").read_text("utf-8")

    assert rows_csv(MapCell, sweep.cells, "silent").decode() == table
    assert _of_cells(fresh) == _of_cells(stored), f"mbds-xsim stability {study}"


def _of_cells(page: str) -> list[str]:
    apart = ("Made by", " left out: ", "o reference at")
    return [line for line in page.splitlines() if not any(words in line for words in apart)]
