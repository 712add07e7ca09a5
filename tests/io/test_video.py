import av
import numpy as np
import pytest
from PIL import Image

from fieldstone.errors import InputError
from fieldstone.io.images.video import write_gif, write_mp4


def ramp_frames(n, height, width):
    """Smooth frames, each with its own brightness."""
    y, x = np.mgrid[:height, :width]
    for k in range(n):
        frame = np.stack([x * 200 / width, y * 200 / height, np.full(x.shape, 20 * k)], axis=2)
        yield frame.astype(np.uint8)


@pytest.mark.parametrize(("height", "width"), [(48, 64), (47, 63)])
def test_mp4_plays_back_the_frames(tmp_path, height, width):
    path = tmp_path / "new" / "film.mp4"
    assert write_mp4(path, ramp_frames(10, height, width), fps=24) == 10
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.average_rate == 24
        assert stream.codec_context.name == "h264"
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert len(decoded) == 10
    for frame, expected in zip(decoded, ramp_frames(10, height, width), strict=True):
        assert frame.shape == (height + height % 2, width + width % 2, 3)
        # H.264 at crf 18 and half-size colour planes: a few grey levels.
        assert np.abs(frame[:height, :width].astype(int) - expected).mean() < 4
    assert [p.name for p in path.parent.iterdir()] == ["film.mp4"]


def test_gif_plays_back_the_frames(tmp_path):
    path = tmp_path / "film.gif"
    assert write_gif(path, ramp_frames(5, 20, 30), fps=25) == 5
    with Image.open(path) as film:
        assert getattr(film, "n_frames", 1) == 5
        assert film.info["loop"] == 0
        for k, expected in enumerate(ramp_frames(5, 20, 30)):
            film.seek(k)
            assert film.info["duration"] == 40
            assert np.abs(np.asarray(film.convert("RGB")).astype(int) - expected).mean() < 6


@pytest.mark.parametrize("write", [write_mp4, write_gif])
def test_bad_films_leave_nothing_behind(tmp_path, write):
    with pytest.raises(InputError, match="at least one frame"):
        write(tmp_path / "film", [])
    frames = [np.zeros((16, 16, 3), dtype=np.uint8), np.zeros((16, 18, 3), dtype=np.uint8)]
    with pytest.raises(InputError, match="one size"):
        write(tmp_path / "film", frames)
    assert list(tmp_path.iterdir()) == []
