"""Files of trained models are read without trust: one line, whatever is in them."""

from __future__ import annotations

import os
import resource
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
import torch

from mbds_xsim.base.errors import InputError
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import build, load_model, trainable
from mbds_xsim.learn.model_file import read_facts, read_model, save_model
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.train import read_identity
from mbds_xsim.learn.trained import trained_in
from mbds_xsim.simulate.registry import load_scene
from tests.learn.hostile import FACTS, called, model_file, rewrite, with_pickle

Change = Callable[[dict[str, Any]], None]

_HUGE = b"\x8a\x08" + (88 * 10**9).to_bytes(8, "little")


def _width(whole: dict[str, Any], width: int) -> None:
    settings = msgspec.json.decode(whole["settings"]) | {"width": width}
    whole["settings"] = msgspec.json.encode(settings).decode()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda whole: _width(whole, 9_000), "ask for more parameters than it has"),
        (lambda whole: _width(whole, 150_000), "width: got 150000, allowed is 0 to 10000"),
        (lambda whole: _width(whole, -1), "width: got -1"),
        (lambda whole: whole.pop("parameters"), "missing required field `parameters`"),
        (lambda whole: whole.pop("scene"), "missing required field `scene`"),
        (lambda whole: whole.update(facts={"seed": 3}), r"Expected `str`, got `int`"),
        (lambda whole: whole.update(revision=3), r"\(revision 3 of gns, now 0\); train it again"),
        (lambda whole: whole.update(settings="{"), "another version of the code"),
        (lambda whole: whole.update(name="oracle"), "no model is called 'oracle'; there are: gns"),
        (lambda whole: whole.update(scene="gravity = 3"), "another version of the code"),
        (lambda whole: whole["statistics"].pop("channels"), "another version of the code"),
        (
            lambda whole: whole["statistics"].update(channels=torch.zeros(1).expand(10**11)),
            r"\(100000000000,\) whose numbers are not all in the file",
        ),
        (
            lambda whole: whole["parameters"].update(more=torch.zeros(1)),
            "another version of the code",
        ),
    ],
)
def test_absurd_contents_are_refused_in_one_line(change: Change, told: str, tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    whole = model_file(path)
    change(whole)
    torch.save(whole, path)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=told) as refused:
        read_model(path)
    assert str(refused.value).startswith(str(path))
    assert "\n" not in str(refused.value)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 10**6  # [KiB]


def test_no_steps_per_frame_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    whole = model_file(path, "hgnn")
    whole["settings"] = whole["settings"].replace('"substeps":1', '"substeps":0')
    torch.save(whole, path)
    with pytest.raises(InputError, match=r"another version of the code .*substeps.* got 0"):
        read_model(path)


def test_a_path_may_be_a_text(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    model_file(path)

    model, facts = read_model(str(path))

    assert (type(model), facts) == (load_model("gns"), FACTS)
    assert read_facts(str(path)) == FACTS
    for read in (read_model, read_facts):
        with pytest.raises(InputError, match="path: got '', allowed is the path of a file"):
            read("")


@pytest.mark.parametrize(
    "content",
    [
        called("posix", "system", b"X\x0a\x00\x00\x00touch here"),
        called("builtins", "bytearray", _HUGE),
        called("torch", "Tensor", _HUGE),
        b"\x80\x02}r\xff\xff\xff\x7f.",  # at place 2³¹ of the memo
        b"\x80\x02\x8e" + (88 * 10**9).to_bytes(8, "little") + b".",
        b"(" * 100_000 + b".",
        b"",
    ],
    ids=["code", "memory", "tensor", "memo", "bytes", "nested", "nothing"],
)
def test_no_pickle_runs_code_or_takes_memory(
    content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "model.pt"
    model_file(path)
    with_pickle(path, lambda _: content)
    monkeypatch.chdir(tmp_path)
    for read in (read_model, read_facts, read_identity):
        with pytest.raises(InputError, match=r"no (trained model|checkpoint)"):
            read(path)
    assert not (tmp_path / "here").exists()


def test_numbers_that_are_not_in_the_file_are_not_read(tmp_path: Path) -> None:
    """A storage that is said to be larger than its entry: torch would read beyond its end."""
    path = tmp_path / "model.pt"
    whole = model_file(path)
    whole["statistics"]["channels"] = torch.arange(173.0)  # so that its size is found in the pickle
    torch.save(whole, path)
    size = b"K\xad"
    with_pickle(path, lambda content: content.replace(size, b"J\xff\xff\xff\x7f"))
    with pytest.raises(InputError, match="or a damaged one"):
        read_model(path)


@pytest.mark.parametrize("identity", [{}, {"seed": 3}, torch.zeros(2)])
def test_what_lacks_the_state_of_a_run_is_no_checkpoint(identity: object, tmp_path: Path) -> None:
    path = tmp_path / "run.checkpoint"
    torch.save({"identity": identity, "step": 2}, path)
    with pytest.raises(InputError, match="no checkpoint, or a damaged one; remove it to start"):
        read_identity(path)


@pytest.mark.parametrize("packed", [zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA])
def test_nothing_is_unpacked(packed: int, tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    model_file(path)
    rewrite(path, lambda _, content: content, packed)
    with pytest.raises(InputError, match="or a damaged one"):
        read_model(path)


def test_a_changed_number_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    model_file(path)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="or a damaged one"):
        read_model(path)


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    os.mkfifo(path)
    with pytest.raises(InputError, match="no trained model can be read"):
        read_model(path)


@pytest.mark.parametrize("key", [*FACTS][:4])
def test_facts_that_make_no_sense_are_refused(key: str, tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    whole = model_file(path)
    whole["facts"][key] = ""
    torch.save(whole, path)
    with pytest.raises(InputError, match=f"does not say its {key}"):
        trained_in([path])


@pytest.mark.parametrize(
    "wrong",
    [
        {"seed": "x"}, {"data": "[1]"}, {"drawn": "{}"}, {"interval": "slow"}, {"cpu_s": "long"},
        {"wall_s": "1 h"}, {"train_trajectories": "many"}, {"train_trajectories": "nan"},
        {"wall_s": "inf"},
    ],
)  # fmt: skip
def test_facts_of_another_form_are_refused(wrong: dict[str, str], tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    whole = model_file(path)
    whole["facts"] |= wrong
    torch.save(whole, path)
    with pytest.raises(InputError, match="are not what mbds-xsim train writes"):
        trained_in([path])


def test_what_a_sound_file_holds_does_not_hang_on_it(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    whole = model_file(path)
    model, facts = read_model(path)
    path.write_bytes(b"")
    path.unlink()
    assert facts == FACTS
    for name, value in model.state_dict().items():
        assert torch.equal(value, whole["parameters"][name])


@pytest.mark.parametrize("kind", ["float16", "int32", "int16", "int8"])
def test_a_model_of_another_package_may_keep_any_type_of_array(kind: str, tmp_path: Path) -> None:
    statistics = Statistics.of_nothing()
    model = build("hold", Graph.of(load_scene("3pendulum")), statistics)
    model.register_buffer("order", torch.arange(3, dtype=getattr(torch, kind)))
    path = tmp_path / "model.pt"
    save_model(path, model, "hold", None, statistics)
    assert read_facts(path) == {}


@pytest.mark.parametrize(
    ("name", "track"),
    [(name, track) for name in trainable() for track in load_model(name).tracks],
)
def test_a_model_of_any_track_is_read_back(name: str, track: str, tmp_path: Path) -> None:
    """This holds for any recipe: the decay of GNS's rate is over millions of steps."""
    settings, statistics = load_model(name).tracks[track], Statistics.of_nothing()
    graph, path = Graph.of(load_scene("3pendulum")), tmp_path / "model.pt"
    save_model(path, build(name, graph, statistics, track=track), name, settings, statistics)
    read, _ = read_model(path)
    assert isinstance(read, load_model(name))
    assert not read.training, "dropout is on"
