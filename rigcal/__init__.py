"""The rig: recordings, the stories that turn them into poses, and their reports."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("rigcal")
except PackageNotFoundError:  # run from a checkout that is not installed
    __version__ = "unknown"
