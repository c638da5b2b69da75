"""Files appear whole or not at all, and nothing else is touched on the way."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from aruco.atomic import check_writable, write_whole
from aruco.errors import OutputError


def test_a_file_is_replaced_and_nothing_is_left_beside_it(tmp_path: Path) -> None:
    goal = tmp_path / "x.json"
    for data in (b"first", b"second"):
        check_writable(goal)
        write_whole(goal, data)
        assert goal.read_bytes() == data
    assert list(tmp_path.iterdir()) == [goal]


def test_a_link_keeps_pointing_to_the_file(tmp_path: Path) -> None:
    goal, link = tmp_path / "x.json", tmp_path / "link.json"
    goal.write_bytes(b"old")
    link.symlink_to(goal)
    write_whole(link, b"new")
    assert link.is_symlink()
    assert goal.read_bytes() == b"new"


@pytest.mark.parametrize("action", [check_writable, lambda path: write_whole(path, b"new")])
@pytest.mark.parametrize("kind", ["file", "link", "dangling link", "folder"])
def test_what_has_the_name_of_the_file_in_the_making_is_not_touched(
    action: Callable[[Path], None], kind: str, tmp_path: Path
) -> None:
    goal, part, precious = tmp_path / "x.json", tmp_path / "x.json.part", tmp_path / "precious"
    if kind == "folder":
        part.mkdir()
    elif kind == "file":
        part.write_bytes(b"precious")
    else:
        part.symlink_to(precious)
        if kind == "link":
            precious.write_bytes(b"precious")
    before = {path: path.lstat().st_ino for path in tmp_path.iterdir()}
    with pytest.raises(OutputError, match=r"x\.json\.part: is in the way") as caught:
        action(goal)
    assert "remove it or choose another name" in str(caught.value)
    assert {path: path.lstat().st_ino for path in tmp_path.iterdir()} == before
    assert not precious.exists() or precious.read_bytes() == b"precious"


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failure_leaves_what_was_there(error: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    goal = tmp_path / "x.json"
    goal.write_bytes(b"old")

    def fails(descriptor: int) -> None:
        raise error

    monkeypatch.setattr(os, "fsync", fails)
    with pytest.raises((OutputError, KeyboardInterrupt)) as caught:
        write_whole(goal, b"new")
    assert isinstance(caught.value, KeyboardInterrupt) or "No space left on device" in str(caught.value)
    assert goal.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [goal]
