"""Clips: what goes in comes out, in the same colours, and nothing half-written is left."""

from pathlib import Path

import av
import numpy as np
import pytest

from vinetrack.video.write import write_clip


def pictures(n: int, height: int = 64, width: int = 96) -> list[np.ndarray]:
    made = []
    for i in range(n):
        picture = np.full((height, width, 3), 60, np.uint8)
        picture[:, 8 * i : 8 * i + 8] = (240, 228, 66)
        made.append(picture)
    return made


def test_pictures_come_back_in_order_and_in_colour(tmp_path):
    path = tmp_path / "overlays" / "a.mp4"
    assert write_clip(path, iter(pictures(10)), 12.5) == 10
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert float(stream.average_rate) == 12.5
        back = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(back) == 10
    for i, picture in enumerate(back):
        middle = picture[20:40, 8 * i + 2 : 8 * i + 6].astype(float).mean(axis=(0, 1))
        assert middle == pytest.approx([240, 228, 66], abs=14)


def broken():  # type: ignore[no-untyped-def]
    yield pictures(1)[0]
    raise RuntimeError("the recording ends here")


@pytest.mark.parametrize(
    ("given", "error"),
    [([], ValueError), ([np.zeros((63, 96, 3), np.uint8)], ValueError), (broken(), RuntimeError)],
    ids=["nothing", "odd", "broken"],
)
def test_a_failed_write_leaves_the_old_clip_and_no_other_file(tmp_path: Path, given, error) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "a.mp4"
    path.write_bytes(b"the old one")
    with pytest.raises(error):
        write_clip(path, given, 10)
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]
    assert path.read_bytes() == b"the old one"


@pytest.mark.slow
def test_the_same_pictures_are_the_same_bytes_whatever_the_memory_held(tmp_path):
    draw = np.random.default_rng(20701)
    noisy = [np.clip(p + draw.normal(0, 12, p.shape), 0, 255).astype(np.uint8) for p in pictures(30, 198, 480)]
    written = []
    for k in range(6):
        held = [draw.bytes(int(draw.integers(1, 2_000_000))) for _ in range(20)]
        del held
        write_clip(tmp_path / f"{k}.mp4", iter(noisy), 9.0)
        written.append((tmp_path / f"{k}.mp4").read_bytes())
    assert len(set(written)) == 1
