"""Opening a video file: its one video stream, or a sentence that says what is wrong with it.

Owns      what a container must have before anything is read from it, and what its first picture tells.
Leaves    packets to video_index and video_reader.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loguru import logger

from aruco.errors import InputError
from rigcal.sources.decoding import import_av
from rigcal.sources.image_file import MAX_PIXELS
from rigcal.sources.video_ends import Ends

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.stream import VideoStream

# Decoders show the first picture after so many packets at the latest.
_PROBED_PACKETS = 64


@contextmanager
def open_video(path: Path, ends: Ends | None = None) -> Iterator[tuple[InputContainer, VideoStream]]:
    """A file's container and its video stream, of which nothing has been read yet; raises InputError."""
    av = import_av()
    if ends is not None and not ends.has_index:
        raise InputError(
            f"{path}: nothing of it can be read, for its index (moov) is missing or cut off: the recording "
            "ended without writing it; record again, into MKV if power or programs may fail."
        )
    try:
        # Nothing else may be opened from within, and a name is only a name.
        container = av.open(f"file:{path}", options={"protocol_whitelist": "file"}, metadata_errors="replace")
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise _unopened(path, ends or Ends(size=-1, promised=None), error) from error
    with container:
        streams = [stream for stream in container.streams.video if not _is_cover(av, stream)]
        if not streams:
            raise InputError(f"{path}: has no video stream; give the file that the camera recorded.")
        chosen = next((stream for stream in streams if stream.disposition & av.stream.Disposition.default), streams[0])
        for stream in container.streams:
            if stream is not chosen:
                stream.discard = av.stream.Discard.all
        _refuse(path, container, chosen)
        yield container, chosen


def _is_cover(av: Any, stream: VideoStream) -> bool:
    return bool(stream.disposition & av.stream.Disposition.attached_pic)


def _unopened(path: Path, ends: Ends, error: Exception) -> InputError:
    if ends.size == 0:
        return InputError(f"{path}: is empty (0 bytes); record it again.")
    if ends.cut:
        return InputError(f"{path}: {ends.cut}, and nothing before can be read; record it again.")
    reason = getattr(error, "strerror", None) or error
    return InputError(f"{path}: cannot be read as a video ({reason}); record it again or convert it to MP4 or MKV.")


def _refuse(path: Path, container: InputContainer, stream: VideoStream) -> None:
    context = stream.codec_context
    if context is None:
        raise InputError(f"{path}: its video codec is not known here; convert it to H.264 or H.265.")
    if not context.width * context.height:
        raise InputError(f"{path}: holds no whole picture; record it again.")
    if context.width * context.height > MAX_PIXELS:
        raise InputError(f"{path}: says that it is {context.width} x {context.height}, which is not a camera's image.")
    if container.format.name == "avi" and context.reorder_depth > 0:
        raise InputError(
            f"{path}: its pictures are stored out of order (B-frames), and AVI does not say when each is shown; record "
            "without B-frames, or into MKV or MP4."
        )


def tell_of_first_picture(path: Path, ends: Ends) -> None:
    """Warn of what only a decoded picture shows: being turned for showing, rows of two moments; and of more streams."""
    av = import_av()
    with open_video(path, ends) as (container, stream):
        frame = None
        try:
            for n, packet in enumerate(container.demux(stream)):
                frame = next(iter(packet.decode()), None)
                if frame is not None or n >= _PROBED_PACKETS:
                    break
        except av.error.FFmpegError as error:
            logger.debug("{}: the first picture cannot be decoded ({})", path, error)
        n_streams = len(container.streams.video)
    if n_streams > 1:
        logger.warning("{}: has {} video streams; only one is read", path, n_streams)
    if frame is not None and frame.rotation % 360:
        logger.warning(
            "{}: players turn it by {} degrees; its images stay as stored, {} x {}, and need intrinsics of that size",
            path,
            frame.rotation % 360,
            frame.width,
            frame.height,
        )
    if frame is not None and frame.interlaced_frame:
        logger.warning(
            "{}: is interlaced: every second row was taken later; only views where nothing moves are right", path
        )
