"""The pages about engines match the code."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import msgspec
import pytest

from mbds_xsim.report.catalogue import engine_rows, engines_page
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.claims import Feature

DOCS = Path(__file__).parent.parent / "docs"


def test_the_table_of_engines_is_what_the_adapters_claim() -> None:
    missing = set(registry.engine_names()) - set(registry.installed_engines())
    if missing and not missing & set(os.environ.get("MBDS_XSIM_MUST_RUN", "").split(",")):
        pytest.skip(f"not installed: {', '.join(sorted(missing))}")

    page = engines_page(engine_rows())

    stale = "docs/engines.md is stale; run: mbds-xsim engines --markdown > docs/engines.md"
    assert (DOCS / "engines.md").read_text("utf-8") == page, stale


def test_what_the_only_method_refuses_the_engine_cannot_do() -> None:
    row = next(row for row in engine_rows() if row.engine == "mujoco")
    one = msgspec.structs.replace(row, methods=row.methods[:1])
    name = Feature.JOINT_REBOUND.value

    cells = re.search(rf"^\| {name} \| (\w+)\S* \| (\w+)", engines_page([row, one]), re.M)

    assert cells
    assert cells.groups() == ("some", "no")


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Take the files off the page, and install them as far as entry points go."""
    folder = tmp_path_factory.mktemp("plain")
    page = (DOCS / "add-an-engine.md").read_text("utf-8")
    for name, text in re.findall(r"^`([\w.]+)`:\n\n```\w+\n(.*?)^```$", page, re.M | re.S):
        (folder / name).write_text(text, "utf-8")
    project = tomllib.loads((folder / "pyproject.toml").read_text("utf-8"))["project"]
    metadata = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\n")
    lines = [
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in points.items())
        for group, points in project["entry-points"].items()
    ]
    (metadata / "entry_points.txt").write_text("\n".join(lines))
    return folder


def _run(package: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *words],
        cwd=package,
        env=os.environ | {"PYTHONPATH": str(package), "MBDS_XSIM_CACHE": str(package / "cache")},
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_tree_of_the_page_is_as_printed_there(package: Path) -> None:
    done = _run(package, "tree.py")

    (expected,) = re.findall(
        r"^It prints\n\n```text\n(.*?)^```$", (DOCS / "add-an-engine.md").read_text(), re.M | re.S
    )
    assert (done.stdout, done.stderr) == (expected, "")


@pytest.mark.slow
def test_the_engine_of_the_page_passes_the_contract_suite(package: Path) -> None:
    done = _run(package, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_plain.py")

    assert done.returncode == 0, done.stdout
    passed = re.search(r"^(\d+) passed(, \d+ skipped)? in", done.stdout, re.M)
    assert passed
    assert int(passed[1]) > 25


@pytest.mark.slow
def test_the_engine_of_the_page_is_validated_beside_mujoco(package: Path) -> None:
    program = "from mbds_xsim.__main__ import main; main()"

    words = ["validate", "1pendulum", "--engines", "plain,mujoco", "--json", "v.json"]
    words += ["--step", "0.01"]
    done = _run(package, "-c", program, *words)

    result = json.loads((package / "v.json").read_text())
    row, beside = result["engines"]
    # A slow machine reports its progress.
    assert [line for line in done.stderr.splitlines() if " left " not in line] == []
    assert (row["engine"], row["version"], row["failures"]) == ("plain", "1.0", [])
    assert row["error_1s_m"] < 1e-6
    assert beside["engine"] == "mujoco"
    assert "read-back" not in done.stdout


@pytest.mark.slow
def test_the_engine_of_the_page_makes_data(package: Path) -> None:
    program = "from mbds_xsim.__main__ import main; main()"
    words = ["--engines", "plain", "--settings", "native", "--trajectories", "6", "--out", "data"]

    made = _run(package, "-c", program, "generate", "1pendulum", *words)
    verified = _run(package, "-c", program, "verify", "data")

    assert (made.returncode, verified.returncode) == (0, 0), made.stderr + verified.stderr
    assert "6 trajectories checked: everything holds what it says" in verified.stdout
