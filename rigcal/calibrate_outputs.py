"""The files that a calibration writes: poses, and beside them a corrected marker map, pooled depth, a report.

Owns      which there are, that none replaces an input or another, collecting what goes into them, writing them.
Leaves    their layouts to native, marker_geometry, depth_save and the report.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from aruco.atomic import check_writable
from aruco.depth_save import CameraDepth, save_depth_data
from aruco.depth_verify import DepthAgreement
from aruco.marker_geometry import Face, save_faces
from aruco.model import Calibration
from rigcal.cli import beside, refuse_clashes, refuse_inputs, tell
from rigcal.formats.native import write_extrinsics
from rigcal.listeners import Listeners
from rigcal.report.depth_table import show_depth, write_report
from rigcal.report.terminal import console


@dataclass(eq=False)
class CalibrateOutputs:
    """Where everything goes, and what has been found of it so far."""

    poses: Path
    marker_map: Path | None = None
    depth: Path | None = None
    report: Path | None = None
    verify: bool = False
    faces: Sequence[Face] = ()
    pooled: Mapping[str, CameraDepth] = field(default_factory=dict)
    agreement: dict[str, DepthAgreement] = field(default_factory=dict)
    corrected: dict[str, DepthAgreement] = field(default_factory=dict)

    @staticmethod
    def asked_for(given: Mapping[str, Any]) -> CalibrateOutputs:
        """The outputs that the options of the command name.

        Raises:
            OutputError: One would replace an input or another output, or cannot be written.
        """
        poses = given["output"]
        outputs = CalibrateOutputs(
            poses=poses,
            marker_map=beside(poses, "_markers.parquet") if given["refine_target"] else None,
            depth=given["save_depth"],
            report=given["report_csv"],
            verify=given["verify_depth"],
        )
        begins = {outputs.poses: b"{", outputs.depth: b"\x89HDF", outputs.marker_map: b"PAR1"}
        for path in outputs.paths:
            refuse_inputs(path, [*given["svo"], *given["inputs"]], given["markers"], given["fix"])
            check_writable(path, begins.get(path, b""))
        refuse_clashes(outputs.paths)
        return outputs

    @property
    def paths(self) -> list[Path]:
        """All files that will be written."""
        return [p for p in (self.marker_map, self.depth, self.report, self.poses) if p is not None]

    @property
    def listeners(self) -> Listeners:
        """Those who collect what is found."""
        return Listeners(target=self._keep_faces, depth=self._keep_depth, agreement=self._keep_agreement)

    def _keep_faces(self, faces: Sequence[Face]) -> None:
        self.faces = faces

    def _keep_depth(self, pooled: Mapping[str, CameraDepth]) -> None:
        self.pooled = pooled

    def _keep_agreement(self, before: Mapping[str, DepthAgreement], after: Mapping[str, DepthAgreement]) -> None:
        self.agreement.update(before)
        self.corrected.update(after)

    def tell(self, calibration: Calibration) -> None:
        """Print the tables, and where everything went."""
        out = console()
        if self.verify:
            show_depth(out, self.agreement)
        if self.corrected:
            show_depth(out, self.corrected, corrected=True)
        tell(calibration, self.poses)
        for path, what in (
            (self.depth, f"the pooled depth of {len(self.pooled)} cameras"),
            (self.report, "every compared corner and face"),
        ):
            if path is not None:
                out.print(f"Wrote {what} to {path}", markup=False)

    def write(self, calibration: Calibration) -> None:
        """Write every file whole, the poses last; where that fails nothing new is left beside them.

        Raises:
            OutputError: One cannot be written.
        """
        new = [goal for path in self.paths if not (goal := path.resolve()).exists()]  # a link stays
        try:
            self._write_all(calibration)
        except BaseException:
            for goal in new:
                with suppress(OSError):
                    goal.unlink(missing_ok=True)
            raise

    def _write_all(self, calibration: Calibration) -> None:
        if self.marker_map is not None and self.faces:
            save_faces(self.marker_map, self.faces)
        if self.depth is not None:
            save_depth_data(self.depth, self.pooled)
        if self.report is not None:
            write_report(self.report, {**self.agreement, **self.corrected})
        write_extrinsics(self.poses, calibration)
