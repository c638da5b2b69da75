"""All frames of all cameras of a recording, read in step: run as a process of its own, whose memory is measured."""

from __future__ import annotations

import sys
from pathlib import Path

from aruco.model import Frame
from rigcal.recordings import read_cameras
from rigcal.sources import open_recordings
from rigcal.sources.options import SourceOptions


def main(path: Path) -> int:
    """How many frames there are."""
    recording = open_recordings([path], SourceOptions(same_clock=True, read_cameras=read_cameras))
    streams = [
        recording.frames(camera.name, range(len(recording.stamps_ns(camera.name)))) for camera in recording.cameras
    ]
    return sum(isinstance(frame, Frame) for together in zip(*streams) for frame in together)


if __name__ == "__main__":
    print(main(Path(sys.argv[1])))
