"""Recordings converted to RGB-D folders and MCAP files: nothing lost, interruptions included."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from aruco.errors import InputError, OutputError
from aruco.model import BadFrame, Camera, Frame
from rigcal import conversion_state, recording_conversion
from rigcal.recording_conversion import Converted, convert_recording
from rigcal.recordings import plain_options
from rigcal.sources import open_recordings
from rigcal.sources.mcap_growing import ChunkMessage, GrowingMcap, packed_chunk
from rigcal.sources.mcap_writer import namespaces
from rigcal.sources.rgbd_folder import RgbdFolder
from rigcal.sources.rgbd_writer import fits_steps

W, H = 32, 24
K = np.array([[30.0, 0.0, 15.5], [0.0, 31.0, 11.5], [0.0, 0.0, 1.0]])
DISTORTION = np.array([0.1, -0.2, 0.01, 0.02, 0.3])
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 33_333_333


class Source:
    """A recording of two cameras: a colour one with depth and confidence, and a grey one that is half as fast."""

    def __init__(
        self,
        seed: int = 0,
        n: int = 8,
        bad: Sequence[int] = (),
        depth_step_m: float | None = 0.001,
        bad_depth: Sequence[int] = (),
    ) -> None:
        self.seed, self.n, self.bad, self.depth_step_m, self.bad_depth = seed, n, bad, depth_step_m, bad_depth
        self.reads: list[tuple[str, int]] = []
        self.cameras: tuple[Camera, ...] = (
            Camera(name="1234", width=W, height=H, K=K, distortion=DISTORTION, baseline_m=0.12),
            Camera(name="grey", width=W, height=H, K=K),
        )

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        step = 2 if camera == "grey" else 1
        return START_NS + PERIOD_NS * step * np.arange(self.n // step) + (1_000 if camera == "grey" else 0)

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        return np.arange(0 if camera == "grey" else self.n)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        for index in indices:
            self.reads.append((camera, index))
            yield self.frame(camera, index, depth)

    def frame(self, camera: str, index: int, depth: bool) -> Frame | BadFrame:
        stamp = int(self.stamps_ns(camera)[index])
        if camera == "1234" and index in self.bad:
            return BadFrame(camera, stamp, "is torn")
        rng = np.random.default_rng([self.seed, index, camera == "grey"])
        image = rng.integers(0, 256, (H, W) if camera == "grey" else (H, W, 3), dtype=np.uint8)
        if camera == "grey" or not depth:
            return Frame(camera=camera, stamp_ns=stamp, image=image)
        if index in self.bad_depth:
            return BadFrame(camera, stamp, "has torn depth", depth_may_be_why=True)
        metres = rng.uniform(0.5, 5.0, (H, W))
        if self.depth_step_m is not None:
            metres = np.rint(metres / self.depth_step_m) * self.depth_step_m
        depth_m = metres.astype(np.float32)
        depth_m[0, :3] = np.nan
        confidence = rng.integers(0, 101, (H, W), dtype=np.uint8)
        return Frame(camera=camera, stamp_ns=stamp, image=image, depth_m=depth_m, confidence=confidence)


@pytest.fixture
def convert(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Converted]:
    def run(source: Source, out: Path, **more: Any) -> Converted:
        monkeypatch.setattr(recording_conversion, "open_recordings", lambda paths, options: source)
        return convert_recording([Path("somewhere")], out, **more)

    return run


class StopAfter:
    """A user who presses Ctrl-C."""

    def __init__(self, steps: int) -> None:
        self.steps = steps

    def step(self, name: str, done: int, total: int) -> None:
        if done >= self.steps:
            raise KeyboardInterrupt


def assert_same(recording: Any, source: Source, *, depth: bool = True, skip: Sequence[int] = ()) -> None:
    """Every frame of the source is in the recording, to the bit (depth to the rounding of float32)."""
    assert [camera.name for camera in recording.cameras] == ["1234", "grey"]
    for camera, original in zip(recording.cameras, source.cameras):
        np.testing.assert_array_equal(camera.K, original.K)
        np.testing.assert_array_equal(camera.distortion, original.distortion)
        assert camera.baseline_m == original.baseline_m
        indices = [k for k in range(len(source.stamps_ns(camera.name))) if camera.name == "grey" or k not in skip]
        stamps = source.stamps_ns(camera.name)[indices]
        np.testing.assert_array_equal(recording.stamps_ns(camera.name), stamps)
        read = recording.frames(camera.name, range(len(stamps)), depth=depth)
        for frame, index in zip(read, indices):
            expected = source.frame(camera.name, index, depth)
            assert isinstance(frame, Frame)
            assert isinstance(expected, Frame)
            np.testing.assert_array_equal(frame.image, expected.image)
            assert (frame.depth_m is None) == (expected.depth_m is None)
            if frame.depth_m is not None and expected.depth_m is not None:
                # Two units in the last place of float32.
                np.testing.assert_allclose(frame.depth_m, expected.depth_m, rtol=2.5e-7)
                np.testing.assert_array_equal(frame.confidence, expected.confidence)


@pytest.mark.parametrize("depth_step_m", [0.001, None])
@pytest.mark.parametrize("name", ["out", "out.mcap"])
def test_every_frame_comes_back_as_it_was(
    convert: Callable[..., Converted], tmp_path: Path, name: str, depth_step_m: float | None
) -> None:
    source = Source(depth_step_m=depth_step_m)
    converted = convert(source, tmp_path / name)
    assert (converted.written, converted.kept, converted.bad) == (12, 0, 0)
    assert_same(open_recordings([tmp_path / name]), source)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_depth_finer_than_the_steps_is_kept_as_float(convert: Callable[..., Converted], tmp_path: Path) -> None:
    convert(Source(depth_step_m=None), tmp_path / "fine")
    convert(Source(depth_step_m=0.001), tmp_path / "steps")
    assert {path.suffix for path in (tmp_path / "fine" / "1234" / "depth").iterdir()} == {".npy"}
    assert {path.suffix for path in (tmp_path / "steps" / "1234" / "depth").iterdir()} == {".png"}


def test_what_fits_steps() -> None:
    steps = np.array([[0.001, 1.234, 65.535, np.nan]], dtype=np.float32)
    assert fits_steps(steps, 0.001)
    assert fits_steps(np.full((2, 2), np.nan, dtype=np.float32), 0.001)
    # In float32 arithmetic, as some readers compute.
    assert fits_steps(np.arange(1, 65536, dtype=np.uint16).astype(np.float32) * np.float32(0.001), 0.001)
    for wrong in (1.2345, 65.536, 0.0004, -0.001, 0.0):
        assert not fits_steps(np.array([[wrong]], dtype=np.float32), 0.001)


@pytest.mark.parametrize("name", ["out", "out.mcap"])
def test_without_depth_there_is_none(convert: Callable[..., Converted], tmp_path: Path, name: str) -> None:
    source = Source()
    convert(source, tmp_path / name, depth=False)
    recording = open_recordings([tmp_path / name])
    assert not any(len(recording.depth_indices(camera)) for camera in ("1234", "grey"))
    assert_same(recording, source, depth=False)


def test_every_nth_moment_keeps_cameras_together(convert: Callable[..., Converted], tmp_path: Path) -> None:
    source = Source(n=12)
    convert(source, tmp_path / "out", every=2)
    recording = RgbdFolder(tmp_path / "out")
    # The cameras share six moments, each second frame of the fast one; every camera's own second frame would not.
    assert recording.stamps_ns("1234").tolist() == source.stamps_ns("1234")[::4].tolist()
    assert recording.stamps_ns("grey").tolist() == source.stamps_ns("grey")[::2].tolist()


@pytest.mark.parametrize("name", ["out", "out.mcap"])
def test_a_bad_frame_is_left_out_and_counted(
    convert: Callable[..., Converted], tmp_path: Path, name: str, told: list[str]
) -> None:
    source = Source(bad=(2, 5))
    converted = convert(source, tmp_path / name)
    assert (converted.written, converted.bad) == (10, 2)
    assert "2 could not be read" in converted.sentence
    assert sum("is torn" in line for line in told) == 2
    assert_same(open_recordings([tmp_path / name]), source, skip=(2, 5))


@pytest.mark.parametrize("name", ["out", "out.mcap"])
@pytest.mark.parametrize("bad_depth", [(3, 4, 6), range(8)])
def test_an_image_is_kept_where_only_its_depth_cannot_be_read(
    convert: Callable[..., Converted], tmp_path: Path, name: str, bad_depth: Sequence[int], said: list[str]
) -> None:
    source = Source(bad=(1,), bad_depth=bad_depth)
    converted = convert(source, tmp_path / name)
    lost = len(set(bad_depth) - {1})
    assert (converted.written, converted.depthless, converted.bad) == (11, lost, 1)
    assert f"; {lost} are without depth, which could not be read; 1 could not be read" in converted.sentence
    assert [line for line in said if "without depth" in line] == [
        f"camera 1234: frame {source.stamps_ns('1234')[bad_depth[0]]} is written without depth, as are all like it: "
        "has torn depth"
    ]
    # Each once, and the first of each camera, to know the recording by; again where depth may be why.
    assert len(source.reads) == 12 + 2 + lost
    recording = open_recordings([tmp_path / name])
    assert_same(recording, source, depth=False, skip=(1,))
    with_depth = recording.stamps_ns("1234")[recording.depth_indices("1234")]
    assert set(with_depth.tolist()) == {int(source.stamps_ns("1234")[k]) for k in range(8) if k not in (1, *bad_depth)}
    for frame in recording.frames("1234", recording.depth_indices("1234").tolist(), depth=True):
        expected = source.frame("1234", (frame.stamp_ns - START_NS) // PERIOD_NS, depth=True)
        assert isinstance(frame, Frame)
        assert isinstance(expected, Frame)
        assert frame.depth_m is not None
        assert expected.depth_m is not None
        np.testing.assert_allclose(frame.depth_m, expected.depth_m, rtol=2.5e-7)


def test_with_images_alone_nobody_asks_for_depth(convert: Callable[..., Converted], tmp_path: Path) -> None:
    source = Source(bad=(1,), bad_depth=(3,))
    converted = convert(source, tmp_path / "out", depth=False)
    assert (converted.written, converted.depthless, converted.bad) == (11, 0, 1)
    assert len(source.reads) == 12 + 2  # each once, and the first of each camera, to know the recording by


# Interruptions


def contents(path: Path) -> dict[str, bytes]:
    """A file, or all files below a folder."""
    return {str(p.relative_to(path)): p.read_bytes() for p in (path, *path.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("steps", [2, 7, 12])
@pytest.mark.parametrize("name", ["out", "out.mcap"])
def test_with_depth_that_cannot_be_read_a_second_run_gives_the_same_bytes(
    convert: Callable[..., Converted], tmp_path: Path, name: str, steps: int
) -> None:
    bad: dict[str, Any] = {"bad": (1,), "bad_depth": (0, 3, 4, 6)}
    with pytest.raises(KeyboardInterrupt):
        convert(Source(**bad), tmp_path / name, progress=StopAfter(steps))
    converted = convert(Source(**bad), tmp_path / name)
    whole = convert(Source(**bad), tmp_path / f"whole_{name}")
    assert contents(tmp_path / name) == contents(tmp_path / f"whole_{name}")
    assert (converted.written, converted.bad, whole.depthless) == (whole.written, whole.bad, 4)
    assert 0 <= converted.depthless < 4
    if converted.depthless:
        assert f"by an earlier run; {converted.depthless} of the others are without depth" in converted.sentence


@pytest.mark.parametrize("steps", [1, 5, 12])
@pytest.mark.parametrize("name", ["out", "out.mcap"])
def test_a_second_run_goes_on_where_the_first_stopped(
    convert: Callable[..., Converted], tmp_path: Path, name: str, steps: int, told: list[str]
) -> None:
    with pytest.raises(KeyboardInterrupt):
        convert(Source(), tmp_path / name, progress=StopAfter(steps))
    assert any(f"{steps} finished frames are kept" in line for line in told)
    assert not (tmp_path / name).exists()
    source = Source()
    converted = convert(source, tmp_path / name)
    assert (converted.written, converted.kept) == (12, steps)
    assert any(f"finished {steps} of 12 frames; going on" in line for line in told)
    assert len(source.reads) == 12 - steps + 2  # and the first of each camera, to know the recording by
    convert(Source(), tmp_path / f"whole_{name}")
    if name == "out.mcap":
        assert (tmp_path / name).read_bytes() == (tmp_path / f"whole_{name}").read_bytes()
    assert_same(open_recordings([tmp_path / name]), source)
    assert sorted(path.name for path in tmp_path.iterdir()) == [name, f"whole_{name}"]


@pytest.mark.parametrize("name", ["out", "out.mcap"])
def test_what_an_interruption_leaves_never_reads_as_a_recording(
    convert: Callable[..., Converted], tmp_path: Path, name: str
) -> None:
    with pytest.raises(KeyboardInterrupt):
        convert(Source(), tmp_path / name, progress=StopAfter(12))
    with pytest.raises(InputError, match=f"unfinished conversion; run the rigcal convert that wrote {name} again"):
        open_recordings([tmp_path / f"{name}.part"])
    with pytest.raises(InputError):
        open_recordings([tmp_path])


def test_a_file_cut_anywhere_is_gone_on_with(convert: Callable[..., Converted], tmp_path: Path) -> None:
    source = Source(n=3)
    convert(source, tmp_path / "whole.mcap")
    whole = (tmp_path / "whole.mcap").read_bytes()
    with pytest.raises(KeyboardInterrupt):
        convert(source, tmp_path / "out.mcap", progress=StopAfter(4))
    part = tmp_path / "out.mcap.part"
    state = (part / "conversion.json").read_bytes()
    kept: list[int] = []
    rng = np.random.default_rng(0)
    for cut in [0, 1, 8, len(whole) - 1, len(whole), *rng.integers(0, len(whole), 40).tolist()]:
        part.mkdir(exist_ok=True)
        (part / "conversion.json").write_bytes(state)
        (part / "frames").write_bytes(whole[:cut])
        converted = convert(source, tmp_path / "out.mcap")
        assert (tmp_path / "out.mcap").read_bytes() == whole
        (tmp_path / "out.mcap").unlink()
        kept.append(converted.kept)
    assert set(kept) == {0, 1, 2, 3, 4}


def test_a_killed_process_loses_no_finished_frame(demo_folder: Path, tmp_path: Path) -> None:
    for name in ("out", "out.mcap"):
        code = (
            "import sys, time; from pathlib import Path; from rigcal.recording_conversion import convert_recording\n"
            "class Slow:\n"
            "    def step(self, name, done, total):\n"
            "        print(done, flush=True); time.sleep(0.02)\n"
            f"convert_recording([Path({str(demo_folder)!r})], Path({str(tmp_path / name)!r}), progress=Slow())\n"
        )
        run = subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert run.stdout is not None
        done = 0
        while done < 3:
            done = int(run.stdout.readline())
        run.send_signal(signal.SIGKILL)
        done = max([done, *map(int, run.stdout.read().split())])
        run.wait()
        run.stdout.close()
        assert not (tmp_path / name).exists()
        converted = convert_recording([demo_folder], tmp_path / name)
        assert converted.kept >= done
        recording, original = open_recordings([tmp_path / name]), RgbdFolder(demo_folder)
        for camera in original.cameras:
            for a, b in zip(recording.frames(camera.name, [0, 1]), original.frames(camera.name, [0, 1])):
                assert isinstance(a, Frame)
                assert isinstance(b, Frame)
                np.testing.assert_array_equal(a.image, b.image)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"every": 2}, "--every"),
        ({"depth": False}, "--depth"),
        ({"n": 10}, "camera 1234 has another number of frames"),
        ({"seed": 1}, "camera 1234 has other images"),
    ],
)
def test_what_is_left_of_something_else_is_refused(
    convert: Callable[..., Converted], tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    with pytest.raises(KeyboardInterrupt):
        convert(Source(), tmp_path / "out", progress=StopAfter(2))
    before = sorted(tmp_path.rglob("*"))
    source = Source(**{key: value for key, value in change.items() if key in ("n", "seed")})
    options = {key: value for key, value in change.items() if key in ("every", "depth")}
    with pytest.raises(OutputError, match=f"converting something else \\({words}\\)") as error:
        convert(source, tmp_path / "out", **options)
    assert "out.part" in str(error.value)
    assert sorted(tmp_path.rglob("*")) == before


def test_depth_of_other_topics_is_not_mixed_in(convert: Callable[..., Converted], tmp_path: Path) -> None:
    def topics(*names: str) -> Any:
        return replace(plain_options(), topics=tuple(f"1234=/image,/info,/{name}" for name in names))

    with pytest.raises(KeyboardInterrupt):
        convert(Source(), tmp_path / "out", progress=StopAfter(2), options=topics("a", "b"))
    for other in (topics("a", "c"), None):
        with pytest.raises(OutputError, match=r"converting something else \(--topics\)"):
            convert(Source(), tmp_path / "out", options=other)
    assert convert(Source(), tmp_path / "out", options=topics("b", "a")).kept == 2  # their order means nothing


def test_a_second_run_at_the_same_time_is_kept_out(convert: Callable[..., Converted], tmp_path: Path) -> None:
    if os.name == "nt":
        pytest.skip("needs locks of files")
    refused: list[str] = []

    class Second:
        def step(self, name: str, done: int, total: int) -> None:
            if not refused:
                with pytest.raises(OutputError, match="another conversion is writing it") as error:
                    convert(Source(), tmp_path / "out")
                refused.append(str(error.value))

    convert(Source(), tmp_path / "out", progress=Second())
    assert len(refused) == 1
    assert_same(open_recordings([tmp_path / "out"]), Source())


def test_of_two_runs_that_begin_at_once_one_goes_on(tmp_path: Path) -> None:
    if os.name == "nt":
        pytest.skip("needs locks of files")
    code = """
import multiprocessing, sys
from pathlib import Path
from aruco.errors import OutputError
from rigcal.conversion_state import held
def run(turn, answers, folder):
    for k in range(100):
        turn.wait()
        try:
            with held(folder / f"{k}.part", {"k": "x" * 5000}):
                answers.put((k, ""))
                turn.wait()  # nobody is done before the other has tried
        except OutputError as error:
            answers.put((k, str(error)))
            turn.wait()
context = multiprocessing.get_context("fork")
turn, answers = context.Barrier(2), context.Queue()
runs = [context.Process(target=run, args=(turn, answers, Path(sys.argv[1]))) for _ in range(2)]
for one in runs: one.start()
for k, answer in sorted(answers.get(timeout=60) for _ in range(200)): print(k, answer)
for one in runs: one.join()
"""
    run = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    lines = run.stdout.splitlines()
    assert lines[::2] == [f"{k} " for k in range(100)]
    for k, line in enumerate(lines[1::2]):
        assert line.startswith(f"{k} {tmp_path / f'{k}.part'}: another conversion is writing it")
        assert (tmp_path / f"{k}.part" / "conversion.json").stat().st_size > 5000


def test_two_conversions_started_together_make_one_whole_result(demo_folder: Path, tmp_path: Path) -> None:
    if os.name == "nt":
        pytest.skip("needs locks of files")
    code = """
import multiprocessing, sys
from pathlib import Path
from aruco.errors import OutputError
from rigcal.recording_conversion import convert_recording
def run(turn, answers, source, folder):
    for k in range(8):
        out = folder / (f"{k}.mcap" if k % 2 else f"{k}")
        turn.wait()
        try:
            answers.put((k, convert_recording([source], out, every=20).sentence))
        except OutputError as error:
            answers.put((k, str(error)))
context = multiprocessing.get_context("fork")
turn, answers = context.Barrier(2), context.Queue()
runs = [context.Process(target=run, args=(turn, answers, *map(Path, sys.argv[1:]))) for _ in range(2)]
for one in runs: one.start()
for k, answer in sorted(answers.get(timeout=60) for _ in range(16)): print(k, answer)
for one in runs: one.join()
"""
    arguments = [sys.executable, "-c", code, str(demo_folder), str(tmp_path)]
    run = subprocess.run(arguments, capture_output=True, text=True, check=True)
    answers = run.stdout.splitlines()
    for k in range(8):
        two = [line for line in answers if line.startswith(f"{k} ")]
        assert sum(" Wrote " in line for line in two) == 1, two
        # The second to begin, or one so late that the first was done.
        assert sum("another conversion is writing it" in line or "exists already" in line for line in two) == 1, two
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        ["0", "1.mcap", "2", "3.mcap", "4", "5.mcap", "6", "7.mcap"]
    )
    assert all(contents(tmp_path / f"{k}") == contents(tmp_path / "0") for k in (2, 4, 6))
    assert all(contents(tmp_path / f"{k}.mcap") == contents(tmp_path / "1.mcap") for k in (3, 5, 7))


@pytest.mark.parametrize("end", ["renamed", "removed"])
def test_a_folder_that_goes_away_before_it_is_locked_is_made_anew(
    end: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part, tries = tmp_path / "out.part", []

    def late(path: Path, file: Any) -> None:
        tries.append(path)
        if len(tries) == 1:  # who had it ends now
            part.rename(tmp_path / "out") if end == "renamed" else shutil.rmtree(part)

    monkeypatch.setattr(conversion_state, "_lock", late)
    with conversion_state.held(part, {"options": {}}):
        assert len(tries) == 2
        assert json.loads((part / "conversion.json").read_text()) == {"options": {}}
    assert end == "removed" or (tmp_path / "out" / "conversion.json").read_bytes() == b""


def test_a_state_that_was_cut_off_is_begun_anew_but_never_beside_frames(
    convert: Callable[..., Converted], tmp_path: Path
) -> None:
    part = tmp_path / "out.part"
    for text in ("", '{"format": "rigcal.conv'):
        part.mkdir()
        (part / "conversion.json").write_text(text)
        assert convert(Source(), tmp_path / "out").kept == 0
        shutil.rmtree(tmp_path / "out")
        (part / "1234" / "image").mkdir(parents=True)
        (part / "conversion.json").write_text(text)
        with pytest.raises(OutputError, match="is no unfinished conversion"):
            convert(Source(), tmp_path / "out")
        assert (part / "conversion.json").read_text() == text
        shutil.rmtree(part)


def test_where_the_state_cannot_be_written_nothing_is_left(
    convert: Callable[..., Converted], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(number: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match=r"out: cannot be written \(No space left on device\)"):
        convert(Source(), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_where_a_place_has_no_locks_that_is_told(
    convert: Callable[..., Converted], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: list[str]
) -> None:
    fcntl = pytest.importorskip("fcntl")

    def none(file: Any, how: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", none)
    assert convert(Source(), tmp_path / "out").written == 12
    assert [line for line in said if "cannot be locked there (No locks available)" in line]


def test_a_result_that_another_run_finished_meanwhile_is_left_alone(
    convert: Callable[..., Converted], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("out", "out.mcap"):
        with monkeypatch.context() as patch:
            looked_up = recording_conversion.state_of

            def slow(*arguments: Any, name: str = name, looked_up: Any = looked_up) -> Any:
                patch.undo()
                convert(Source(seed=1), tmp_path / name)
                return looked_up(*arguments)

            patch.setattr(recording_conversion, "state_of", slow)
            with pytest.raises(OutputError, match="exists already"):
                convert(Source(), tmp_path / name)
        assert_same(open_recordings([tmp_path / name]), Source(seed=1))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "out.mcap"]


# Places


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("full", "exists already"),
        ("file", "exists already"),
        ("there.mcap", "exists already"),
        ("stranger", "no unfinished conversion"),
        ("film.mp4", "RGB-D folder or to an .mcap file"),
        ("out.part", "RGB-D folder or to an .mcap file"),
        ("file/out", "file/out"),
        ("no/such/out", r"no/such/out: the folder .*no/such does not exist; create it or choose another place"),
        ("no/out.mcap", r"no/out\.mcap: the folder .*no does not exist; create it or choose another place"),
    ],
)
def test_places_that_cannot_be_written_are_refused_and_untouched(
    convert: Callable[..., Converted], tmp_path: Path, place: str, words: str
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "stranger.part").mkdir()
    for file in ("full/letter.txt", "file", "there.mcap", "stranger.part/letter.txt"):
        (tmp_path / file).write_text("dear")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(OutputError, match=words):
        convert(Source(), tmp_path / place)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_full_disk_is_one_sentence_and_keeps_what_is_there(
    convert: Callable[..., Converted], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Full:
        def step(self, name: str, done: int, total: int) -> None:
            if done == 3:
                raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match=r"No space left on device.*finished frames are in out\.part"):
        convert(Source(), tmp_path / "out", progress=Full())
    assert convert(Source(), tmp_path / "out").kept == 3


@pytest.mark.parametrize(("name", "why"), [("a\nb", "cannot be printed"), ("a\udcff", "not valid UTF-8")])
def test_a_camera_name_that_calibrating_would_refuse_is_refused(
    convert: Callable[..., Converted], tmp_path: Path, name: str, why: str
) -> None:
    source = Source()
    source.cameras = (Camera(name=name, width=W, height=H, K=K), source.cameras[1])
    for out in ("out", "out.mcap"):
        with pytest.raises(OutputError, match=f"{why}; rename the camera"):
            convert(source, tmp_path / out)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["../escape", "a/b", ".."])
def test_a_camera_name_that_leads_elsewhere_is_refused(
    convert: Callable[..., Converted], tmp_path: Path, name: str
) -> None:
    source = Source()
    source.cameras = (Camera(name=name, width=W, height=H, K=K), source.cameras[1])
    (tmp_path / "inner").mkdir()
    for out in ("out", "out.mcap"):
        with pytest.raises(OutputError, match="rename the camera"):
            convert(source, tmp_path / "inner" / out)
    assert not [path for path in tmp_path.rglob("*") if "escape" in path.name]


def test_depth_that_is_not_there_cannot_be_asked_for(convert: Callable[..., Converted], tmp_path: Path) -> None:
    source = Source()
    source.cameras = source.cameras[1:]
    with pytest.raises(InputError, match="no camera of the recording has depth"):
        convert(source, tmp_path / "out", depth=True)
    assert list(tmp_path.iterdir()) == []


# What other readers find


def test_other_readers_find_ros_messages_in_the_order_of_time(
    convert: Callable[..., Converted], tmp_path: Path
) -> None:
    source = Source()
    convert(source, tmp_path / "out.mcap")
    store = get_typestore(Stores.ROS2_HUMBLE)
    with (tmp_path / "out.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 8 * 5 + 4 * 2
        found = list(reader.iter_messages(log_time_order=False))
    assert [message.log_time for _, _, message in found] == sorted(message.log_time for _, _, message in found)
    by_topic: dict[str, list[Any]] = {}
    for schema, channel, message in found:
        assert schema is not None
        assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
        by_topic.setdefault(channel.topic, []).append(store.deserialize_cdr(message.data, schema.name))
    expected = source.frame("1234", 3, True)
    assert isinstance(expected, Frame)
    assert expected.depth_m is not None
    image, info = by_topic["/camera_1234/image/compressed"][3], by_topic["/camera_1234/camera_info"][3]
    assert image.header.stamp.sec * 10**9 + image.header.stamp.nanosec == expected.stamp_ns
    assert image.header.frame_id == info.header.frame_id == "1234"
    np.testing.assert_array_equal(cv2.imdecode(image.data, cv2.IMREAD_UNCHANGED), expected.image)
    np.testing.assert_array_equal(info.k.reshape(3, 3), K)
    np.testing.assert_array_equal(info.d, source.cameras[0].distortion)
    assert (info.width, info.height, info.distortion_model) == (W, H, "plumb_bob")
    depth = by_topic["/camera_1234/depth/image"][3]
    assert (depth.encoding, depth.width, depth.height, depth.step) == ("16UC1", W, H, 2 * W)
    units = depth.data.view("<u2").reshape(H, W)
    np.testing.assert_allclose(units[units > 0] * 0.001, expected.depth_m[np.isfinite(expected.depth_m)], rtol=2.5e-7)
    confidence = by_topic["/camera_1234/confidence/image"][3]
    np.testing.assert_array_equal(confidence.data.reshape(H, W), expected.confidence)
    assert set(by_topic) - {"/grey/image/compressed", "/grey/camera_info"} == {
        f"/camera_1234/{topic}"
        for topic in ("image/compressed", "camera_info", "depth/image", "depth/camera_info", "confidence/image")
    }


def test_namespaces_are_names_that_ros_allows_and_each_another() -> None:
    names = ["34563472", "left", "a b", "a_b", "a-b", "été", "__", "x__y"]
    found = namespaces(names)
    assert found["left"] == "left"
    assert found["34563472"] == "camera_34563472"
    assert len(set(found.values())) == len(names)
    for name in found.values():
        assert name[0].isalpha()
        assert "__" not in name
        assert name.replace("_", "").isalnum()
        assert name.isascii()


def test_a_file_that_begins_otherwise_is_not_gone_on_with(tmp_path: Path) -> None:
    from mcap.records import Channel

    def channel(topic: str) -> Channel:
        return Channel(id=1, topic=topic, message_encoding="", schema_id=0, metadata={})

    file = GrowingMcap(tmp_path / "one", [], [channel("/a")], frozenset({1}))
    file.add(packed_chunk([ChunkMessage(1, 5, b"data")], compressed=False))
    file.close()
    with pytest.raises(OutputError, match="does not begin as this conversion would"):
        GrowingMcap(tmp_path / "one", [], [channel("/b")], frozenset({1}))
    again = GrowingMcap(tmp_path / "one", [], [channel("/a")], frozenset({1}))
    assert again.log_times_ns == {1: [5]}
    again.close()


def test_memory_is_flat_over_the_length_of_the_recording(tmp_path: Path) -> None:
    # 40 frames of 1080p are 250 MB; three at a time are 19.
    code = """
import resource, sys
from pathlib import Path
import numpy as np
from aruco.model import Camera, Frame
from rigcal import recording_conversion
class Long:
    cameras = (Camera(name="a", width=1920, height=1080, K=np.array([[900.0, 0, 960], [0, 900, 540], [0, 0, 1]])),)
    def __init__(self, n): self.n = n
    def stamps_ns(self, camera): return np.arange(self.n) * 10**8
    def depth_indices(self, camera): return np.arange(0)
    def frames(self, camera, indices, *, depth=False):
        for k in indices:
            yield Frame(camera=camera, stamp_ns=k * 10**8, image=np.full((1080, 1920, 3), k, dtype=np.uint8))
peaks = []
for n in (3, 40):
    recording_conversion.open_recordings = lambda paths, options: Long(n)
    recording_conversion.convert_recording([Path("x")], Path(sys.argv[1]) / f"{n}.mcap")
    peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
print((peaks[1] - peaks[0]) / 1024)
"""
    if sys.platform != "linux":
        pytest.skip("measures as Linux does")
    run = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    assert float(run.stdout) < 60


def test_the_state_tells_what_is_converted(convert: Callable[..., Converted], tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        convert(Source(), tmp_path / "out", progress=StopAfter(1), every=3)
    state = json.loads((tmp_path / "out.part" / "conversion.json").read_text())
    assert state["options"] == {
        "to": "rgbd",
        "every": 3,
        "depth": {"mode": "NEURAL", "stereo": False},
        "topics": [],
    }
    assert state["cameras"].keys() == {"1234", "grey"}


# What a newcomer met


@pytest.mark.parametrize("name", ["out", "out.mcap"])
def test_a_recording_without_a_readable_frame_is_refused_and_leaves_nothing(
    convert: Callable[..., Converted], tmp_path: Path, name: str
) -> None:
    source = Source(bad=range(8))
    source.cameras = source.cameras[:1]
    with pytest.raises(InputError, match="no frame of the recording can be read"):
        convert(source, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["out", "out.mcap"])
def test_a_camera_that_ends_without_a_frame_is_named(
    convert: Callable[..., Converted], tmp_path: Path, name: str, told: list[str]
) -> None:
    converted = convert(Source(bad=range(8)), tmp_path / name)
    assert (converted.cameras, converted.written, converted.bad) == (1, 4, 8)
    assert "of a camera no frame was written: 1234" in told


def test_a_camera_name_that_no_folder_can_have_is_refused_before_anything_is_made(
    convert: Callable[..., Converted], tmp_path: Path
) -> None:
    source = Source()
    source.cameras = (Camera(name="x" * 400, width=W, height=H, K=K), source.cameras[1])
    for out in ("out", "out.mcap"):
        with pytest.raises(OutputError, match="rename the camera") as error:
            convert(source, tmp_path / out)
        assert len(str(error.value)) < 200
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["out", "out.mcap"])
def test_where_nothing_was_finished_nothing_is_left_and_nothing_promised(
    convert: Callable[..., Converted], tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: object, packed: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rigcal.sources.rgbd_writer.RgbdFrames.store", full)
    monkeypatch.setattr("rigcal.sources.mcap_writer.McapFrames.store", full)
    with pytest.raises(OutputError, match="No space left") as error:
        convert(Source(), tmp_path / name)
    assert "finished frames" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_frames_that_are_not_whole_are_written_again(
    convert: Callable[..., Converted], tmp_path: Path, told: list[str]
) -> None:
    with pytest.raises(KeyboardInterrupt):
        convert(Source(), tmp_path / "out", progress=StopAfter(12))
    folder = tmp_path / "out.part" / "1234"
    images, depths = (sorted((folder / kind).iterdir()) for kind in ("image", "depth"))
    images[0].write_bytes(b"")
    images[1].write_bytes(images[1].read_bytes()[:-20])
    images[2].write_bytes(bytes(images[2].stat().st_size))
    depths[3].write_bytes(depths[3].read_bytes()[:100])
    assert convert(Source(), tmp_path / "out").kept == 12 - 4
    assert any("4 frames are not whole" in line for line in told)
    assert_same(RgbdFolder(tmp_path / "out"), Source())


def test_a_result_never_goes_into_an_input_nor_under_a_name_of_another_kind(
    convert: Callable[..., Converted], demo_folder: Path, tmp_path: Path
) -> None:
    for out in (demo_folder / "new", demo_folder / "new.mcap", demo_folder / "a" / "b"):
        with pytest.raises(OutputError, match=r"lies in .*, an input"):
            convert_recording([demo_folder], out)
        assert not out.exists()
    with pytest.raises(OutputError, match=r"x\.txt: recordings are converted to an RGB-D folder or to an \.mcap file"):
        convert(Source(), tmp_path / "x.txt")
    (tmp_path / "x.txt").mkdir()
    for name in ("x.txt", "2025.06.01", "box_1.5m"):
        convert(Source(), tmp_path / name)
        assert_same(RgbdFolder(tmp_path / name), Source())
