"""Reading other people's text files without trusting them.

Owns      a limit on size, UTF-8, the safe subset of YAML and XML, numbers in words; the sentence for each
          thing that is wrong.
Leaves    what the content means to each format.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
from loguru import logger

from aruco.errors import InputError
from aruco.pose_math import Array

MAX_FILE_BYTES = 64 * 2**20
# The YAML parser takes a second for 64 KiB; a camera takes about one.
MAX_YAML_BYTES = 2**20
# No length, angle, pixel or time stamp is larger; products of such numbers do not overflow.
MAX_NUMBER = 1e30


def read_text(path: Path, what: str, limit: int = MAX_FILE_BYTES) -> str:
    """A text file's content; ``what`` it should be, for messages.

    Raises:
        InputError: There is no such file, it is too large, or no UTF-8.
    """
    try:
        if path.exists() and not path.is_file():  # opening a pipe would wait for ever
            raise InputError(f"{path}: is not a file; give {what}.")
        with path.open("rb") as stream:
            raw = stream.read(limit + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path.") from error
    if len(raw) > limit:
        raise InputError(f"{path}: over {limit >> 10} KiB, which is not {what}.")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text ({error.reason} at byte {error.start}); give {what}.") from error


def warn_of_cut(text: str, path: Path) -> None:
    """Say that a file of lines ends within one: nobody can tell whether the last number or name there is whole."""
    if not is_of_whole_lines(text):
        logger.warning(
            "{}: ends without the end of a line; if it was cut short, its last number or name is not whole, so copy it "
            "again",
            path,
        )


def is_of_whole_lines(text: str) -> bool:
    """Whether a text ends where a line ends, or holds nothing."""
    return not text.strip() or text.endswith(("\n", "\r"))


def read_yaml(path: Path, what: str) -> dict[str, Any]:
    """The mapping at the root of a YAML file; every scalar is left a text.

    Raises:
        InputError: It cannot be read, or its root is none.
    """
    text = read_text(path, what, MAX_YAML_BYTES)
    content = yaml_mapping(text, path, what)
    warn_of_cut(text, path)
    return content


class _TwinsError(ValueError):
    """Two keys of one name, of which YAML's parser would silently lose one."""


class _Loader(yaml.BaseLoader):
    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    raise _TwinsError(f"line {key.start_mark.line + 1}: {key.value[:80]!r} is there twice")
                seen.add(key.value)
        return super().construct_mapping(node, deep=deep)


def yaml_mapping(text: str, path: Path, what: str) -> dict[str, Any]:
    """The same, of a text that was read, without a directive such as OpenCV's %YAML:1.0, which is no YAML."""
    text = re.sub(r"\A%YAML[^\r\n]*", "", text)  # the line stays: messages count lines
    try:
        # The base loader makes no objects: safer than the safe one, and YAML 1.1's idea that 1e-05 is a word and
        # 010 is eight does not matter.
        content = yaml.load(text, Loader=_Loader)
    except _TwinsError as error:
        raise InputError(f"{path}: {error}; rename or remove one of them.") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: not readable as YAML ({reason}); give {what}.") from error
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise InputError(f"{path}: holds no keys; give {what}.")
    return content


def parsed_xml(text: str, path: Path, what: str) -> ElementTree.Element:
    """The root of an XML file's text; document types and entities, which can swell without end, are refused.

    Raises:
        InputError: It is no XML, or has a document type.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path}: has a DOCTYPE or ENTITY, which is not read; remove it, {what} needs none.")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{path}: not readable as XML ({error}); give {what}.") from error


@contextmanager
def placed(where: str) -> Iterator[None]:
    """Put the place in front of what is wrong there."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def word(value: object) -> str:
    """A text; empty where there is none."""
    return value if isinstance(value, str) else ""


def number(value: object, where: str) -> float:
    """A finite number, given as a number or in words.

    Raises:
        InputError: It is none; ``where`` names file and key.
    """
    try:
        if isinstance(value, str | int | float) and not isinstance(value, bool):
            found = float(value)
            if abs(found) <= MAX_NUMBER:  # NaN is not
                return found
    except (ValueError, OverflowError):
        pass
    raise InputError(f"{where} must be an ordinary number, got {_shown(value)}.")


def _shown(value: object) -> str:
    # Only what is short for sure: references let a short file hold a value that prints without end.
    return repr(value)[:40] if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"


def whole(value: object, where: str) -> int:
    """A number without sign and fraction, at most nine digits.

    Raises:
        InputError: It is none.
    """
    if not isinstance(value, bool) and isinstance(value, str | int | float):
        word = str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)
        if re.fullmatch("[0-9]{1,9}", word):
            return int(word)
    raise InputError(f"{where} must be a whole number, got {_shown(value)}.")


def numbers(value: object, where: str, count: int | None = None) -> Array:
    """A list of finite numbers, (count,), or (n,) of any length.

    Raises:
        InputError: It is none, or of another length.
    """
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise InputError(f"{where} must be a list of numbers.")
    if count is not None and len(value) != count:
        raise InputError(f"{where} must be {count} numbers, got {len(value)}.")
    return np.array([number(item, where) for item in value], dtype=np.float64)


def size(value: object, where: str) -> tuple[int, int]:
    """A list of width and height.

    Raises:
        InputError: It is none.
    """
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(f"{where} must be a list of width and height.")
    return whole(value[0], where), whole(value[1], where)


def matrix(value: object, where: str, shape: tuple[int, int]) -> Array:
    """A list of rows, (rows, cols).

    Raises:
        InputError: It is none, or of another shape.
    """
    rows = value if isinstance(value, list) else []
    if len(rows) != shape[0] or not all(isinstance(row, list) and len(row) == shape[1] for row in rows):
        raise InputError(f"{where} must be a list of {shape[0]} rows of {shape[1]} numbers.")
    return np.array([numbers(row, where, shape[1]) for row in rows])
