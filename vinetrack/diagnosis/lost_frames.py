"""Recordings with dropped frames: their times are corrected, and dropped frames beyond doubt become the verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace

from vinetrack.core.records import Track, Trial, plain_track, with_flag
from vinetrack.diagnosis.result import ARTEFACT, DROPPED_FRAMES, Diagnosis, Round
from vinetrack.inference.fit_data import Pairs
from vinetrack.inference.fit_result import Fit
from vinetrack.narrative.verdict_text import dropped_in_words, perhaps_dropped_in_words
from vinetrack.tracks.frame_timing import correct_frames, frames_surely_missing


@dataclass(frozen=True)
class LostFrames:
    """Trials that may have dropped frames, and those among them that have for certain."""

    trials: tuple[str, ...] = ()
    certain: tuple[str, ...] = ()

    def including(self, trial: str, track: Track) -> LostFrames:
        """Add a trial if its times were corrected for dropped frames."""
        if not with_flag(track.flag, "retimed").any():
            return self
        certain = (trial,) if frames_surely_missing(track) else ()
        return LostFrames((*self.trials, trial), (*self.certain, *certain))


def correct_dropped_frames(pairs: Pairs) -> tuple[list[tuple[Trial, Track]], LostFrames]:
    """Correct the times of tracks with dropped and repeated frames. Returns pairs, dropped."""
    corrected: list[tuple[Trial, Track]] = []
    dropped = LostFrames()
    for trial, track in pairs:
        if trial.video is None and not with_flag(track.flag, "retimed").any():
            track = correct_frames(track)
        dropped = dropped.including(trial.name, track)
        corrected.append((trial, track))
    return corrected, dropped


def dropped_frames_in(fit: Fit) -> LostFrames:
    """Find trials of a fit whose dropped frames were not corrected."""
    dropped = LostFrames()
    for trial_data in fit.predictor.data:
        track = correct_frames(plain_track(trial_data.time_s, trial_data.lead_position_m))
        dropped = dropped.including(trial_data.trial.name, track)
    return dropped


def with_lost_frames(result: Diagnosis, dropped: LostFrames) -> Diagnosis:
    """Put certain dropped frames first in a diagnosis, and its verdict with corrected times into a note. A jump that a
    few outlying points may have caused becomes a note only.
    """
    if not dropped.trials:
        return result
    if not dropped.certain:
        return replace(result, notes=(*result.notes, perhaps_dropped_in_words(dropped.trials)))
    first = result.rounds[0]
    words = dropped_in_words(dropped.trials)
    artefact = Round(
        model=first.model,
        verdict=ARTEFACT,
        answer_set=(DROPPED_FRAMES,),
        ranking=first.ranking,
        explanation=words,
        cosine_names=first.cosine_names,
        cosines=first.cosines,
        fit=first.fit,
    )
    note = f"With corrected times: {result.verdict}. {result.explanation}"
    return Diagnosis(
        rounds=(artefact,), effects=(), explanation=words, fits=result.fits[:1], notes=(note,), power=result.power
    )
