"""The error tree: everything a user can cause or cure.

    RigError
    ├── InputError       a file, folder or value that cannot be used as it is
    ├── OutputError      a place that cannot be written
    ├── CalibrationError the data are readable but do not determine the answer
    └── MissingExtraError an optional package is not installed

A message says what is wrong, where, and what to do next, in one sentence or two. Anything that is
not a RigError is a bug.
"""

from __future__ import annotations


class RigError(Exception):
    """Base of every error that a user can cause or cure."""


class InputError(RigError):
    """A file, folder or value that cannot be used as it is."""


class OutputError(RigError):
    """A place that cannot be written."""


class CalibrationError(RigError):
    """Readable data that do not determine the answer."""


class MissingExtraError(RigError):
    """An optional package that this step needs is not installed."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"This step needs {package}; install it with: pip install 'rigcal[{extra}]'")
