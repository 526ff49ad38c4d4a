"""Follow what moves along an axis, by frame: the edge of a tube, a body, or else the arrival of whatever comes."""

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

DISAGREEMENT_PX = 1.0  # Disagreement of bands above which some band follows something other than the edge (chosen)
LARGEST_AMPLITUDE = 1.5  # Amplitude (relative contrast) above which something adds to the edge (chosen)
# A frame whose misfit is this many times the median one, taken as at least LEAST_MISFIT, is doubtful (chosen)
MISFIT_RATIO, LEAST_MISFIT = 6.0, 0.3
# A point with a larger standard error, and one this many times the median, is doubtful (chosen)
UNCERTAIN_PX, UNCERTAIN_RATIO = 1.0, 5.0


@dataclass(frozen=True)
class Positions:
    """Positions along the axis by frame, px, from any of the trackers; arrays of shape (n_frames,)."""

    edge_px: Floats
    sigma_px: Floats
    unsure: Bools
    blur_px: float
    exposure_frames: float
    reach_px: float
    extra_sigma_px: Floats | float = 0.0
    bands_sigma_px: Floats | float = 0.0
    slow_px: Floats | float = SLOW_PX
    end: BodyEnd | None = None
    width_px: tuple[float, float] = (math.nan, math.nan)
    seen_exposure: tuple[float, float] = (math.nan, math.nan)
    is_edge: bool = True


def follow(
    luma: NDArray[Any], trial: Trial, axis: Axis, exposure_frames: float, front_share_of: FrontShare
) -> tuple[Strip, Positions]:
    """Follow a body (travel ratio 1) or the edge of a tube; where there is no tube, the arrival of whatever comes.
    Returns the strip, centred on what moves along the axis, and the positions along it. Shapes: luma (n_frames, height,
    width).
    """
    try:
        if trial.travel_ratio == 1:
            return _body(luma, axis, exposure_frames)
        return _edge(luma, axis, exposure_frames, front_share_of) or _arrival(luma, axis, exposure_frames)
    except ValueError as error:
        raise RecordingError(str(error)) from error


def _body(luma: NDArray[Any], axis: Axis, exposure_frames: float) -> tuple[Strip, Positions]:
    """Register a body against itself."""
    from vinetrack.video.body import track_body

    strip = cut_along(luma, axis, 0.75 * axis.width_px + 12)
    fit = track_body(strip)
    position_px = np.where(fit.unseen, np.nan, fit.position_px)
    return strip, Positions(
        position_px, fit.sigma_px, fit.unsure, fit.half_px, exposure_frames, fit.half_px, end=fit.end
    )  # fmt: skip


def _edge(
    luma: NDArray[Any], axis: Axis, exposure_frames: float, front_share_of: FrontShare
) -> tuple[Strip, Positions] | None:
    """Track the edge of a tube; None where there is no tube along the axis."""
    from vinetrack.video.edge import track_edge
    from vinetrack.video.tube_strip import tube_strip

    outlined = tube_strip(luma, axis, front_share_of)
    if outlined is None:
        return None
    strip, tube = outlined
    fit = track_edge(strip, exposure_frames, sides=tube)
    reach = 3 * fit.blur_px + 1
    return strip, Positions(
        fit.edge_px, fit.sigma_px, _unsure(fit), fit.blur_px, fit.exposure_frames, reach,
        fit.extra_sigma_px, fit.bands_sigma_px, fit.slow_px, width_px=(tube.width_px, tube.width_sigma_px),
        seen_exposure=(fit.seen_exposure_frames, fit.fast_px_per_frame),
    )  # fmt: skip


def _arrival(luma: NDArray[Any], axis: Axis, exposure_frames: float) -> tuple[Strip, Positions]:
    """Follow the arrival of whatever comes along the axis, of any width and direction, to about a pixel."""
    from vinetrack.video.kymograph import track_arrival

    strip = cut_along(luma, axis, min(4 * axis.width_px, 0.3 * max(luma.shape[1:])))
    edge, sigma = track_arrival(strip)
    unsure = np.zeros(len(edge), dtype=bool)
    return strip, Positions(edge, sigma, unsure, 1.0, exposure_frames, 2.0, slow_px=ARRIVAL_PX, is_edge=False)


def _unsure(fit: EdgeFit) -> Bools:
    """Frames in which the fit of the edge is poor: odd contrast, large misfit, disagreeing bands, hidden, uncertain."""
    from vinetrack.video.hidden_tip import LEAST_AMPLITUDE

    median_misfit = float(np.nanmedian(fit.misfit))
    poor = (fit.amplitude < LEAST_AMPLITUDE) | (fit.amplitude > LARGEST_AMPLITUDE)
    poor = poor | (fit.misfit > MISFIT_RATIO * max(median_misfit, LEAST_MISFIT))
    poor |= (fit.extra_sigma_px > DISAGREEMENT_PX) | fit.hidden
    uncertain = fit.sigma_px > np.maximum(UNCERTAIN_PX, UNCERTAIN_RATIO * np.nanmedian(fit.sigma_px))
    return np.asarray(poor | uncertain)
