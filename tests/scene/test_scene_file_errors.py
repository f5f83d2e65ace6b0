"""Scene files: every mistake gets one line that says where."""

from __future__ import annotations

import copy
from pathlib import Path

import pytest
import tomli_w

from mbds_xsim.base.errors import InputError, SceneError
from mbds_xsim.scene.file import read_scene
from tests.scene.mistakes import MISTAKES, Edit, swinging_door


def test_the_scene_to_be_spoilt_is_sound(tmp_path: Path) -> None:
    path = tmp_path / "door.toml"
    path.write_text(tomli_w.dumps(swinging_door()), encoding="utf-8-sig")  # as Notepad does

    assert [body.name for body in read_scene(path).bodies] == ["leaf", "knob"]


@pytest.mark.parametrize(("spoil", "expected"), MISTAKES.values(), ids=MISTAKES.keys())
def test_each_mistake_gets_one_line_that_says_where(
    spoil: Edit, expected: str, tmp_path: Path
) -> None:
    table = copy.deepcopy(swinging_door())
    spoil(table)
    path = tmp_path / "door.toml"
    path.write_text(tomli_w.dumps(table))

    with pytest.raises(SceneError) as caught:
        read_scene(path)

    message = str(caught.value)
    assert expected in message
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert isinstance(caught.value, InputError)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (
            b"name = 'door'\nlength = = 1\n",
            "this is not TOML: Invalid value (at line 2, column 10)",
        ),
        (b"length = 1\nlength = 2\n", "Cannot overwrite a value (at line 2"),
        (b"name = '\xff'\n", "got byte 0xff at 8, allowed is UTF-8"),
        (b"", "the key 'name' is missing, it is a text; got none"),
        (b"[[joints]]\n" * 20_001, "joints: got 20001, allowed are 20000 at most: larger sce"),
        (b"# 16 MB\n" * 2_000_001, "got more than 16 MB: 20 000 bodies with joints take 7"),
        (b".".join([b"a"] * 50_000) + b" = 1\n", "got a key of 100 parts or more"),
        (b"x = {" + b" .\t".join([b'"a, b"'] * 50_000) + b" = 1}\n", "a key of 100 parts or more"),
    ],
    ids=["syntax", "key twice", "not text", "empty", "parts", "size", "deep", "deep in quotes"],
)
def test_what_is_not_toml_is_said_with_its_place(
    content: bytes, expected: str, tmp_path: Path
) -> None:
    path = tmp_path / "door.toml"
    path.write_bytes(content)

    with pytest.raises(SceneError) as caught:
        read_scene(path)

    assert expected in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).count(str(path)) == 1


@pytest.mark.parametrize(
    ("table", "part"),
    [
        ("contacts", "{body = 'leaf', center = [0, 0, 0], radius = 1}"),
        ("forces", "{body = 'leaf', series = [[0, 0, 1]]}"),
        ("torques", "{joint = 'frame', series = [1]}"),
    ],
)
def test_parts_in_one_line_are_counted_as_well(table: str, part: str, tmp_path: Path) -> None:
    parts = ", ".join([part] * 20_001)
    (tmp_path / "door.toml").write_text(f"{table} = [{parts}]\n" + tomli_w.dumps(swinging_door()))

    with pytest.raises(SceneError, match=f"{table}: got 20001, allowed are 20000 at most"):
        read_scene(tmp_path / "door.toml")


@pytest.mark.parametrize(("name", "reason"), [("none.toml", "No such file"), ("", "directory")])
def test_a_file_that_cannot_be_read_is_named(name: str, reason: str, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=reason) as caught:
        read_scene(tmp_path / name)

    assert "mbds-xsim scenes" in str(caught.value)
