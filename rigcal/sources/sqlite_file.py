"""An SQLite file, opened so that nothing is written: neither in it nor beside it.

Owns      the ways to open one, also one that is cut off, or whose last changes lie in a log (-wal) beside it.
Leaves    tables to rosbag2_sqlite.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from loguru import logger

# A complaint about a damaged file may hold bytes of it that are no text.
# MemoryError: a damaged file can state a size that SQLite then asks for.
DATABASE_ERRORS = (sqlite3.Error, UnicodeDecodeError, MemoryError)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Way:
    """How a file is opened."""

    option: str  # further to "mode=ro"
    reads_log: bool = False
    is_cut: bool = False


# Immutable: SQLite then makes no files of its own beside this one, and looks for none.
_WITHOUT_LOG = (_Way(option="immutable=1"), _Way(option="immutable=1", is_cut=True))
# A log has an index (-shm). One that is there is left as it is; only if there is none SQLite must make it.
_WITH_LOG = (_Way(option="readonly_shm=1", reads_log=True), _Way(option="", reads_log=True))


class SqliteFile:
    """One file; nothing stays open."""

    def __init__(self, path: Path) -> None:
        """Find the way to open it. If there is none, ``connected`` says what is wrong."""
        self._path = path.resolve()
        self._log_index = self._path.with_name(f"{self._path.name}-shm")
        self._had_log_index = self._log_index.exists()
        log = self._path.with_name(f"{self._path.name}-wal")
        has_log = log.is_file() and log.stat().st_size > 0
        ways = (*_WITH_LOG, *_WITHOUT_LOG) if has_log else _WITHOUT_LOG
        self._way = next(filter(self._works, ways), ways[-1])
        if has_log and not self._way.reads_log:
            logger.warning(
                "{}: what was recorded last lies in {} and cannot be read; copy both to a folder that can be written",
                path,
                log.name,
            )

    @contextmanager
    def connected(self) -> Iterator[sqlite3.Connection]:
        """A connection that reads; raises DATABASE_ERRORS where the file is none of SQLite's."""
        with self._opened(self._way) as base:
            yield base

    def _works(self, way: _Way) -> bool:
        try:
            with self._opened(way) as base:
                base.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchall()
        except DATABASE_ERRORS:
            return False
        return True

    @contextmanager
    def _opened(self, way: _Way) -> Iterator[sqlite3.Connection]:
        base = sqlite3.connect(f"file:{quote(str(self._path))}?mode=ro&{way.option}", uri=True)
        try:
            base.text_factory = lambda raw: raw.decode("utf-8", "replace")
            base.execute("PRAGMA trusted_schema=OFF")
            if way.is_cut:
                # SQLite refuses a file that is shorter than it says unless the schema is called writable, which it is
                # not: the file is opened to be read.
                base.execute("PRAGMA writable_schema=ON")
            yield base
        finally:
            base.close()
            if way.reads_log and not self._had_log_index:
                with suppress(OSError):  # of a file that another thread has open, on Windows: that one takes it away
                    self._log_index.unlink(missing_ok=True)
