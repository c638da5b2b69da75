"""JSON texts changed in a few places, with everything else kept to the character.

Owns      finding where an object's members stand in a text, and putting other words there.
Leaves    what the members mean to the formats. The text must have been parsed once: it is not checked here.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass

_SPACE = re.compile(r"[ \t\r\n]*")
_DECODER = json.JSONDecoder()


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """Where a member of an object stands: its key begins at ``key``, its value is ``text[start:end]``."""

    key: int
    start: int
    end: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Edit:
    """``text[start:end]`` becomes ``words``."""

    start: int
    end: int
    words: str


def members(text: str, start: int = 0) -> list[tuple[str, Span]]:
    """The members of the object that begins at ``start`` or after spaces there, in order, twins among them.

    Raises:
        ValueError: There is no object.
    """
    at = _skip(text, start)
    if text[at : at + 1] != "{":
        raise ValueError("not an object")
    found: list[tuple[str, Span]] = []
    at = _skip(text, at + 1)
    while text[at : at + 1] == '"':
        key, after = _DECODER.raw_decode(text, at)
        first = _skip(text, _skip(text, after) + 1)  # past the colon
        _, end = _DECODER.raw_decode(text, first)
        found.append((key, Span(key=at, start=first, end=end)))
        comma = _skip(text, end)
        at = _skip(text, comma + 1) if text[comma : comma + 1] == "," else comma
    return found


def before(text: str, span: Span, member: str) -> Edit:
    """Put a member (``"key": value``) before another one, laid out as that one is."""
    space = text[len(text[: span.key].rstrip(" \t\r\n")) : span.key]
    return Edit(start=span.key, end=span.key, words=f"{member},{space or ' '}")


def edited(text: str, edits: Iterable[Edit]) -> str:
    """The text after all edits, which must not overlap."""
    for edit in sorted(edits, key=lambda edit: edit.start, reverse=True):
        text = text[: edit.start] + edit.words + text[edit.end :]
    return text


def _skip(text: str, at: int) -> int:
    found = _SPACE.match(text, at)
    return found.end() if found else at
