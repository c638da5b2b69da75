"""The end of levelling in a terminal: every camera's floor before and after, and what was done."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rigcal.report.floor_views import FloorFigures, told

if TYPE_CHECKING:
    from rich.console import Console

_TITLE = "Every camera's floor against the common one; before: when the rig had been moved as a whole only"


def show_levelling(out: Console, figures: Sequence[FloorFigures], facts: Sequence[str]) -> None:
    """Print the table, and below it what holds for the whole rig."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=_TITLE, title_justify="left")
    table.add_column("camera")
    for name in ("tilt deg\nbefore", "tilt deg\nafter", "height mm\nbefore", "height mm\nafter",
                 "turned by\ndegrees", "raised by\nmm"):  # fmt: skip
        table.add_column(name, justify="right")
    table.add_column("outcome")
    for f in figures:
        table.add_row(
            escape(f.camera),
            told(f.tilt_before_deg, ".3f"),
            told(f.tilt_after_deg, ".3f"),
            told(f.height_before_mm, "+.1f"),
            told(f.height_after_mm, "+.1f"),
            told(f.turned_deg, ".3f"),
            told(f.raised_mm, "+.1f"),
            escape(f.outcome),
        )
    out.print(table)
    for f in figures:
        if f.reason:
            out.print(f"{f.outcome}: camera {f.camera}: {f.reason}", markup=False)
    for fact in facts:
        out.print(fact, markup=False)
