"""Read the channels of a TDMS file, in which LabVIEW writes measurements, as the columns of a table.

Source: National Instruments, *TDMS File Format Internal Structure*. A file is a sequence of segments, each with a
lead-in of 28 bytes, properties and the layout of its channels, and raw values: one channel after the other or sample by
sample. Values that need scaling on reading (DAQmx, `NI_Scale`) are refused by name.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.core.units import convert, split_unit
from vinetrack.tracks.track_checks import TrackError

LEAD_IN_BYTES = 28  # Bytes of a segment's lead-in
# Content of a segment, by bits of its lead-in
_META, _NEW_LIST, _RAW, _INTERLEAVED, _BIG_ENDIAN, _DAQMX = 1 << 1, 1 << 2, 1 << 3, 1 << 5, 1 << 6, 1 << 7
# Marks in place of a layout, or of a segment's length
_NO_RAW, _AS_BEFORE, _TO_THE_END = 0xFFFFFFFF, 0, 0xFFFFFFFFFFFFFFFF
_TYPES = {1: "i1", 2: "i2", 3: "i4", 4: "i8", 5: "u1", 6: "u2", 7: "u4", 8: "u8", 9: "f4", 10: "f8", 25: "f4", 26: "f8"}
_TEXT, _BOOLEAN, _TIME_STAMP = 0x20, 0x21, 0x44  # Type codes of text, Booleans and time stamps
_DAQMX_LAYOUTS = {0x1269, 0x1369}


@dataclass
class _Channel:
    """A channel as far as it has been read: type and count of its values in a segment, properties, and all values."""

    kind: str = ""
    count: int = 0
    properties: dict[str, Any] = field(default_factory=dict)
    parts: list[NDArray[Any]] = field(default_factory=list)


def tdms_columns(data: bytes) -> dict[str, Floats]:
    """Read the channels of a file that are as long as its pressure. A channel is named as in the file, with its unit
    appended (`pressure` in `kPa` is `pressure_kPa`). Where none is a time, `time_s` comes from the waveform's start and
    increment. Returns values by column, each of shape (n_samples,).
    """
    try:
        channels = _channels(data)
    except (struct.error, UnicodeDecodeError, ValueError) as error:
        raise TrackError(f"is damaged or cut short ({error}): export it from LabVIEW again") from None
    named = {_column(path, channel): channel for path, channel in channels.items() if channel.parts}
    pressure = next((channel for name, channel in named.items() if name.startswith("pressure")), None)
    if pressure is None:
        there = ", ".join(list(named)[:8]) or "none"
        raise TrackError(f"lacks a channel pressure_kPa (found: {there[:120]}): name it so in LabVIEW")
    columns = {name: _values(name, channel) for name, channel in named.items()}
    columns = {name: values for name, values in columns.items() if len(values) == len(_values("", pressure))}
    if not any(name.startswith("time") for name in columns):
        step = float(pressure.properties.get("wf_increment", 0.0))
        if not step > 0:
            raise TrackError("states no times: write a channel time_s, or the waveform's increment (wf_increment)")
        start = float(pressure.properties.get("wf_start_offset", 0.0))
        columns["time_s"] = np.asarray(start + step * np.arange(len(_values("", pressure))), dtype=float)
    return dict(_in_own_unit(name, values) for name, values in columns.items())


def _in_own_unit(name: str, values: Floats) -> tuple[str, Floats]:
    """Convert a pressure to kPa and a time to s; others stay as they are."""
    quantity, unit = split_unit(name)
    wanted = {"pressure": "kPa", "time": "s"}.get(quantity, unit)
    if unit in ("", wanted):
        return name, values
    try:
        return f"{quantity}_{wanted}", values * convert(1.0, unit, wanted)
    except ValueError as error:
        raise TrackError(f"channel {name}: {error}") from None


def _column(path: str, channel: _Channel) -> str:
    """Name of a channel with its unit."""
    name = path.rpartition("/'")[2].removesuffix("'").replace("''", "'")
    unit = str(channel.properties.get("unit_string", ""))
    return name if not unit or name.endswith(f"_{unit}") else f"{name}_{unit}"


def _values(name: str, channel: _Channel) -> Floats:
    """All values of a channel, unless they need scaling on reading."""
    scales = channel.properties.get("NI_Number_Of_Scales", 0)
    if name and (scales or any(key.startswith("NI_Scale[") for key in channel.properties)):
        raise TrackError(f"channel {name} is scaled only when it is read (NI_Scale): export it as CSV")
    return np.concatenate(channel.parts).astype(float)


def _channels(data: bytes) -> dict[str, _Channel]:
    """All channels by path, with their values from every segment."""
    if not data.startswith(b"TDSm"):
        raise TrackError("is not a TDMS file: export it from LabVIEW again, or as CSV")
    channels: dict[str, _Channel] = {}
    listed: list[str] = []
    place = 0
    while place < len(data):
        tag, contents = struct.unpack_from("<4sI", data, place)
        if tag != b"TDSm":
            raise ValueError(f"no segment at byte {place}")
        if contents & _DAQMX:
            raise TrackError("holds raw values of DAQmx, which are scaled only when they are read: export it as CSV")
        order = ">" if contents & _BIG_ENDIAN else "<"
        _version, length, raw = struct.unpack_from(f"{order}IQQ", data, place + 8)
        begin = place + LEAD_IN_BYTES
        end = len(data) if length == _TO_THE_END else begin + length
        if end > len(data):
            raise ValueError(f"{len(data)} of {end} bytes are there")
        if contents & _META:
            listed = _read_layout(data, begin, order, [] if contents & _NEW_LIST else listed, channels)
        if contents & _RAW:
            layout = [channels[path] for path in listed if channels[path].count]
            _read_values(data[begin + raw : end], order, layout, bool(contents & _INTERLEAVED))
        place = end
    return channels


def _read_layout(data: bytes, place: int, order: str, listed: list[str], channels: dict[str, _Channel]) -> list[str]:
    """Update properties and layout of a segment's channels; return those with raw values, in order."""
    (objects,) = struct.unpack_from(f"{order}I", data, place)
    place += 4
    listed = list(listed)
    for _ in range(objects):
        path, place = _text(data, place, order)
        channel = channels.setdefault(path, _Channel())
        (index,) = struct.unpack_from(f"{order}I", data, place)
        place += 4
        if index in _DAQMX_LAYOUTS:
            raise TrackError("holds raw values of DAQmx, which are scaled only when they are read: export it as CSV")
        if index not in (_NO_RAW, _AS_BEFORE):
            kind, _dimension, count = struct.unpack_from(f"{order}IIQ", data, place)
            if kind not in _TYPES:
                raise TrackError(
                    f"channel {_column(path, channel)} holds no plain numbers: leave it out, or export as CSV"
                )
            channel.kind, channel.count = _TYPES[kind], count
            place += index - 4 if index > 4 else 16
        if index == _NO_RAW:
            listed = [other for other in listed if other != path]
        elif path not in listed:
            listed.append(path)
        (properties,) = struct.unpack_from(f"{order}I", data, place)
        place += 4
        for _ in range(properties):
            name, place = _text(data, place, order)
            channel.properties[name], place = _property(data, place, order)
    return listed


def _text(data: bytes, place: int, order: str) -> tuple[str, int]:
    (length,) = struct.unpack_from(f"{order}I", data, place)
    if place + 4 + length > len(data):
        raise ValueError("a name runs beyond its end")
    return data[place + 4 : place + 4 + length].decode("utf-8"), place + 4 + length


def _property(data: bytes, place: int, order: str) -> tuple[Any, int]:
    (kind,) = struct.unpack_from(f"{order}I", data, place)
    place += 4
    if kind == _TEXT:
        return _text(data, place, order)
    if kind == _BOOLEAN:
        return bool(data[place]), place + 1
    if kind == _TIME_STAMP:
        return None, place + 16
    if kind not in _TYPES:
        raise ValueError(f"a property of unknown type {kind}")
    numbers = np.frombuffer(data, dtype=order + _TYPES[kind], count=1, offset=place)
    return numbers[0].item(), place + numbers.itemsize


def _read_values(raw: bytes, order: str, layout: list[_Channel], interleaved: bool) -> None:
    """Append a segment's values to its channels: repeated chunks of one layout; an incomplete last chunk is dropped."""
    fields = [(str(i), order + c.kind, () if interleaved else (c.count,)) for i, c in enumerate(layout)]
    chunk = np.dtype(fields)
    if not chunk.itemsize:
        return
    table = np.frombuffer(raw[: len(raw) // chunk.itemsize * chunk.itemsize], dtype=chunk)
    for i, channel in enumerate(layout):
        channel.parts.append(table[str(i)].ravel())
