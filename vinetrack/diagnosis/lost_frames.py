"""Recordings from which frames are missing: their times put right, and said first where that is beyond doubt."""

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
    """Trials from which frames are missing, and those among them of which that is sure."""

    trials: tuple[str, ...] = ()
    certain: tuple[str, ...] = ()

    def beside(self, trial: str, track: Track) -> LostFrames:
        """With a trial whose track, its times put right, may have lost frames.

        Parameters
        ----------
        trial : str
        track : Track

        Returns
        -------
        LostFrames
        """
        if not with_flag(track.flag, "retimed").any():
            return self
        certain = (trial,) if frames_surely_missing(track) else ()
        return LostFrames((*self.trials, trial), (*self.certain, *certain))


def correct_dropped_frames(pairs: Pairs) -> tuple[list[tuple[Trial, Track]], LostFrames]:
    """Tracks with dropped and repeated frames put right, and the trials from which frames are missing.

    Parameters
    ----------
    pairs : (Trial, Track) of every trial

    Returns
    -------
    pairs : list of (Trial, Track)
    missing : LostFrames
    """
    right: list[tuple[Trial, Track]] = []
    missing = LostFrames()
    for trial, track in pairs:
        if trial.video is None and not with_flag(track.flag, "retimed").any():
            track = correct_frames(track)
        missing = missing.beside(trial.name, track)
        right.append((trial, track))
    return right, missing


def lost_in_fit(fit: Fit) -> LostFrames:
    """Trials of a fit from which frames are missing that nobody has put right.

    Parameters
    ----------
    fit : the fit that is questioned.

    Returns
    -------
    LostFrames
    """
    missing = LostFrames()
    for trial_data in fit.predictor.data:
        track = correct_frames(plain_track(trial_data.time_s, trial_data.lead_position_m))
        missing = missing.beside(trial_data.trial.name, track)
    return missing


def with_lost_frames(result: Diagnosis, missing: LostFrames) -> Diagnosis:
    """Missing frames said first where they are sure, with what follows from the times put right as a note.

    A jump that a few points with heavy tails may have made is a note itself.

    Parameters
    ----------
    result : what the trials say with their times put right.
    missing : LostFrames

    Returns
    -------
    Diagnosis
    """
    if not missing.trials:
        return result
    if not missing.certain:
        return replace(result, notes=(*result.notes, perhaps_dropped_in_words(missing.trials)))
    first = result.rounds[0]
    words = dropped_in_words(missing.trials)
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
    note = f"With the times put right: {result.verdict}. {result.explanation}"
    return Diagnosis(
        rounds=(artefact,), effects=(), explanation=words, fits=result.fits[:1], notes=(note,), power=result.power
    )
