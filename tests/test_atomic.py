"""Files appear whole or not at all, and nothing else is touched on the way."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from aruco.atomic import check_writable, write_all_whole, write_whole
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


def test_several_files_appear_together_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, two, link = tmp_path / "1.json", tmp_path / "2.json", tmp_path / "link.json"
    link.symlink_to(two)
    write_all_whole({one: b"1", link: b"2"})
    assert (one.read_bytes(), two.read_bytes(), link.is_symlink()) == (b"1", b"2", True)
    with pytest.raises(OutputError, match=r"no/3\.json"):
        write_all_whole({one: b"new", tmp_path / "no" / "3.json": b"new"})
    monkeypatch.setattr(Path, "replace", lambda self, goal: (_ for _ in ()).throw(OSError(5, "Input/output error")))
    with pytest.raises(OutputError, match=r"1\.json: cannot be written \(Input/output error\)"):
        write_all_whole({one: b"new", link: b"new"})
    assert (one.read_bytes(), two.read_bytes()) == (b"1", b"2")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.json", "2.json", "link.json"]


def test_finding_out_never_takes_the_name_that_another_run_writes_under(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    goal, tried = tmp_path / "x.json", []
    opened = Path.open

    def meanwhile(self: Path, mode: str) -> object:
        tried.append(self.name)
        stream = opened(self, mode)
        if len(tried) == 1:
            write_whole(goal, b"of another run")
        return stream

    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", meanwhile)
        check_writable(goal)
    assert goal.read_bytes() == b"of another run"
    assert tried[0] != "x.json.part"
    assert list(tmp_path.iterdir()) == [goal]


@pytest.mark.parametrize("action", [check_writable, lambda path: write_whole(path, b"new")])
def test_a_name_whose_part_has_no_place_is_refused(action: Callable[[Path], None], tmp_path: Path) -> None:
    action(tmp_path / ("x" * 250))
    with pytest.raises(OutputError, match="File name too long"):
        action(tmp_path / ("x" * 251))


def test_an_earlier_result_may_be_replaced_and_other_work_may_not(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    for content in (None, b"", b'{"cam0": 1}', b'\n {"cam0": 1}'):
        if content is not None:
            path.write_bytes(content)
        check_writable(path, b"{")
    for content in (b"\x89MCAP0\r\n", b"%YAML:1.0", b"[1]"):
        path.write_bytes(content)
        check_writable(path)
        with pytest.raises(OutputError, match="not what an earlier run would have written; remove it"):
            check_writable(path, b"{")
        assert path.read_bytes() == content
