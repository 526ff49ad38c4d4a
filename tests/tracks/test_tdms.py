"""Pressure traces in TDMS files, written byte by byte after the description of the format."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vinetrack.tracks.importers import TrackError, read_pressure_trace

CODES = {"<i2": 2, "<i4": 3, "<u1": 5, "<f4": 9, "<f8": 10, ">f8": 10, ">i2": 2}
TIME_S = np.arange(12) * 2e-3 + 0.1
PRESSURE_KPA = 20 + np.arange(12) ** 2 / 8.0
KEPT, NO_RAW = 0, 0xFFFFFFFF


def text(words: str, order: str = "<") -> bytes:
    return struct.pack(f"{order}I", len(words.encode())) + words.encode()


def entry(path: str, values: np.ndarray | int, order: str = "<", **properties: float | str) -> bytes:
    """Layout and properties of one object; `values` an array, or KEPT or NO_RAW."""
    out = text(path, order)
    if isinstance(values, int):
        out += struct.pack(f"{order}I", values)
    else:
        out += struct.pack(
            f"{order}IIIQ", 20, CODES[values.dtype.newbyteorder(order).str.replace("|", "<")], 1, len(values)
        )
    out += struct.pack(f"{order}I", len(properties))
    for name, value in properties.items():
        out += text(name, order)
        is_text = isinstance(value, str)
        out += struct.pack(f"{order}I", 0x20 if is_text else 10)
        out += text(value, order) if is_text else struct.pack(f"{order}d", value)
    return out


def segment(entries: list[bytes], raw: bytes, order: str = "<", flags: int = 0, new_list: bool = True) -> bytes:
    meta = struct.pack(f"{order}I", len(entries)) + b"".join(entries) if entries else b""
    mask = (
        flags
        | (2 if entries else 0)
        | (4 if new_list and entries else 0)
        | (8 if raw else 0)
        | (64 if order == ">" else 0)
    )
    lead_in = b"TDSm" + struct.pack("<I", mask) + struct.pack(f"{order}IQQ", 4713, len(meta) + len(raw), len(meta))
    return lead_in + meta + raw


def read(tmp_path: Path, *segments: bytes) -> tuple[np.ndarray, np.ndarray]:
    path = tmp_path / "trace.tdms"
    path.write_bytes(b"".join(segments))
    return read_pressure_trace(path)


def two_channels(order: str = "<", flags: int = 0) -> bytes:
    time, pressure = TIME_S.astype(f"{order}f8"), PRESSURE_KPA.astype(f"{order}f8")
    entries = [entry("/", NO_RAW, order), entry("/'g'", NO_RAW, order), entry("/'g'/'time_s'", time, order),
               entry("/'g'/'pressure_kPa'", pressure, order)]  # fmt: skip
    raw = np.column_stack([time, pressure]).tobytes() if flags else time.tobytes() + pressure.tobytes()
    return segment(entries, raw, order, flags)


@pytest.mark.parametrize(
    ("order", "flags"), [("<", 0), (">", 0), ("<", 32)], ids=["plain", "big endian", "interleaved"]
)
def test_times_and_pressures_come_out_as_they_were_written(tmp_path: Path, order: str, flags: int) -> None:
    time_s, pressure_Pa = read(tmp_path, two_channels(order, flags))
    assert np.array_equal(time_s, TIME_S)
    assert np.allclose(pressure_Pa, 1000 * PRESSURE_KPA, rtol=1e-15)


def test_a_waveform_says_its_own_times_and_unit(tmp_path: Path) -> None:
    counts = np.arange(10, dtype="<i2")
    wave = {"wf_start_offset": 0.25, "wf_increment": 5e-4, "unit_string": "psi"}
    other = np.arange(3, dtype="<u1")
    made = segment(
        [entry("/'g'/'other'", other), entry("/'g'/'pressure'", counts, **wave)], other.tobytes() + counts.tobytes()
    )
    time_s, pressure_Pa = read(tmp_path, made)
    assert np.allclose(time_s, 0.25 + 5e-4 * np.arange(10))
    assert np.allclose(pressure_Pa, 6894.757 * np.arange(10), rtol=1e-6)


def test_segments_go_on_where_the_last_ended(tmp_path: Path) -> None:
    part = PRESSURE_KPA[:4].astype("<f4")
    first = segment([entry("/'g'/'pressure_kPa'", part, wf_increment=1e-3)], part.tobytes())
    again = segment([entry("/'g'/'pressure_kPa'", KEPT)], part.tobytes() * 2, new_list=False)
    bare = segment([], part.tobytes())
    time_s, pressure_Pa = read(tmp_path, first, again, bare)
    assert np.allclose(time_s, 1e-3 * np.arange(16))
    assert np.allclose(pressure_Pa, np.tile(1000 * part.astype(float), 4))


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (b"time_s,pressure_kPa\n0,1\n", "no whole TDMS file"),
        (two_channels()[:-9], "cut short"),
        (two_channels() + b"TDSm", "whole TDMS file|cut short"),
        (segment([entry("/'g'/'volts'", TIME_S)], TIME_S.tobytes()), "lacks a channel pressure_kPa (found: volts)"),
        (segment([entry("/'g'/'pressure_kPa'", TIME_S)], TIME_S.tobytes()), "states no times"),
    ],
)
def test_unsupported_content_is_refused_in_one_sentence(tmp_path: Path, made: bytes, words: str) -> None:
    with pytest.raises(TrackError, match=words.replace("(", r"\(").replace(")", r"\)")):
        read(tmp_path, made)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.integers(0, 10_000), value=st.integers(0, 255))
def test_a_changed_byte_gives_numbers_or_a_sentence(tmp_path: Path, place: int, value: int) -> None:
    damaged = bytearray(two_channels())
    damaged[place % len(damaged)] = value
    try:
        time_s, pressure_Pa = read(tmp_path, bytes(damaged))
    except TrackError:
        return
    assert time_s.shape == pressure_Pa.shape
