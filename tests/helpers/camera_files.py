"""Files as high-speed cameras write them, byte by byte from the vendors' descriptions, without the package."""

import struct
from pathlib import Path

import numpy as np

TICK = 2**32


def packed(values: np.ndarray, bits: int) -> bytes:
    """Values as a string of bits, most significant first."""
    text = (values.astype(np.uint32).ravel()[:, None] >> np.arange(bits - 1, -1, -1)) & 1
    return np.packbits(text.astype(np.uint8).ravel()).tobytes()


def write_cine(path: Path, frames: np.ndarray, times_s=None, exposures_s=None, annotation=b"", **said: int) -> Path:
    """A Phantom cine. `pack` is 0, 256 (10 bits, the values given are those before linearisation) or 1024 (12 bits)."""
    options = {
        "rate": 5000, "exposure_ns": 40_000, "pack": 0, "real_bits": 12, "version": 1, "compression": 0,
        "colour_filter": 0, "bit_count": 8 if frames.dtype == np.uint8 else 16,
    } | said  # fmt: skip
    pack, bits, kind = options["pack"], options["bit_count"], (44, options["compression"], options["version"])
    n, height, width = frames.shape
    setup = bytearray(5768)
    setup[140:144] = b"ST" + struct.pack("<H", len(setup))
    at_place = {768: options["rate"], 772: options["exposure_ns"] // 1000, 808: options["colour_filter"]}
    at_place |= {800: 731}  # the version of software that wrote settings of the full length
    at_place |= {896: options["real_bits"], 1568: options["exposure_ns"], 5736: 2 ** options["real_bits"] - 1}
    for place, value in at_place.items():
        struct.pack_into("<I", setup, place, value)
    blocks = []
    if times_s is not None:
        ticks = [round(float(t) * TICK) for t in times_s]
        stamps = b"".join(struct.pack("<II", (tick % TICK) & ~3 | 2, 1_500_000_000 + tick // TICK) for tick in ticks)
        blocks.append((1002, stamps))
    if exposures_s is not None:
        blocks.append((1003, b"".join(struct.pack("<I", round(float(e) * TICK)) for e in exposures_s)))
    tags = b"".join(
        struct.pack("<IHH", 8 + len(data), name, i < len(blocks) - 1) + data for i, (name, data) in enumerate(blocks)
    )
    if pack:
        pictures = [packed(frame, {256: 10, 1024: 12}[pack]) for frame in frames]
    else:
        pictures = [frame[::-1].astype("<u2" if bits == 16 else "u1").tobytes() for frame in frames]
    table = 84 + len(setup) + len(tags)
    at, offsets, body = table + 8 * n, [], b""
    for picture in pictures:
        block = struct.pack("<I", 8 + len(annotation)) + annotation + struct.pack("<I", len(picture)) + picture
        offsets.append(at)
        at += len(block)
        body += block
    header = struct.pack("<2s3HiIiI3I", b"CI", *kind, 0, n, -n // 2, n, 44, 84, table)
    header += struct.pack("<II", 0, 1_500_000_000)
    bitmap = struct.pack("<IiiHHIIiiII", 40, width, height, 1, bits, pack, len(pictures[0]), 0, 0, 0, 0)
    path.write_bytes(header + bitmap + bytes(setup) + tags + struct.pack(f"<{n}q", *offsets) + body)
    return path


CIH = """#Camera Information Header
Camera Type : FASTCAM SA-Z type 2100K-M-32GB
Record Rate(fps) : {rate}
Shutter Speed(s) : {shutter}
Total Frame : {total}
Start Frame : 0
Save Step : {step}
Image Width : {width}
Image Height : {height}
Color Type : {colour}
Color Bit : {bits}
File Format : {form}
EffectiveBit Depth : {depth}
EffectiveBit Side : Lower
Comment Text : a tube : grown twice
END
"""

CIHX = """<cih><fileInfo><date>2024/5/2</date></fileInfo><basicInfo><comment>tube</comment></basicInfo>
<deviceInfo><deviceName>FASTCAM Nova S12</deviceName></deviceInfo>
<recordInfo><recordRate>{rate}</recordRate><shutterSpeed>{shutter}</shutterSpeed></recordInfo>
<frameInfo><totalFrame>{total}</totalFrame><recordedFrame>{total}</recordedFrame></frameInfo>
<imageDataInfo><resolution><width>{width}</width><height>{height}</height></resolution>
<colorInfo><type>{colour}</type><bit>{bits}</bit></colorInfo>
<effectiveBit><depth>{depth}</depth><side>Lower</side></effectiveBit></imageDataInfo>
<imageFileInfo><fileFormat>{form}</fileFormat></imageFileInfo></cih>
"""


def write_side_file(path: Path, frames: np.ndarray, **said: object) -> Path:
    """A `.cih`, or a `.cihx` with a preamble that is no XML, as the camera's program writes it."""
    total, height, width = frames.shape
    words = {
        "rate": 20000, "shutter": "1/40000", "step": 1, "total": total, "width": width, "height": height,
        "colour": "Mono", "bits": 16, "form": "MRaw", "depth": 12,
    } | said  # fmt: skip
    if path.suffix == ".cihx":
        path.write_bytes(b"\x00\xff\x10preamble\r\n" + CIHX.format(**words).encode() + b"\x00\x00")
    else:
        path.write_text(CIH.format(**words))
    return path


def write_mraw(path: Path, frames: np.ndarray, bits: int = 16, side: str = ".cih", **said: object) -> Path:
    """A Photron `.mraw` with its side file."""
    if bits in (10, 12):
        data = b"".join(packed(frame, bits) for frame in frames)
    else:
        data = frames.astype("<u2" if bits == 16 else "u1").tobytes()
    path.write_bytes(data)
    write_side_file(path.with_suffix(side), frames, **({"bits": bits} | said))
    return path
