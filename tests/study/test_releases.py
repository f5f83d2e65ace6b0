"""Releases of an engine: installed, driven, compared. The engine is made here, in four releases."""

from __future__ import annotations

import gzip
import re
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import Conduct
from mbds_xsim.report.files import to_html, to_markdown
from mbds_xsim.simulate.registry import PAPER_SCENES, load_adapter
from mbds_xsim.studies import releases
from mbds_xsim.studies.releases import ReleaseStudy, environments
from mbds_xsim.studies.releases.environments import install, releases_of
from mbds_xsim.studies.releases.present import present, to_png
from mbds_xsim.studies.releases.steps import (
    History,
    Release,
    ReleaseRow,
    Step,
    known_of,
    steps_of,
)
from mbds_xsim.testing import CASES
from tests import plugins
from tests.command_line import CommandLine

# The toy engine is MuJoCo with a share of its gravity: 2.0 has it wrong, 1.1 does not load, and 1.2
# is an empty wheel.
_ADAPTER = """
import msgspec
from mbds_xsim.simulate.claims import Feature
from mbds_xsim_adapters.mujoco import MuJoCo

_CAN = {Feature.FREE_BODY, Feature.FORCE, Feature.FULL_INERTIA}

class Toy(MuJoCo):
    name = package = "toyengine"
    limits = {feature: "the engine is a toy" for feature in Feature if feature not in _CAN}

    def version(self):
        import toyengine
        return toyengine.VERSION

    def load(self, scene, settings):
        import toyengine
        gravity = tuple(toyengine.SHARE * part for part in scene.gravity)
        return super().load(msgspec.structs.replace(scene, gravity=gravity), settings)
"""
_RELEASES = {
    "1.0": "SHARE = 1.0",
    "1.1": "raise ImportError('libtoy.so: no such file')",
    "1.2": "",
    "2.0": "SHARE = 9.80 / 9.81",
}


def _wheel(folder: Path, version: str, source: str) -> None:
    """Pack a module for pip; without a source the wheel is empty and cannot be installed."""
    folder.mkdir(exist_ok=True)
    info, module = f"toyengine-{version}.dist-info", f"VERSION = {version!r}\n{source}\n"
    facts = f"Metadata-Version: 2.1\nName: toyengine\nVersion: {version}\n"
    with zipfile.ZipFile(folder / f"toyengine-{version}-py3-none-any.whl", "w") as wheel:
        if source:
            wheel.writestr("toyengine.py", module)
            wheel.writestr(f"{info}/METADATA", facts)
            wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\n")
            wheel.writestr(f"{info}/RECORD", "")


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Make an index with the releases; pip asks no other, and the cache is its own."""
    folder = tmp_path_factory.mktemp("releases")
    for version, source in _RELEASES.items():
        _wheel(folder / "index", version, source)
    modules = {"toy_adapter": _ADAPTER, "toyengine": "VERSION = 'not a release'\nSHARE = 0.0\n"}
    places = {"toyengine": "toy_adapter:Toy"}
    with (
        pytest.MonkeyPatch.context() as patch,
        plugins.installed(folder / "toy", modules, places),
    ):
        patch.setenv("PIP_NO_INDEX", "1")
        patch.setenv("PIP_FIND_LINKS", str(folder / "index"))
        patch.setenv("MBDS_XSIM_CACHE", str(folder / "cache"))
        yield folder


@pytest.fixture(scope="module")
def toy_history(toys: Path) -> History:
    del toys
    return ReleaseStudy("toyengine", scenes=()).history(command="the command")


def test_each_release_runs_in_its_own_packages(toy_history: History) -> None:
    whole, wrong = (toy_history.by_release("free fall, RK4")[v] for v in ("1.0", "2.0"))

    assert toy_history.driven == ["1.0", "2.0"]
    assert whole.error_m == pytest.approx(0.0, abs=1e-9)
    assert wrong.error_m == pytest.approx(0.5 * 0.01 * 1.0**2, rel=1e-6)  # 0.01 m/s² for 1 s


def test_what_a_release_made_worse_is_a_step(toy_history: History) -> None:
    (step,) = [step for step in toy_history.steps if step.what == "error"]

    assert (step.release, step.before, step.name) == ("2.0", "1.0", "free fall, RK4")
    assert (step.course, step.explanation) == ("worse", "")
    assert toy_history.regressions == [step]
    assert toy_history.verdict == "fail"


def test_why_a_release_is_not_driven_is_said(toy_history: History) -> None:
    reasons = {release.version: release.reason for release in toy_history.releases}

    assert "libtoy.so: no such file" in reasons["1.1"]
    assert "invalid wheel" in reasons["1.2"]
    assert (reasons["1.0"], reasons["2.0"]) == ("", "")


def test_what_was_measured_is_not_measured_again(toys: Path, toy_history: History) -> None:
    kept = toys / "cache" / "releases" / "toyengine.jsonl"
    before = kept.read_bytes()

    again = ReleaseStudy("toyengine", scenes=()).history("1.1")

    assert kept.read_bytes() == before
    assert again.rows == tuple(row for row in toy_history.rows if row.release == "2.0")


@pytest.mark.usefixtures("toys")
def test_only_the_newest_or_those_since_one_are_listed() -> None:
    assert releases_of("toyengine") == list(_RELEASES)
    assert releases_of("toyengine", "1.2") == releases_of("toyengine", "1.2.0") == ["1.2", "2.0"]
    assert releases_of("toyengine", "1.0", 1) == ["2.0"]
    with pytest.raises(InputError, match=r"got 3\.0, the index has toyengine 1\.0 to 2\.0"):
        releases_of("toyengine", "3.0")


def test_another_release_than_the_folders_is_refused(toys: Path) -> None:
    place = install("toyengine", "1.0")
    assert isinstance(place, Path)
    study = ReleaseStudy("toyengine", scenes=())
    (toys / "cache" / "releases" / "toyengine-9.9").symlink_to(place)
    missing = study._release("9.9")

    assert isinstance(missing, str)
    assert "what runs is toyengine 1.0" in missing


@pytest.mark.usefixtures("toys")
def test_the_command_ends_with_1_where_the_newest_release_is_worse(run: CommandLine) -> None:
    ended = run("releases", "toyengine", "--json", "-")

    assert ended.code == 1, ended.err
    assert msgspec.json.decode(ended.out)["schema"] == "mbds-xsim/releases/1"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["toyengin"], "toyengine"),
        (["toyengine", "--since", "7"], "--since: got 7"),
        (["toyengine", "--since", "latest"], "--since: got latest"),
        (["toyengine", "toyengine", "--since", "7"], "--since: got 7"),
        (["toyengine", "mujoco", "--since", "1.0"], "name one ENGINE"),
    ],
)
@pytest.mark.usefixtures("toys")
def test_a_slip_is_one_line(run: CommandLine, words: list[str], told: str) -> None:
    assert told in run("releases", *words).refusal


def test_what_could_not_be_installed_is_tried_again_where_that_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path))
    monkeypatch.setattr(environments, "_install", lambda *_: "no network")
    assert install("toyengine", "1.0") == "no network"
    monkeypatch.setattr(environments, "_install", lambda *_: "")
    assert install("toyengine", "1.0") == "no network"
    place = install("toyengine", "1.0", fresh=True)
    assert place == install("toyengine", "1.0") == tmp_path / "releases" / "toyengine-1.0"


def test_an_interrupted_installation_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path))
    monkeypatch.setattr(environments, "_install", interrupted)

    with pytest.raises(KeyboardInterrupt):
        install("toyengine", "1.0")

    assert not list((tmp_path / "releases").iterdir())


def test_two_processes_may_install_one_release(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path))

    def overtaken(part: Path, packages: list[str]) -> str:
        del packages
        (part / "late").touch()
        (tmp_path / "releases" / "toyengine-1.0" / "toyengine").mkdir(parents=True)
        return ""

    monkeypatch.setattr(environments, "_install", overtaken)
    place = install("toyengine", "1.0")
    assert place == tmp_path / "releases" / "toyengine-1.0"
    assert [path.name for path in place.iterdir()] == ["toyengine"]
    assert list(place.parent.iterdir()) == [place]


@pytest.mark.usefixtures("toys")
@pytest.mark.parametrize("fresh", [False, True])
def test_the_study_asks_for_it_where_it_measures_again(
    fresh: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(releases, "install", lambda *_, fresh: f"fresh is {fresh}")
    study = ReleaseStudy("toyengine", Conduct(fresh=fresh), scenes=())
    assert study._release("7.0") == f"fresh is {fresh}"


def _row(release: str, name: str = "tumbling, RK4", **figures: Any) -> ReleaseRow:
    case, way = name.split(", ")
    return ReleaseRow(key=f"{release} {name}", release=release, case=case, way=way, **figures)


@pytest.mark.parametrize(
    ("kind", "again"), [("done", 0), ("failed", 0), ("crashed", 1), ("timed out", 1)]
)
def test_a_crash_or_a_delay_is_measured_again(kind: Any, again: int) -> None:
    runner = ReleaseStudy("mujoco", scenes=())._runner
    row = ReleaseRow(key="a", release="1", case="pair", way="RK4", kind=kind)
    runner.store.rows[row.key] = row

    assert len(runner.missing([releases._case(row, releases.climb)])) == again


def _history(*rows: ReleaseRow) -> History:
    versions = tuple(Release(version) for version in dict.fromkeys(row.release for row in rows))
    return History(
        schema="", engine="mujoco", package="mujoco", command="", machine="", versions={},
        measured=0, kept=0, wall_s=0.0, change_log="", releases=versions, rows=rows,
        steps=tuple(steps_of(rows, known_of("mujoco"))),
    )  # fmt: skip


def _step(old: dict[str, Any], new: dict[str, Any]) -> Step | None:
    steps = _history(_row("1", **old), _row("2", **new)).steps
    assert len(steps) <= 1
    return steps[0] if steps else None


@pytest.mark.parametrize(
    ("old", "new", "course"),
    [
        ({"error_m": 1e-3}, {"error_m": 1.9e-3}, None),
        ({"error_m": 1e-3}, {"error_m": 2.1e-3}, "worse"),
        ({"error_m": 1e-3}, {"error_m": 0.4e-3}, "better"),
        ({"error_m": 1e-15}, {"error_m": 5e-10}, None),  # rounding
        ({"order": 2.0}, {"order": 1.6}, None),
        ({"order": 2.0}, {"order": 1.4}, "worse"),
        ({"order": 1.0}, {"order": 2.0}, "better"),
        ({"order": None}, {"order": 1.0}, None),  # met to rounding before
        ({"restitution": 0.93}, {"restitution": 0.94}, None),
        ({"restitution": 0.93}, {"restitution": 0.5}, "worse"),
        ({"gap_m": 1e-4}, {"gap_m": 1e-6}, "better"),
        ({"energy": 0.0}, {"energy": 1e-3}, "worse"),
        ({"gap_m": 1e-3}, {"gap_m": 0.0}, "better"),
        ({"error_m": 0.0}, {"error_m": 5e-10}, None),  # rounding
        ({"cpu_s": 1e-3}, {"cpu_s": 3e-3}, "worse"),
        ({"cpu_s": 0.0}, {"cpu_s": 1e-3}, None),  # clocks have a resolution
        ({"error_m": 1.0}, {"kind": "failed", "reason": "singular"}, "lost"),
        ({"kind": "crashed", "reason": "singular"}, {"error_m": 1.0}, "runs"),
    ],
)
def test_a_step_is_more_than_a_factor_of_two(
    old: dict[str, Any], new: dict[str, Any], course: str | None
) -> None:
    step = _step(old, new)

    assert (None if step is None else step.course) == course


def test_what_was_exactly_zero_counts_as_the_least_that_matters() -> None:
    worse = _history(_row("1", gap_m=0.0), _row("2", gap_m=0.1))

    assert [step.factor for step in worse.steps] == [pytest.approx(0.1 / 1e-9)]
    assert worse.verdict == "fail"


def test_releases_without_a_row_are_stepped_over() -> None:
    other = _row("2", "rod, RK4", error_m=1.0)
    rows = (_row("1", error_m=1.0), other, _row("3", error_m=9.0))

    (step,) = _history(*rows).steps

    assert (step.before, step.release, step.factor) == ("1", "3", 9.0)


def test_times_of_the_newest_release_are_no_verdict() -> None:
    slow = _history(_row("1", cpu_s=1.0), _row("2", cpu_s=5.0))

    assert [step.what for step in slow.steps] == ["time"]
    assert slow.verdict == "pass"


def test_what_the_change_log_says_stands_beside_the_step() -> None:
    name = "tumbling, implicitfast"
    rows = (_row("3.6.0", name, error_m=9e-3), _row("3.7.0", name, error_m=2e-5))
    history = _history(*rows)

    (step,) = history.steps
    assert "midpoint" in step.explanation
    assert step.explanation in to_markdown([present(history)])


@pytest.mark.parametrize("known", ["mujoco", "dart", "exudyn", "pybullet"])
def test_lines_of_change_logs_are_about_rows_that_there_are(known: str) -> None:
    methods = load_adapter(known).methods
    names = [f"{case.name}, {method}" for case in CASES for method in methods]
    names += [f"{scene}, {way}" for scene in PAPER_SCENES for way in ("native", "matched")]
    names += [f"rebound at 2 m/s, {way}" for way in ("native", "matched")]

    assert known_of(known).since
    for line in known_of(known).lines:
        assert any(re.search(line.rows, f"{name}: error") for name in names), line


def test_page_and_picture_show_every_release_and_step(toy_history: History) -> None:
    page = to_html([present(toy_history)], "Release by release")

    for text in ("free fall, RK4", "unexplained", "libtoy.so", "1.0", "2.0", "5.0 mm"):
        assert text in page
    assert to_png([toy_history])[:4] == b"\x89PNG"


_STORED = Path(__file__).parents[2] / "reports" / "releases.json.gz"


@pytest.fixture(scope="module")
def stored() -> dict[str, History]:
    histories = msgspec.json.decode(gzip.decompress(_STORED.read_bytes()), type=list[History])
    return {history.engine: history for history in histories}


def test_the_stored_page_has_the_steps_of_its_rows(stored: dict[str, History]) -> None:
    again = [
        msgspec.structs.replace(history, steps=tuple(steps_of(history.rows, known_of(engine))))
        for engine, history in stored.items()
    ]

    assert again == list(stored.values()), "make reports-releases"
    first, *rest = map(present, again)
    page = to_markdown([replace(first, picture="releases.png"), *rest])
    assert page == _STORED.with_name("releases.md").read_text("utf-8"), "make reports-releases"


def test_changes_of_free_bodies_show_by_the_stored_page_alone(stored: dict[str, History]) -> None:
    """MuJoCo's `implicitfast` had a midpoint rule for them from 3.7 to 3.10."""
    changes = {
        (step.release, step.course)
        for step in stored["mujoco"].steps
        if step.name == "tumbling, implicitfast" and step.what == "error"
    }

    assert changes == {("3.7.0", "better"), ("3.11.0", "worse")}


def test_enough_releases_are_driven(stored: dict[str, History]) -> None:
    least = {"mujoco": 15, "dart": 6, "exudyn": 5, "pybullet": 2}

    assert {engine: len(stored[engine].driven) >= count for engine, count in least.items()} == (
        dict.fromkeys(least, True)
    )
