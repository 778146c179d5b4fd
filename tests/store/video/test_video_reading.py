"""What a grey level is: exact luma, colour by rule, depths, ranges, loss, sizes that change."""

from fractions import Fraction

import av
import numpy as np
import pytest
import tifffile

from haselab.base import InputError
from haselab.store.video.opening import open_video
from haselab.store.video.reader import luma_of_colour


def noise(shape, top, seed=5):
    kind = np.uint8 if top < 256 else np.uint16
    return np.random.default_rng(seed).integers(0, top, shape, dtype=kind, endpoint=True)


def write(path, frames, codec, options=None):
    """Frames of av, as they are, and without any conversion."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(400))
        stream.width, stream.height = frames[0].width, frames[0].height
        stream.pix_fmt, stream.options = frames[0].format.name, options or {}
        for index, frame in enumerate(frames):
            frame.pts = index
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def with_luma(luma, form):
    """A frame of a planar format whose plane 0 is given, the colour left grey."""
    frame = av.VideoFrame(luma.shape[1], luma.shape[0], form)
    for plane in frame.planes[1:]:
        plane.update(bytes(plane.buffer_size))
    plane = frame.planes[0]
    rows = np.zeros((luma.shape[0], plane.line_size), np.uint8)
    packed = luma.view(np.uint8).reshape(luma.shape[0], -1)
    rows[:, : packed.shape[1]] = packed
    plane.update(rows.tobytes())
    return frame


@pytest.mark.parametrize(
    ("form", "bits"),
    [
        ("yuv420p", 8), ("yuv444p", 8), ("gray", 8), ("yuv422p10le", 10), ("gray10le", 10),
        ("gray12le", 12), ("yuv420p12le", 12), ("gray16le", 16), ("yuv444p16le", 16),
    ],
)  # fmt: skip
def test_plane_zero_comes_back_exact_at_every_depth(tmp_path, form, bits):
    luma = [noise((46, 70), 2**bits - 1, seed) for seed in range(3)]
    write(tmp_path / "a.mkv", [with_luma(image, form) for image in luma], "ffv1")
    with open_video(tmp_path / "a.mkv") as video:
        assert (video.bit_depth, video.lossy, video.codec) == (bits, False, "ffv1")
        np.testing.assert_array_equal(np.stack(list(video)), np.stack(luma))


@pytest.mark.parametrize(("form", "start"), [("yuyv422", 0), ("uyvy422", 1)])
def test_luma_packed_between_colours_is_taken_out_unchanged(tmp_path, form, start):
    luma = noise((46, 70), 255)
    packed = np.full((46, 140), 128, np.uint8)
    packed[:, start::2] = luma
    write(tmp_path / "a.avi", [raw(packed, form)], "rawvideo")
    with open_video(tmp_path / "a.avi") as video:
        np.testing.assert_array_equal(next(iter(video)), luma)


def raw(packed, form):
    frame = av.VideoFrame(packed.shape[1] // 2, packed.shape[0], form)
    rows = np.zeros((packed.shape[0], frame.planes[0].line_size), np.uint8)
    rows[:, : packed.shape[1]] = packed
    frame.planes[0].update(rows.tobytes())
    return frame


@pytest.mark.parametrize(("colour_range", "word"), [(1, "limited"), (2, "full")])
def test_limited_and_full_range_are_reported_and_never_stretched(tmp_path, colour_range, word):
    ramp = np.tile(np.arange(16, 236, dtype=np.uint8), (64, 1))
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=Fraction(400))
        stream.width, stream.height, stream.pix_fmt = 220, 64, "yuv420p"
        stream.codec_context.color_range = colour_range
        frame = with_luma(ramp, "yuv420p")
        frame.color_range = colour_range
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with open_video(tmp_path / "a.mkv") as video:
        assert video.levels == f"luma as stored, {word} range"
        np.testing.assert_array_equal(next(iter(video)), ramp)


def test_colour_becomes_luma_by_the_stated_rule_within_half_a_level(tmp_path):
    colour = noise((46, 70, 3), 255)
    write(tmp_path / "a.mkv", [av.VideoFrame.from_ndarray(colour, format="rgb24")
                               .reformat(format="bgr0")], "ffv1")  # fmt: skip
    with open_video(tmp_path / "a.mkv") as video:
        assert "0.299 R" in video.levels
        frame = next(iter(video))
    exact = colour @ np.array([0.299, 0.587, 0.114])
    # half a level of rounding, and weights in 2^-16: 255 times 3 half steps
    assert np.abs(frame - exact).max() <= 0.5 + 255 * 1.5 / 2**16
    grey = np.arange(256, dtype=np.uint8)[:, None, None].repeat(3, axis=2)
    np.testing.assert_array_equal(luma_of_colour(grey)[:, 0], np.arange(256))


def test_colour_tiff_and_16_bit_colour_follow_the_same_rule(tmp_path):
    for top in (255, 65535):
        colour = noise((2, 46, 70, 3), top)
        tifffile.imwrite(tmp_path / "c.tif", colour, photometric="rgb")
        with open_video(tmp_path / "c.tif") as video:
            frames = np.stack(list(video))
        exact = colour @ np.array([0.299, 0.587, 0.114])
        assert frames.dtype == colour.dtype
        assert np.abs(frames - exact).max() <= 0.5 + top * 1.5 / 2**16


@pytest.mark.parametrize(
    "layout", [{"contiguous": True}, {"compression": "zlib"}, {"byteorder": ">"}]
)
def test_tiff_stacks_of_any_layout_come_back_exact(tmp_path, layout):
    images = noise((5, 40, 50), 65535)
    order = layout.get("byteorder", "<")
    keep = {key: value for key, value in layout.items() if key != "byteorder"}
    with tifffile.TiffWriter(tmp_path / "s.tif", byteorder=order) as file:
        for image in images:
            file.write(image, photometric="minisblack", **keep)
    with open_video(tmp_path / "s.tif") as video:
        assert video.frame_count == 5
        frames = np.stack(list(video))
    assert frames.dtype.isnative
    np.testing.assert_array_equal(frames, images)


@pytest.mark.parametrize("top", [255, 4095])
def test_pgm_folders_come_back_exact_whatever_wrote_their_head(tmp_path, top):
    images = noise((3, 40, 50), top)
    for k, (image, head) in enumerate(
        zip(images, ("P5\n50 40\n{}\n", "P5 50 40 {} ", "P5\n# camera 1\n50 40\n{}\n"), strict=True)
    ):
        data = image.astype(">u2").tobytes() if top > 255 else image.tobytes()
        (tmp_path / f"f{k}.pgm").write_bytes(head.format(top).encode() + data)
    with open_video(tmp_path) as video:
        frames = list(video)
    if top == 255:
        np.testing.assert_array_equal(np.stack(frames), images)
    else:  # FFmpeg takes 12-bit PGM to 16; ours reads the first two as stored
        np.testing.assert_array_equal(np.stack(frames[:2]), images[:2])


@pytest.mark.parametrize(
    ("codec", "suffix", "options", "lossy"),
    [
        ("libx264", ".mkv", {"qp": "0"}, False), ("libx264", ".mp4", {"crf": "0"}, False),
        ("libx264", ".mkv", {"crf": "20"}, True), ("mjpeg", ".avi", {}, True),
        ("jpeg2000", ".mkv", {}, None), ("ffv1", ".mkv", {}, False),
    ],
)  # fmt: skip
def test_loss_is_known_from_the_codec_and_for_x264_from_its_settings(
    tmp_path, codec, suffix, options, lossy
):
    if codec not in av.codecs_available:
        pytest.skip(f"this FFmpeg has no {codec}")
    form = "yuvj420p" if codec == "mjpeg" else "yuv444p" if lossy is False else "yuv420p"
    frames = [with_luma(noise((48, 64), 255, k), form) for k in range(3)]
    write(tmp_path / f"a{suffix}", frames, codec, options)
    with open_video(tmp_path / f"a{suffix}") as video:
        assert video.lossy is lossy


def test_a_size_that_changes_in_mid_stream_ends_the_clip_with_where_and_how(tmp_path):
    parts = b""
    for shape in ((48, 64), (64, 48)):
        write(tmp_path / "part.mjpeg", [with_luma(noise(shape, 255), "yuvj420p")] * 2, "mjpeg")
        parts += (tmp_path / "part.mjpeg").read_bytes()
    (tmp_path / "both.mjpeg").write_bytes(parts)
    seen = []
    with (
        pytest.raises(InputError, match=r"Frame 2 has 48 x 64 px of 8 bit, frame 0 has 64 x 48"),
        open_video(tmp_path / "both.mjpeg") as video,
    ):
        for frame in video:
            seen.append(frame.shape)
    assert seen == [(48, 64)] * 2


def test_images_of_different_sizes_in_a_folder_are_refused_at_the_first_that_differs(tmp_path):
    for k, shape in enumerate([(40, 50), (40, 50), (40, 51)]):
        tifffile.imwrite(tmp_path / f"{k}.tif", noise(shape, 255), photometric="minisblack")
    with pytest.raises(InputError, match=r"Frame 2 has 51 x 40"), open_video(tmp_path) as video:
        list(video)


def test_a_truncated_stack_gives_its_whole_pages_and_then_says_so(tmp_path):
    images = noise((6, 40, 50), 255)
    tifffile.imwrite(tmp_path / "s.tif", images, photometric="minisblack")
    whole = (tmp_path / "s.tif").read_bytes()
    (tmp_path / "s.tif").write_bytes(whole[: len(whole) - 2 * 2000 - 1000])
    seen = []
    with (
        pytest.raises(InputError, match=r"Page 3 of 6 cannot be read.*Copy it again"),
        open_video(tmp_path / "s.tif") as video,
    ):
        for frame in video:
            seen.append(frame)
    np.testing.assert_array_equal(np.stack(seen), images[:3])


def test_a_stack_whose_chain_of_pages_is_cut_gives_the_pages_before_and_says_so(tmp_path):
    images = noise((6, 40, 50), 255)
    with tifffile.TiffWriter(tmp_path / "s.tif") as file:
        for image in images:
            file.write(image, photometric="minisblack", metadata=None, compression="zlib")
    whole = (tmp_path / "s.tif").read_bytes()
    (tmp_path / "s.tif").write_bytes(whole[: len(whole) // 2])
    seen = []
    with (
        pytest.raises(InputError, match=r"(breaks off after|Page) .*Copy it again"),
        open_video(tmp_path / "s.tif") as video,
    ):
        for frame in video:
            seen.append(frame)
    np.testing.assert_array_equal(np.stack(seen), images[: len(seen)])
    assert len(seen) in (1, 2, 3)
