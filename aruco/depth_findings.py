"""What a refinement with depth means, in words.

Owns      sentences about each camera's bias, and about why the result is believed.
Leaves    the result to depth_refine, sentences about a comparison with the target to depth_words.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aruco.depth_bias import DepthBias
from aruco.depth_tiles import Tiles
from aruco.depth_trial import Trial


def why_believed(trial: Trial, *, moves: bool) -> str:
    """Why the result is believed, and what could not be asked."""
    figures = trial.figures
    if not moves:
        mm = figures.depth_mm
        tested = f"{mm[0]:.3g} mm before, {mm[1]:.3g} mm after" if figures.n_patches else "there was none to hold out"
        return f"{trial.against_move}; poses stay, biases are taken out of depth (held-out depth: {tested})"
    tested = [what for what, n in (("markers", figures.n_markers), ("depth", figures.n_patches)) if n]
    untested = [name for name, growth in figures.growth.items() if not growth.n_markers]
    if not tested:
        return "there was nothing to hold out, so nothing was tested"
    said = f"{' and '.join(tested)} that took no part {'are' if figures.n_markers else 'is'} predicted at least as well"
    if not figures.n_markers:
        return f"{said}; no markers could be held out"
    if untested:
        said += f"; no markers of camera {', camera '.join(untested)} could be held out"
    return said if figures.n_patches else f"{said}; no depth could be held out"


def finding(bias: DepthBias | None, held: NDArray[np.bool_], tiles: Tiles) -> str:
    """What a camera's depth tells on its tiles, in words."""
    if bias is None or not len(tiles):
        return "too little depth on target and floor to tell its bias"
    assert bias.covariance is not None, "it was estimated"
    sigma = np.sqrt(np.diag(bias.covariance))
    near, far = (1.0 / tiles.inverse.max(), 1.0 / tiles.inverse.min())
    where = f"on {len(tiles)} patches from {near:.1f} to {far:.1f} m"
    second = _second(bias, float(sigma[1]))
    middle = np.array([float(np.median(1.0 / tiles.inverse))])
    off_mm = 1e3 * float(middle[0] - bias.corrected(middle)[0])
    side = f"{abs(off_mm):.0f} mm too {'far' if off_mm > 0 else 'near'} at {middle[0]:.1f} m"
    if held[0]:
        what = "offset" if bias.model == "offset" else "disparity"
        return f"ranges {where} do not tell scale from {what}: scale is left at 0, {second}; {side}"
    return f"scale {100 * bias.scale:+.2f} +- {100 * sigma[0]:.2f} %, {second}, {where}; {side}"


def _second(bias: DepthBias, sigma: float) -> str:
    if bias.model == "offset":
        return f"offset {1e3 * bias.offset_m:+.1f} +- {1e3 * sigma:.1f} mm"
    if bias.focal_baseline is None:
        return f"inverse depth {bias.inverse_depth:+.5f} +- {sigma:.5f} 1/m"
    return f"disparity {bias.disparity_px:+.3f} +- {sigma * bias.focal_baseline:.3f} px"
