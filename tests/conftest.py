"""What several tests share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from loguru import logger

from aruco.marker_geometry import save_faces
from rigcal.formats.native import write_json
from rigcal.sim import Simulation, simulate
from rigcal.sources.rgbd_folder import write_recording

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def demo() -> Simulation:
    """The demo rig, without depth: small and quick."""
    return simulate("demo", seed=3, depth=False)


@pytest.fixture(scope="session")
def demo_folder(demo: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo rig on disk, with its map and truth; never to be changed."""
    folder = tmp_path_factory.mktemp("demo") / "recording"
    write_recording(demo.recording, folder, depth=False)
    save_faces(folder / "markers.parquet", demo.faces)
    write_json(folder / "truth.json", demo.truth_document())
    return folder


@pytest.fixture
def cube3_b() -> Path:
    """A real recording of a moved cube; tests that need it skip where it is absent."""
    folder = SHARED_DATA / "cube3_b"
    if not folder.is_dir():
        pytest.skip("needs the real recording cube3_b")
    return folder


@pytest.fixture(autouse=True)
def _quiet_log():
    """The library's log is read by tests that ask for it, and silent otherwise."""
    logger.remove()
    yield
    logger.remove()


@pytest.fixture
def said(_quiet_log: None) -> Iterator[list[str]]:
    """Warnings, as the user reads them."""
    yield from _heard("WARNING")


@pytest.fixture
def told(_quiet_log: None) -> Iterator[list[str]]:
    """Warnings, and what else the user reads."""
    yield from _heard("INFO")


def _heard(level: str) -> Iterator[list[str]]:
    lines: list[str] = []
    handle = logger.add(lambda message: lines.append(message.record["message"]), level=level)
    yield lines
    logger.remove(handle)
