"""Video in: exact grey levels, times, and clear words about files that cannot be read."""

import shutil
import tracemalloc
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
import tifffile

from haselab.base import InputError
from haselab.store.video.opening import open_video


def write_video(path: Path, images: np.ndarray, codec: str, form: str, **options: str) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(400))
        stream.height, stream.width = images.shape[1:]
        stream.pix_fmt = form
        stream.options = options
        for index, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format=form)
            frame.pts = index
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def noise_images(count: int, kind: type = np.uint8, shape: tuple[int, int] = (46, 70)):
    top = np.iinfo(kind).max
    return np.random.default_rng(5).integers(0, top, (count, *shape), dtype=kind, endpoint=True)


@pytest.mark.parametrize(
    ("name", "codec", "form", "kind"),
    [
        ("a.mkv", "ffv1", "gray", np.uint8),
        ("b.mkv", "ffv1", "gray16le", np.uint16),
        ("c.avi", "rawvideo", "gray", np.uint8),
    ],
)
def test_lossless_video_comes_back_exact_to_the_grey_level(tmp_path, name, codec, form, kind):
    images = noise_images(7, kind)
    write_video(tmp_path / name, images, codec, form)
    with open_video(tmp_path / name) as video:
        assert not video.lossy
        assert video.rate_hz == 400.0
        assert video.frame_count == 7
        times, frames = zip(*video.timed(), strict=True)
    np.testing.assert_array_equal(np.stack(frames), images)
    # Matroska keeps times in whole milliseconds; the reader undoes that
    np.testing.assert_allclose(times, np.arange(7) / 400.0, atol=1e-12)


def test_iterating_twice_starts_again_at_the_first_frame(tmp_path):
    write_video(tmp_path / "a.mkv", noise_images(3), "ffv1", "gray")
    with open_video(tmp_path / "a.mkv") as video:
        np.testing.assert_array_equal(np.stack(list(video)), np.stack(list(video)))


def test_a_table_of_times_beside_the_video_replaces_its_nominal_times(tmp_path):
    write_video(tmp_path / "a.mkv", noise_images(3), "ffv1", "gray")
    (tmp_path / "a.csv").write_text("frame,time_s\n0,10.0\n1,10.0026\n2,10.0049\n")
    with open_video(tmp_path / "a.mkv") as video:
        times = [time for time, _ in video.timed()]
    np.testing.assert_allclose(times, [0.0, 0.0026, 0.0049], atol=1e-12)


def test_compressed_video_is_called_lossy_and_its_luma_is_plane_zero(tmp_path):
    images = np.repeat(np.arange(16, 236, dtype=np.uint8)[None, None, :], 64, axis=1)
    planar = np.concatenate([images[0], np.full((32, 220), 128, np.uint8)])
    write_video_yuv(tmp_path / "a.mkv", planar)
    with open_video(tmp_path / "a.mkv") as video:
        assert video.lossy
        frame = next(iter(video))
    # H.264 at quantiser 1 keeps a ramp to about a grey level; a stretch to full range would not
    assert np.abs(frame.astype(int) - images[0]).max() <= 2


def write_video_yuv(path: Path, planar: np.ndarray) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height = planar.shape[1], planar.shape[0] * 2 // 3
        stream.pix_fmt, stream.options = "yuv420p", {"qp": "1"}
        container.mux(stream.encode(av.VideoFrame.from_ndarray(planar, format="yuv420p")))
        container.mux(stream.encode())


def test_image_folder_is_read_in_name_order_whatever_the_format(tmp_path):
    images = noise_images(3, np.uint16)
    tifffile.imwrite(tmp_path / "f_002.tif", images[2])
    tifffile.imwrite(tmp_path / "f_000.tif", images[0])
    with av.open(str(tmp_path / "f_001.png"), "w", format="image2") as container:
        stream = container.add_stream("png", rate=1)
        stream.height, stream.width = images.shape[1:]
        stream.pix_fmt = "gray16be"
        big = av.VideoFrame.from_ndarray(images[1], format="gray16le").reformat(format="gray16be")
        container.mux(stream.encode(big))
    (tmp_path / "notes.txt").write_text("not an image")
    with open_video(tmp_path) as video:
        assert video.frame_count == 3
        np.testing.assert_array_equal(np.stack(list(video)), images)


def test_tiff_stack_comes_back_exact(tmp_path):
    images = noise_images(4, np.uint16)
    tifffile.imwrite(tmp_path / "s.tif", images, compression="zlib", photometric="minisblack")
    with open_video(tmp_path / "s.tif") as video:
        assert not video.lossy
        np.testing.assert_array_equal(np.stack(list(video)), images)


def test_memory_stays_flat_over_a_long_clip(tmp_path):
    shape = (400, 500)
    tifffile.imwrite(
        tmp_path / "s.tif", np.zeros((200, *shape), np.uint8), photometric="minisblack"
    )
    tracemalloc.start()
    with open_video(tmp_path / "s.tif") as video:
        assert sum(1 for _ in video) == 200
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 30 * shape[0] * shape[1]  # of 200 frames


def test_photron_frames_equal_those_of_pymraw(shared_data):
    pymraw = pytest.importorskip("pyMRAW")
    path = shared_data / "video/readers/beam.mraw"
    images, info = pymraw.load_video(str(path.with_suffix(".cihx")))
    with open_video(path) as video:
        assert (video.frame_count, video.rate_hz, video.bit_depth) == (
            info["Total Frame"],
            info["Record Rate(fps)"],
            12,
        )
        np.testing.assert_array_equal(np.stack(list(video)), images)


def test_photron_packed_12_bit_pixels_are_unpacked(tmp_path, shared_data):
    header = (shared_data / "video/readers/beam.cihx").read_bytes()
    header = header.replace(b"<bit>16</bit>", b"<bit>12</bit>")
    (tmp_path / "p.cihx").write_bytes(header)
    pixels = np.random.default_rng(1).integers(0, 4096, 4 * 80 * 1024)
    a, b = pixels[0::2], pixels[1::2]
    three = np.stack([a >> 4, (a & 15) << 4 | b >> 8, b & 255], axis=1).astype(np.uint8)
    (tmp_path / "p.mraw").write_bytes(three.tobytes())
    with open_video(tmp_path / "p.mraw") as video:
        np.testing.assert_array_equal(np.stack(list(video)), pixels.reshape(4, 80, 1024))


def test_phantom_frames_equal_those_of_pims(shared_data):
    pims = pytest.importorskip("pims")
    path = shared_data / "video/readers/cine_781.cine"
    oracle = pims.Cine(str(path))
    with open_video(path) as video:
        assert (video.frame_count, video.bit_depth) == (15, 12)
        times, frames = zip(*video.timed(), strict=True)
    # research/tracking.md: pims and a third reader agree on all 15 frames of this file
    np.testing.assert_array_equal(np.stack(frames), np.stack([np.asarray(f) for f in oracle]))
    # recorded at 90 kHz, every tenth frame saved; the stamps count whole 0.1 us
    assert oracle.frame_rate == 90_000
    np.testing.assert_allclose(np.diff(times), 10 / 90_000.0, atol=1e-7)
    assert video.rate_hz == pytest.approx(9_000.0, rel=1e-3)
    oracle.close()


def truncated(source: Path, target: Path, keep: float) -> Path:
    data = source.read_bytes()
    target.write_bytes(data[: int(keep * len(data))])
    return target


@pytest.mark.parametrize(
    ("name", "keep", "match"),
    [
        ("readers/cine_781.cine", 0.7, "ends within frame 10 of 15.*truncated"),
        ("readers/cine_781.cine", 0.001, "header extends to byte.*truncated"),
        ("readers/beam.mraw", 0.5, "has 327680 bytes, 4 frames.*need 655360.*truncated"),
        ("bulk-water.mov", 0.5, "cannot open the video.*copy is complete"),
        ("dic-challenge-14/L1.tif", 0.5, "cannot be read.*truncated or damaged"),
    ],
)
def test_truncated_files_are_refused_with_what_to_do(shared_data, tmp_path, name, keep, match):
    source = shared_data / "video" / name
    broken = truncated(source, tmp_path / source.name, keep)
    if source.suffix == ".mraw":
        shutil.copy(source.with_suffix(".cihx"), tmp_path)
    with pytest.raises(InputError, match=match), open_video(broken) as video:
        list(video)


def test_a_truncated_photron_file_gives_its_whole_frames_first(shared_data, tmp_path):
    source = shared_data / "video/readers/beam.mraw"
    shutil.copy(source.with_suffix(".cihx"), tmp_path)
    seen = 0
    with (
        pytest.raises(InputError, match="truncated"),
        open_video(truncated(source, tmp_path / source.name, 0.6)) as video,
    ):
        for _ in video:
            seen += 1
    assert seen == 2  # of 4


def test_a_recording_that_stopped_short_is_refused_after_its_last_frame(tmp_path):
    write_video(tmp_path / "whole.mkv", noise_images(60), "ffv1", "gray")
    short = truncated(tmp_path / "whole.mkv", tmp_path / "short.mkv", 0.5)
    seen = 0
    with (
        pytest.raises(InputError, match=r"frame.*truncated or damaged"),
        open_video(short) as video,
    ):
        for _ in video:
            seen += 1
    assert 20 < seen < 40


def test_unknown_missing_and_empty_files_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"no such video.*nothing\.avi"):
        open_video(tmp_path / "nothing.avi")
    with pytest.raises(InputError, match="contains no image"):
        open_video(tmp_path)
    (tmp_path / "empty.avi").touch()
    with pytest.raises(InputError, match="is empty"):
        open_video(tmp_path / "empty.avi")
    (tmp_path / "text.avi").write_text("this is a letter, not a video\n" * 50)
    with pytest.raises(InputError, match="FFmpeg cannot open"):
        open_video(tmp_path / "text.avi")
    (tmp_path / "alone.mraw").write_bytes(b"\0" * 64)
    with pytest.raises(InputError, match=r"no header alone\.cihx"):
        open_video(tmp_path / "alone.mraw")


def test_real_video_has_all_its_frames_and_is_called_lossy(shared_data):
    with open_video(shared_data / "video/bulk-water.mov") as video:
        assert video.lossy
        assert video.frame_count == 480
        frames = sum(1 for frame in video if frame.shape == (424, 640))
    assert frames == 480
