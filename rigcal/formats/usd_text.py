"""The text of USD files (usda), as far as cameras need it.

Owns      a tree of prims with their metadata and attributes from text, quoted strings for writing.
Leaves    what prims and attributes mean to usd. Composition (references, variants, layers) is not done here.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

# Deeper than any scene is nested.
MAX_DEPTH = 64

_TOKEN = re.compile(
    r"""
    (?P<space>  [\s;,]+ | \#[^\n]* )
  | (?P<string> \"\"\"(?:[^\\]|\\.)*?\"\"\" | '''(?:[^\\]|\\.)*?''' | "(?:[^"\\\n]|\\.)*" | '(?:[^'\\\n]|\\.)*' )
  | (?P<asset>  @[^@\n]*@ | <[^>\n]*> )
  | (?P<number> [-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)? )
  | (?P<word>   -?[^\W\d][\w:.]* (?:\[\])? )
  | (?P<sign>   [(){}\[\]=:.] )
    """,
    re.VERBOSE | re.DOTALL,
)
_ESCAPES = {"n": "\n", "t": "\t", "r": "\r"}
_CLOSING = {"(": ")", "[": "]"}
_SPECIFIERS = ("def", "over", "class")


class UsdTextError(ValueError):
    """A text that is no usda, or more than is understood here."""


@dataclass(slots=True)
class Prim:
    """One prim: what it is, what is said about it, its attributes' values, its children."""

    kind: str = ""
    name: str = ""
    metadata: dict[str, Any] = field(default_factory=dict)
    attributes: dict[str, Any] = field(default_factory=dict)
    children: list[Prim] = field(default_factory=list)


def quoted(text: str) -> str:
    """A string as usda writes it."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + escaped.replace("\n", "\\n").replace("\r", "\\r").replace("\t", "\\t") + '"'


def parsed(text: str) -> Prim:
    """The layer as a prim without a name; its metadata are the layer's.

    Raises:
        UsdTextError: It is no usda, or more than is understood here; the message says what and in which line.
    """
    return _Parser(text).layer()


class _Parser:
    def __init__(self, text: str) -> None:
        self._text = text
        self._tokens = self._scan()
        self._kind, self._word, self._at = "end", "", 0
        self._next()

    def layer(self) -> Prim:
        root = Prim(metadata=self._metadata())
        while self._kind != "end":
            root.children.append(self._prim(1))
        return root

    def _scan(self) -> Iterator[tuple[str, str, int]]:
        at = 0
        while at < len(self._text):
            found = _TOKEN.match(self._text, at)
            if found is None:
                self._at = at
                raise self._error(f"{self._text[at : at + 20]!r} is not understood")
            if found.lastgroup != "space":
                yield str(found.lastgroup), found.group(), at
            at = found.end()

    def _next(self) -> str:
        word = self._word
        self._kind, self._word, self._at = next(self._tokens, ("end", "", len(self._text)))
        return word

    def _error(self, what: str) -> UsdTextError:
        return UsdTextError(f"line {self._text.count(chr(10), 0, self._at) + 1}: {what}")

    def _expect(self, word: str) -> None:
        if self._word != word or self._kind not in ("sign", "word"):
            raise self._error(f"{self._word[:40]!r} stands where {word!r} should")
        self._next()

    def _is(self, *words: str) -> bool:
        return self._word in words and self._kind in ("sign", "word")

    def _prim(self, depth: int) -> Prim:
        if depth > MAX_DEPTH:
            raise self._error(f"prims are nested deeper than {MAX_DEPTH}")
        if not self._is(*_SPECIFIERS):
            raise self._error(f"{self._word[:40]!r} stands where a prim should")
        specifier = self._next()
        kind = self._next() if self._kind == "word" else ""
        if self._kind != "string":
            raise self._error("a prim has no name")
        prim = Prim(kind=kind if specifier == "def" else specifier, name=_unquoted(self._next()))
        prim.metadata = self._metadata()
        self._expect("{")
        while not self._is("}"):
            if self._is(*_SPECIFIERS):
                prim.children.append(self._prim(depth + 1))
            else:
                self._attribute(prim.attributes, depth)
        self._next()
        return prim

    def _attribute(self, into: dict[str, Any], depth: int) -> None:
        """``[qualifiers] type name = value (metadata)``; the last word before the equals sign is the name."""
        if self._kind == "end":
            raise self._error("the text ends in the middle of a prim")
        name = ""
        while self._kind in ("word", "string"):
            name = self._next()
        if not name:
            raise self._error(f"{self._word[:40]!r} stands where an attribute should")
        value = None
        if self._is("="):
            self._next()
            value = self._value(depth)
        into[name] = value
        self._metadata()

    def _metadata(self) -> dict[str, Any]:
        """What stands in round brackets after a layer's, prim's or attribute's head; a lone string is a comment."""
        found: dict[str, Any] = {}
        if not self._is("("):
            return found
        self._next()
        while not self._is(")"):
            if self._kind == "string":
                found["comment"] = _unquoted(self._next())
            else:
                self._entry(found, 1)
        self._next()
        return found

    def _entry(self, into: dict[str, Any], depth: int) -> None:
        """``[type] key = value`` of a dictionary, or ``time: value`` of samples."""
        words = []
        while self._kind in ("word", "string", "number"):
            words.append(self._next())
        if not words or not self._is("=", ":"):
            raise self._error(f"{self._word[:40]!r} stands where a key and its value should")
        self._next()
        into[_unquoted(words[-1])] = self._value(depth + 1)

    def _value(self, depth: int) -> Any:
        if depth > MAX_DEPTH:
            raise self._error(f"values are nested deeper than {MAX_DEPTH}")
        if self._kind == "number":
            return float(self._next())
        if self._kind in ("word", "asset"):
            return self._next()
        if self._kind == "string":
            return _unquoted(self._next())
        if self._is("("):
            return tuple(self._items(")", depth))
        if self._is("["):
            return list(self._items("]", depth))
        if self._is("{"):
            return self._dictionary(depth)
        raise self._error(f"{self._word[:40]!r} stands where a value should")

    def _items(self, closing: str, depth: int) -> Iterator[Any]:
        self._next()
        while not self._is(closing):
            yield self._value(depth + 1)
        self._next()

    def _dictionary(self, depth: int) -> dict[str, Any]:
        self._next()
        found: dict[str, Any] = {}
        while not self._is("}"):
            self._entry(found, depth)
        self._next()
        return found


def _unquoted(word: str) -> str:
    if word[:3] in ('"""', "'''"):
        word = word[3:-3]
    elif word[:1] in ('"', "'"):
        word = word[1:-1]
    else:
        return word
    return re.sub(r"\\(.)", lambda found: _ESCAPES.get(found[1], found[1]), word, flags=re.DOTALL)
