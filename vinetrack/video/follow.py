"""Positions along the axis, frame by frame, from whichever way of following fits what moves: edge, body, or arrival."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats, Trial
from vinetrack.video.axis import Axis, FrontShare
from vinetrack.video.curved_strip import cut_along
from vinetrack.video.frames import RecordingError
from vinetrack.video.slow_errors import ARRIVAL_PX, SLOW_PX
from vinetrack.video.strip import Strip

if TYPE_CHECKING:
    from vinetrack.video.body import BodyEnd
    from vinetrack.video.edge import EdgeFit

APART_PX = 1.0
"""Bands of the edge that disagree by more cannot all be its own. Chosen: 25 times FLOOR_PX. By reasoning: at half tips
of crumpled film count as doubtful, at twice an edge half behind a door does not."""
BRIGHT = 1.5
"""Amplitude above which something else adds to the edge. Chosen about as far above 1 as PALE of `hidden_tip` lies
below, in ratio. By reasoning: nearer 1 glints make points doubtful; at twice payloads before the edge pass."""
ODD_RATIO, LEAST_MISFIT = 6.0, 0.3
"""A frame that fits so many times worse than usual is doubtful, where usual is no less than this. Chosen: a compressed
picture at rest leaves hardly any misfit. By reasoning: at half textured film makes points doubtful; at twice a hand
before the tip does not."""
VAGUE_PX, VAGUE_RATIO = 1.0, 5.0
"""A point known worse than this, and so many times worse than usual, is doubtful. Chosen as APART_PX; the ratio spares
recordings in which all points are vague. At half fast frames of blurred recordings are doubtful, at twice none is."""


@dataclass(frozen=True)
class Positions:
    """Positions along the axis by frame, px, from whichever way of following.

    `reach_px` is what must be seen ahead of one; `is_edge` is False where only the arrival of whatever comes along the
    axis was followed, to about a pixel.
    """

    edge_px: Floats
    sigma_px: Floats
    unsure: Bools
    blur_px: float
    exposure_frames: float
    reach_px: float
    apart_sigma_px: Floats | float = 0.0
    bands_sigma_px: Floats | float = 0.0
    slow_px: Floats | float = SLOW_PX
    end: BodyEnd | None = None
    width_px: tuple[float, float] = (math.nan, math.nan)
    seen_exposure: tuple[float, float] = (math.nan, math.nan)
    is_edge: bool = True


def follow(
    luma: NDArray[Any], trial: Trial, axis: Axis, exposure_frames: float, order: FrontShare
) -> tuple[Strip, Positions]:
    """Follow what moves along an axis: a body (travel ratio 1), the edge of a tube, or else whatever arrives.

    Parameters
    ----------
    luma : brightness, shape (n_frames, height, width).
    trial : its travel ratio.
    axis : with the width of what moves along it, px.
    exposure_frames : exposure over frame period; NaN where unknown.
    order : share of what changes along the axis that is a front passing once, see `axis.front_share`.

    Returns
    -------
    the strip, centred on what moves along the axis, and the positions along it.

    Raises
    ------
    RecordingError
        Where nothing moves along the axis.
    """
    try:
        if trial.travel_ratio == 1:
            return _body(luma, axis, exposure_frames)
        return _edge(luma, axis, exposure_frames, order) or _arrival(luma, axis, exposure_frames)
    except ValueError as error:
        raise RecordingError(str(error)) from error


def _body(luma: NDArray[Any], axis: Axis, exposure_frames: float) -> tuple[Strip, Positions]:
    from vinetrack.video.body import track_body

    strip = cut_along(luma, axis, 0.75 * axis.width_px + 12)
    fit = track_body(strip)
    place = np.where(fit.unseen, np.nan, fit.position_px)
    return strip, Positions(place, fit.sigma_px, fit.unsure, fit.half_px, exposure_frames, fit.half_px, end=fit.end)


def _edge(luma: NDArray[Any], axis: Axis, exposure_frames: float, order: FrontShare) -> tuple[Strip, Positions] | None:
    """The edge of a tube; None where there is no tube along the axis."""
    from vinetrack.video.edge import track_edge
    from vinetrack.video.tube_strip import tube_strip

    about = tube_strip(luma, axis, order)
    if about is None:
        return None
    strip, sides = about
    front = track_edge(strip, exposure_frames, sides=sides)
    reach = 3 * front.blur_px + 1
    return strip, Positions(
        front.edge_px, front.sigma_px, _unsure(front), front.blur_px, front.exposure_frames, reach,
        front.apart_sigma_px, front.bands_sigma_px, front.slow_px, width_px=(sides.width_px, sides.width_sigma_px),
        seen_exposure=(front.seen_exposure_frames, front.fast_px_per_frame),
    )  # fmt: skip


def _arrival(luma: NDArray[Any], axis: Axis, exposure_frames: float) -> tuple[Strip, Positions]:
    """Strip and positions of whatever comes along the axis, of no width or direction, to about a pixel."""
    from vinetrack.video.kymograph import track_arrival

    strip = cut_along(luma, axis, min(4 * axis.width_px, 0.3 * max(luma.shape[1:])))
    edge, sigma = track_arrival(strip)
    unsure = np.zeros(len(edge), dtype=bool)
    return strip, Positions(edge, sigma, unsure, 1.0, exposure_frames, 2.0, slow_px=ARRIVAL_PX, is_edge=False)


def _unsure(fit: EdgeFit) -> Bools:
    """Frames whose neighbourhood does not look like the edge elsewhere."""
    from vinetrack.video.hidden_tip import PALE

    usual = float(np.nanmedian(fit.misfit))
    odd = (fit.amplitude < PALE) | (fit.amplitude > BRIGHT) | (fit.misfit > ODD_RATIO * max(usual, LEAST_MISFIT))
    odd |= (fit.apart_sigma_px > APART_PX) | fit.hidden
    vague = fit.sigma_px > np.maximum(VAGUE_PX, VAGUE_RATIO * np.nanmedian(fit.sigma_px))
    return np.asarray(odd | vague)
