"""Times of a file with too few digits are replaced by the even series that they were."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vinetrack.tracks.importers import TrackError, read_track, unrounded_times


@pytest.mark.parametrize(
    ("rate_hz", "digits"), [(240.0, 3), (240.0, 4), (1069.0, 3), (1069.0, 4), (2400.0, 3), (2400.0, 4)]
)
def test_rounded_times_of_even_frames_become_even(rate_hz: float, digits: int) -> None:
    for seed in range(5):
        begin_s = float(np.random.default_rng(seed).uniform(0, 0.3))
        true_s = begin_s + np.arange(150) / rate_hz
        restored_s, note = unrounded_times(np.round(true_s, digits))
        # Less than a fifth of what rounding does, but for a shift of them all.
        off_s = restored_s - true_s
        assert np.max(np.abs(off_s - off_s.mean())) < 0.1 * 10.0**-digits
        assert note.startswith(f"Times are rounded to {10.0 ** (3 - digits):g} ms")
        cut_s, _ = unrounded_times(np.floor(true_s * 10**digits) / 10**digits)
        off_s = cut_s - true_s
        assert np.max(np.abs(off_s - off_s.mean())) < 0.1 * 10.0**-digits


@pytest.mark.parametrize(
    "time_s",
    [
        np.arange(100) / 500,
        np.arange(100) / 1069,
        np.round(np.arange(100) / 1069, 6),
        np.round(np.delete(np.arange(100), [40, 41]) / 1069, 3),
        np.round(np.cumsum(np.random.default_rng(2).uniform(0.5e-3, 1.5e-3, 100)), 3),
        np.array([0.0, 0.001, 0.002, 0.002, 0.003]),
        np.zeros(20),
    ],
    ids=["even to the digit", "not rounded", "to the microsecond", "frames are missing", "uneven", "few", "standing"],
)
def test_other_times_stay_as_they_are(time_s: np.ndarray) -> None:
    kept_s, note = unrounded_times(time_s)
    assert kept_s is time_s
    assert note == ""


def test_a_file_with_times_to_the_millisecond_is_read_and_says_so(tmp_path: Path) -> None:
    rows = [f"{k / 1069:.3f},{1e-3 * k**1.5:.6f}" for k in range(60)]
    (tmp_path / "a.csv").write_text("\n".join(["time_s,position_m", *rows]) + "\n", encoding="utf-8")
    track = read_track(tmp_path / "a.csv")
    assert np.diff(track.time_s) == pytest.approx(1 / 1069, rel=2e-3)
    assert any("rounded to 1 ms" in note for note in track.notes)
    exported = ["mass_A\t\t", "t\tx\ty", *(f"{k / 1069:.3f}\t{1e-3 * k**1.5:.6f}\t0.0" for k in range(60))]
    (tmp_path / "b.txt").write_text("\n".join(exported) + "\n", encoding="utf-8")
    assert np.diff(read_track(tmp_path / "b.txt").time_s) == pytest.approx(1 / 1069, rel=2e-3)
    rows[30] = rows[10]
    (tmp_path / "c.csv").write_text("\n".join(["time_s,position_m", *rows]) + "\n", encoding="utf-8")
    with pytest.raises(TrackError, match="does not increase"):
        read_track(tmp_path / "c.csv")
