"""The files that levelling writes: poses, and beside them metrics and a page.

Owns      which there are, that none replaces an input or another, writing them.
Leaves    their contents to levelling and the report.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aruco.atomic import check_writable, part_of, write_all_whole
from aruco.errors import OutputError
from rigcal.cli import beside, refuse_clashes
from rigcal.formats import native
from rigcal.levelled_rig import Levelling
from rigcal.report.floor_page import floor_page
from rigcal.report.icp_page import icp_section
from rigcal.report.icp_table import remarks_of, sheets_of


@dataclass(frozen=True, slots=True, kw_only=True)
class LevellingOutputs:
    """Where everything goes."""

    poses: Path
    metrics: Path | None = None
    page: Path | None = None

    @staticmethod
    def asked_for(given: Mapping[str, Any]) -> LevellingOutputs:
        """The outputs that the options of the command name.

        Raises:
            OutputError: One would replace an input or another output, or cannot be written.
        """
        poses, page = given["output_extrinsics"], given["plot_output"]
        if given["plot"] and page is None:
            page = beside(poses, ".html")
        outputs = LevellingOutputs(poses=poses, metrics=given["metrics_json"], page=page)
        for path in outputs.paths:
            for option in ("input_extrinsics", "input_depth"):
                if path.resolve() == given[option].resolve():
                    flag = option.replace("_", "-")
                    raise OutputError(f"{path}: is --{flag}, an input, which is never changed; choose another name.")
        # What is written first must not replace what is still being written either.
        refuse_clashes([*outputs.paths, *(part_of(path.resolve()) for path in outputs.paths)])
        for path in outputs.paths:
            check_writable(path, b"<" if path == page else b"{")
        return outputs

    @property
    def paths(self) -> list[Path]:
        """All files that will be written, the poses last: they appear only beside all that was asked for."""
        return [path for path in (self.metrics, self.page, self.poses) if path is not None]

    def write(self, levelling: Levelling) -> None:
        """Write every file whole, or none of them.

        Raises:
            OutputError: One cannot be written.
        """
        contents: dict[Path, bytes] = {}
        if self.metrics is not None:
            icp = levelling.icp_note
            note = {"format": "rigcal.ground_refined", "version": 1, **levelling.note}
            note |= {} if icp is None else {"icp_refined": icp}
            contents[self.metrics] = native.json_bytes(note)
        if self.page is not None:
            contents[self.page] = _page(levelling).encode()
        contents[self.poses] = native.json_bytes(levelling.content)
        write_all_whole(contents)


def _page(levelling: Levelling) -> str:
    world = {"up_y": levelling.up_y, "floor_y": levelling.floor_y}
    found, more, above = levelling.registration, (), levelling.facts
    if found is not None:
        sheets = sheets_of(found.metrics, levelling.T_world_cam.keys(), found.given_bias, found.new_bias.keys())
        facts = (found.fact, *found.metrics.warnings)
        more = icp_section(levelling.clouds(), sheets, remarks_of(found.metrics), facts, **world)
        # What asks for something to be done is read at the top.
        above = (*above, "What follows is the rig before its clouds were registered; that stands below.", *facts)
    return floor_page(levelling.views(), levelling.figures, above, **world, more=more)
