"""Length and pressure against time: what was measured, and what the model says before and after."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from tube.models import Outcome
from tube.recordings import Recording
from vinetrack.figures.style import BLUE, GREEN, INK, MUTED, ORANGE, VERMILLION, look

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw(recordings: Sequence[Recording], before: Outcome, after: Outcome) -> Figure:
    """A column a recording: length above, gauge pressure with starts and stops below."""
    from matplotlib.figure import Figure

    with look():
        fig = Figure(figsize=(13.0, 6.0), layout="constrained")
        axes = fig.subplots(2, len(recordings), height_ratios=(3, 2), sharex="col", sharey="row", squeeze=False)
        for k, one in enumerate(recordings):
            top, bottom = axes[0, k], axes[1, k]
            top.set_title(
                f"{one.name}\n{before.rms_of(one.name) * 1e3:.0f} → {after.rms_of(one.name) * 1e3:.0f} mm RMS"
            )
            y0 = one.lead_position_m[0]
            top.plot(one.time_s, (one.lead_position_m - y0) * 1e3, color=INK, lw=2.4, label="measured (reel's encoder)")
            for outcome, colour, dash in ((before, VERMILLION, (0, (4, 2))), (after, BLUE, "-")):
                (trial,) = (trial for trial in outcome.trials if trial.name == one.name)
                shown = (trial.predicted_position_m - y0) * 1e3
                top.plot(trial.time_s, shown, color=colour, ls=dash, label=outcome.name)
            bottom.plot(one.time_s, one.pressure_Pa / 1e3, color=MUTED, label="gauge pressure")
            for kind, marker, colour in (("start", "^", GREEN), ("stop", "v", ORANGE)):
                events = [event for event in one.events if event.kind == kind]
                bottom.plot(
                    [event.time_s for event in events],
                    [event.pressure_Pa / 1e3 for event in events],
                    marker, color=colour, ms=7, label=f"growth {kind}s",
                )  # fmt: skip
            bottom.set_xlabel("time (s)")
        axes[0, 0].set_ylabel("length grown (mm)")
        axes[1, 0].set_ylabel("gauge pressure (kPa)")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        more = axes[1, -1].get_legend_handles_labels()
        fig.legend(handles + more[0], labels + more[1], loc="outside upper center", ncols=3)
        return fig
