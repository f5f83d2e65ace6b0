"""Texts that `generate` writes with the data: a card for people, metadata for machines."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from pathlib import Path
from typing import Any

import h5py
import msgspec
import numpy as np
import pytest

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import HERE
from mbds_xsim.dataset.card import CARD, CROISSANT
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.dataset.verify import verify
from mbds_xsim.scene.sampling_terms import Throw
from mbds_xsim.scene.scene import Scene
from tests.dataset.conftest import Make, Silence

FEW = 6


@pytest.fixture(scope="module")
def two(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A certified and an uncertified set of the rod."""
    out = tmp_path_factory.mktemp("two")
    make(out, settings="matched,native", trajectories=FEW)
    return out / "1pendulum"


@pytest.fixture(scope="module")
def metadata(two: Path) -> dict[str, Any]:
    return dict(json.loads((two / CROISSANT).read_text("utf-8")))


def _rows(metadata: dict[str, Any], name: str) -> list[dict[str, Any]]:
    (record_set,) = (records for records in metadata["recordSet"] if records["@id"] == name)
    return [{key.split("/")[1]: value for key, value in row.items()} for row in record_set["data"]]


def test_the_card_tells_what_each_file_is(two: Path) -> None:
    text = (two / CARD).read_text("utf-8")
    for profile, certified in (("matched", "certified"), ("native", "uncertified")):
        attributes = load_dataset(two / f"mujoco-{profile}.h5").attributes
        row = next(
            line for line in text.splitlines() if line.startswith(f"| `mujoco-{profile}.h5` | muj")
        )
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        assert cells[1:] == [
            f"mujoco {attributes['engine_version']}",
            attributes["method"],
            f"{attributes['step_s']:.6g}",
            certified,
            *("6", "6", "0"),
        ]
    assert "6 of 6 are published in all of them (`joint.h5`)" in text
    assert "those that an ordinary user gets, or at other named settings; only finite" in text
    assert str(two) not in text


def test_data_that_no_engine_made_are_told_apart(make: Make, tmp_path: Path) -> None:
    """Data of the reference pass the same gate: it keeps every budget of the rod."""
    made = make(tmp_path, engines="mujoco,reference", trajectories=FEW)
    text = " ".join((tmp_path / "1pendulum" / CARD).read_text("utf-8").split())
    data = load_dataset(tmp_path / "1pendulum" / "reference-matched.h5")

    assert [count.published for count in made.variants] == [FEW, FEW]
    assert "| adaptive | rtol 1e-09 | certified |" in text
    assert "`reference-matched.h5`: made by the reference of mbds-xsim" in text
    assert "`mujoco-matched.h5`: made" not in text
    own = np.array(data["check/figure"])[
        :3, list(data["check/name"]).index("error growth-weighted")
    ]
    assert np.all(own < 1e-9)


def test_a_set_without_its_shards_ends_the_next_before_it_begins(
    make: Make, tmp_path: Path
) -> None:
    make(tmp_path, trajectories=3, settings="native")
    shutil.rmtree(tmp_path / "1pendulum" / "mujoco-native")
    with pytest.raises(
        InputError, match=r"mujoco-native\.h5: 1 of its 1 shards are missing.*delete"
    ):
        make(tmp_path, trajectories=3)
    assert not (tmp_path / "1pendulum" / "mujoco-matched").exists()


def test_parts_that_differ_between_files_are_told(make: Make, tmp_path: Path) -> None:
    make(tmp_path, trajectories=FEW)
    card = tmp_path / "1pendulum" / CARD
    assert "the same in every file: the first 80 %" in card.read_text("utf-8")

    progress = Silence()
    make(tmp_path, settings="native", trajectories=FEW + 4, progress=progress)
    (line,) = progress.notices
    assert "mujoco-matched.h5: 6 trajectories, now asked for: 10; load_pairs, train" in line
    matched, native = (
        load_dataset(tmp_path / "1pendulum" / f"mujoco-{one}.h5") for one in ("matched", "native")
    )
    tested = matched.index[matched.rows_of("test")]
    assert np.isin(tested, native.index[native.rows_of("train")]).all()
    assert "what one tests with, another may train on" in card.read_text("utf-8")
    (note,) = [
        note
        for file in verify(tmp_path, conduct=HERE).files
        for note in file.notes
        if "load_pairs" in note
    ]
    assert note.startswith("6 trajectories, but mujoco-native.h5 has 10: load_pairs, train")


def test_a_damaged_set_beside_is_refused_before_anything_is_made(
    make: Make, tmp_path: Path
) -> None:
    make(tmp_path, trajectories=FEW)
    (tmp_path / "1pendulum" / "mujoco-matched.h5").write_bytes(b"lost")

    with pytest.raises(InputError, match=r"mujoco-matched\.h5 cannot be read as HDF5.*delete it"):
        make(tmp_path, settings="native", trajectories=FEW)
    assert not (tmp_path / "1pendulum" / "mujoco-native").exists()


def test_particles_too_far_for_float32_and_a_length_of_other_units_are_told(
    make: Make, rod: Scene, tmp_path: Path
) -> None:
    far = Throw(rod.bodies[0].name, displacement=((5e5, 5e5), (0.0, 1.0), (0.0, 0.0)))
    scene = msgspec.structs.replace(
        rod, joints=(), anchors=(), edges=(), sampling=(far,), length=1e3
    )
    progress = Silence()
    make(tmp_path, scene=scene, trajectories=3, progress=progress)
    doubt, line = progress.notices
    assert "its length of 1000 m is" in doubt
    assert "5e+05 m from the origin float32 rounds positions of particles by 0.02 m" in line
    assert "float32 rounds by up to 0.0" in (tmp_path / "1pendulum" / CARD).read_text("utf-8")


def test_a_scene_without_noise_has_no_random_forces(make: Make, rod: Scene, tmp_path: Path) -> None:
    make(tmp_path, scene=msgspec.structs.replace(rod, noise=0.0), trajectories=FEW)
    text = (tmp_path / "1pendulum" / CARD).read_text("utf-8")
    assert "those of seed 0, without random forces: " in text


def test_what_a_publisher_added_stays(make: Make, tmp_path: Path) -> None:
    make(tmp_path, trajectories=FEW)
    card, metadata = tmp_path / "1pendulum" / CARD, tmp_path / "1pendulum" / CROISSANT
    card.write_text(card.read_text("utf-8") + "\nAsk the rod's owner.\n", "utf-8")
    license_ = "https://example.org/license"
    original = json.loads(metadata.read_text("utf-8"))
    metadata.write_text(json.dumps(original | {"license": license_, "name": "mine"}), "utf-8")

    make(tmp_path, trajectories=FEW)
    assert card.read_text("utf-8").endswith("\nAsk the rod's owner.\n")
    assert json.loads(metadata.read_text("utf-8")) == original | {"license": license_}

    make(tmp_path, trajectories=FEW + 1)  # other data: a new card, and still that licence
    assert "owner" not in card.read_text("utf-8")
    assert "7 of 7 are published" in card.read_text("utf-8")
    changed = json.loads(metadata.read_text("utf-8"))
    assert (changed["license"], changed["distribution"] == original["distribution"]) == (
        license_,
        False,
    )


def test_the_commands_of_the_card_exist(two: Path) -> None:
    from mbds_xsim.commands import app

    there = {command.callback.__name__ for command in app.registered_commands if command.callback}
    named = re.findall(r"`mbds-xsim (\w+)", (two / CARD).read_text("utf-8"))
    assert len(named) == 3
    assert set(named) <= there


def test_rejected_ones_are_told(make: Make, tmp_path: Path) -> None:
    import msgspec

    from mbds_xsim.simulate.registry import load_scene

    scene = load_scene("1pendulum")
    strict = msgspec.structs.replace(scene.budget, energy=1e-15, energy_first_order=1e-15)
    clock = msgspec.structs.replace(scene.clock, steps=10)
    make(tmp_path, scene=msgspec.structs.replace(scene, budget=strict, clock=clock), trajectories=3)
    text = (tmp_path / "1pendulum" / CARD).read_text("utf-8")
    assert "Rejected from `mujoco-matched.h5` by the check that failed first: energy 3." in text
    assert "0 of 3 are published in all of them" in text


def test_metadata_are_croissant(metadata: dict[str, Any]) -> None:
    """The rules of http://mlcommons.org/croissant/1.0 that a program can check."""
    assert metadata["@type"] == "sc:Dataset"
    assert metadata["conformsTo"] == "http://mlcommons.org/croissant/1.0"
    assert {"name", "description", "distribution", "recordSet"} <= metadata.keys()
    context = metadata["@context"]
    assert context["@vocab"] == "https://schema.org/"
    assert context["cr"] == "http://mlcommons.org/croissant/"
    nodes = [*metadata["distribution"], *metadata["recordSet"]]
    nodes += [field for records in metadata["recordSet"] for field in records["field"]]
    names = [node["@id"] for node in nodes]
    assert len(set(names)) == len(names)
    for records in metadata["recordSet"]:
        assert records["@type"] == "cr:RecordSet"
        keys = {field["@id"] for field in records["field"]}
        assert all(key.startswith(records["@id"] + "/") for key in keys)
        assert all(row.keys() == keys for row in records["data"])
        kinds = {field["@id"]: field["dataType"] for field in records["field"]}
        python = {"sc:Text": str, "sc:Integer": int}
        assert all(
            type(value) is python[kinds[key]]
            for row in records["data"]
            for key, value in row.items()
        )


def test_metadata_list_the_files(two: Path, metadata: dict[str, Any]) -> None:
    files = set()
    for node in metadata["distribution"]:
        if node["@type"] == "cr:FileSet":
            files |= set(two.glob(node["includes"]))
            continue
        content = (two / node["contentUrl"]).read_bytes()
        assert node["sha256"] == hashlib.sha256(content).hexdigest()
        assert node["contentSize"] == f"{len(content)} B"
        files.add(two / node["contentUrl"])
    assert files == set(two.rglob("*.h5"))


def test_metadata_list_arrays_and_counts(two: Path, metadata: dict[str, Any]) -> None:
    arrays = {row["path"]: row for row in _rows(metadata, "arrays")}
    with h5py.File(two / "mujoco-matched.h5") as file:
        names: list[str] = []
        file.visititems(
            lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None
        )
        assert set(names) <= arrays.keys()
        for name in names:
            assert arrays[name]["axes"] == file[name].attrs["axes"]
            assert arrays[name]["unit"] == file[name].attrs["unit"]
    counts = _rows(metadata, "counts")
    assert sum(row["trajectories"] for row in counts) == 2 * FEW
    assert {row["split"] for row in counts} == {"train", "validation", "test"}


def test_the_same_data_have_the_same_card(make: Make, two: Path, tmp_path: Path) -> None:
    """The same card results from two runs, the second of which extends the first."""
    make(tmp_path, settings="native", trajectories=FEW - 2)
    make(tmp_path, settings="matched", trajectories=FEW)
    make(tmp_path, settings="native", trajectories=FEW)
    for name in (CARD, CROISSANT):
        assert (tmp_path / "1pendulum" / name).read_bytes() == (two / name).read_bytes()
