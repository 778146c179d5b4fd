"""One frame of a video: the same as when all are read, in any order, from every format."""

import shutil
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
import tifffile

from haselab.base import InputError
from haselab.store.video.opening import open_video

COUNT = 40


def pictures(shape: tuple[int, int] = (64, 96)) -> np.ndarray:
    """Smooth moving pictures, so that a codec with loss keeps them apart."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    waves = [120 + 100 * np.sin((x + 3 * k) / 9.0) * np.cos((y - k) / 7.0) for k in range(COUNT)]
    return np.rint(waves).astype(np.uint8)


def write(path: Path, codec: str, form: str, options: dict[str, str], rate: int = 400) -> None:
    images = pictures()
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(rate))
        stream.height, stream.width = images.shape[1:]
        stream.pix_fmt, stream.options = form, options
        for index, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="gray").reformat(format=form)
            frame.pts = index
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def make(folder: Path, kind: str) -> Path:
    path = folder / kind
    if kind == "images":
        path.mkdir()
        for index, image in enumerate(pictures()):
            tifffile.imwrite(path / f"a_{index}.tif", image)
        (path / "times.csv").write_text(
            "frame,time_s\n" + "".join(f"{k},{k / 300}\n" for k in range(COUNT))
        )
    elif kind.endswith(".tif"):
        packed = {"compression": "zlib"} if kind == "packed.tif" else {}
        tifffile.imwrite(path, pictures(), photometric="minisblack", **packed)
    elif kind.startswith("h264"):
        write(path, "libx264", "yuv420p", {"bf": "3", "g": "12"})
    else:
        write(path, "ffv1", "gray", {}, rate=4000 if kind == "fast.mkv" else 400)
    return path


def check(path: Path) -> None:
    """Every frame by itself, from the last to the first, with its time."""
    with open_video(path) as video:
        together = [(time_s, frame.copy()) for time_s, frame in video.timed()]
        assert len({frame.tobytes() for _, frame in together}) == len(together)
        for index in reversed(range(len(together))):
            time_s, frame = video.frame(index)
            np.testing.assert_array_equal(frame, together[index][1])
            np.testing.assert_allclose(time_s, together[index][0], atol=1e-9)
        for index in (-1, len(together)):
            with pytest.raises(InputError, match=f"Frame {index} does not exist: the video has"):
                video.frame(index)


@pytest.mark.parametrize(
    "kind",
    [
        "ffv1.mkv", "ffv1.avi", "fast.mkv", "h264.mp4", "h264.mkv", "h264.avi", "h264.ts",
        "plain.tif", "packed.tif", "images",
    ],
)  # fmt: skip
def test_a_frame_is_the_same_alone_as_among_all(tmp_path: Path, kind: str) -> None:
    check(make(tmp_path, kind))


@pytest.mark.parametrize("name", ["cine_781.cine", "beam.mraw"])
def test_a_frame_of_a_high_speed_camera_is_the_same_alone(shared_data: Path, name: str) -> None:
    check(shared_data / "video" / "readers" / name)


def test_a_frame_behind_the_end_of_a_truncated_file_is_refused(tmp_path: Path) -> None:
    whole = make(tmp_path, "plain.tif")
    short = tmp_path / "short.tif"
    shutil.copy(whole, short)
    with short.open("r+b") as file:
        file.truncate(whole.stat().st_size // 2)
    with open_video(short) as video:
        video.frame(2)
        with pytest.raises(InputError, match="cannot be read"):
            video.frame(COUNT - 1)
