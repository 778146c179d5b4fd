"""The twin's camera against its own stated optics, by routes that share no code with it."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.optimize import curve_fit

from haselab.base import InputError, LimitError
from haselab.rig.twin import twin_bench
from haselab.rig.twin.camera import TwinCamera, TwinCameraConfig
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import make_twin

PATIENCE_S = 60.0  # against a hang
HALF_WIDTH_M = 0.07
FREE_LENGTH_M = 0.032
SILENT = {"shot_gain_grey": 0.0, "read_noise_grey": 0.0}


def camera(seed: int = 1, **changes: object) -> TwinCamera:
    return TwinCamera(
        TwinCameraConfig.model_validate(changes), HALF_WIDTH_M, FREE_LENGTH_M, seed=seed
    )


def direct_image(seen: TwinCamera, blobs: NDArray[np.float64], length_m: float) -> NDArray:
    """The formula of twin/camera.h for every pixel and blob, with no cut tails, in double."""
    c = seen.config
    scale = c.scale_m_per_px
    half, length = HALF_WIDTH_M / scale, length_m / scale
    mid = (c.width_px - 1) / 2
    y, x = np.mgrid[: c.height_px, : c.width_px].astype(float)

    def step(distance: NDArray) -> NDArray:
        return 0.5 * (1 + np.tanh(distance / (2 * c.edge_px)))

    along = (y - c.top_px) / length
    neck = c.neck_coefficient * max(0.0, length_m / FREE_LENGTH_M - 1) * 4 * along * (1 - along)
    between = step(y - c.top_px - c.clamp_inside_px) * step(
        c.top_px + length - c.clamp_inside_px - y
    )
    side = half * (1 - neck)
    sheet = between * step(x - (mid - side)) * step(mid + side - x)
    upper = step(c.top_px + c.clamp_inside_px - y) * step(y - c.top_px + c.clamp_outside_px)
    line = c.top_px + length
    lower = step(y - line + c.clamp_inside_px) * step(line + c.clamp_outside_px - y)
    overhang = max(half, c.fiducial_spacing_px) + 14
    clamps = (upper + lower) * step(overhang - np.abs(x - mid))
    u, v = (x - mid) / c.width_px, (y - (c.height_px - 1) / 2) / c.height_px
    light = 1 + c.illumination_tilt_x * u + c.illumination_tilt_y * v
    light -= 4 * c.illumination_vignette * (u**2 + v**2)
    image = light * (
        c.background_grey
        + (c.clamp_grey - c.background_grey) * clamps
        + (c.sheet_grey - c.background_grey) * sheet
    )
    for x_px, y_px, sigma, depth, on_sheet in blobs:
        dot = depth * np.exp(-((x - x_px) ** 2 + (y - y_px) ** 2) / (2 * sigma**2))
        image -= dot * (between if on_sheet else 1.0)
    return image


def centroids(image: NDArray, near_px: NDArray[np.float64], radius_px: int) -> NDArray[np.float64]:
    """Centres of mass in squares around the nearest pixels."""
    found = []
    for x_px, y_px in np.rint(near_px).astype(int):
        rows = slice(y_px - radius_px, y_px + radius_px + 1)
        columns = slice(x_px - radius_px, x_px + radius_px + 1)
        weight = image[rows, columns].astype(float)
        y, x = np.mgrid[rows, columns]
        found.append([(weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()])
    return np.array(found)


def test_a_picture_is_the_stated_formula() -> None:
    small = {"width_px": 128, "height_px": 140, "scale_m_per_px": 1.5e-3, "top_px": 40.0}
    seen = camera(particles=0, fiducial_spacing_px=25.0, neck_coefficient=0.1, **small)
    length_m = 0.1
    c = seen.config
    dots = [
        [x, y, c.fiducial_sigma_px, c.fiducial_depth_grey, 0.0]
        for x, y in seen.true_fiducials_px(length_m)
    ]
    image = seen.expected_levels([[length_m]])[0]
    direct = direct_image(seen, np.array(dots), length_m)
    # A dot is cut at 5 sigma, where 120 exp(-12.5) = 4.5e-4 grey are left of it; two may meet.
    assert np.abs(image - direct).max() < 2 * 4.5e-4


def test_particles_under_a_clamp_are_hidden_with_its_edge() -> None:
    same = {"particle_sigma_low_px": 2.0, "particle_sigma_high_px": 2.0, "particles": 60}
    same |= {"particle_depth_low_grey": 50.0, "particle_depth_high_grey": 50.0}
    seen = camera(particle_margin=0.01, fiducial_depth_grey=0.0, **same)
    length_m = 0.06
    truth = seen.true_particle_px(length_m)
    c = seen.config
    depth_px = np.minimum(
        truth[:, 1] - c.top_px, c.top_px + length_m / c.scale_m_per_px - truth[:, 1]
    )
    assert (depth_px < c.clamp_inside_px).sum() >= 5
    dots = np.column_stack([truth, np.tile([2.0, 50.0, 1.0], (60, 1))])
    image = seen.expected_levels([[length_m]])[0]
    # 50 exp(-12.5) = 1.9e-4 grey are cut of each dot, and at most a few tails meet in a pixel.
    assert np.abs(image - direct_image(seen, dots, length_m)).max() < 4 * 1.9e-4


@pytest.mark.parametrize("length_m", [0.0713, 0.0999, 0.1371])
def test_centroids_of_particles_are_the_truth(length_m: float) -> None:
    # The margin keeps them clear of the clamps' edges, which hide what lies under them.
    seen, bare = camera(particles=14, particle_margin=0.2), camera(particles=0)
    dots = bare.expected_levels([[length_m]])[0] - seen.expected_levels([[length_m]])[0]
    truth = seen.true_particle_px(length_m)
    distance = np.hypot(*(truth[:, None] - truth[None]).transpose(2, 0, 1))
    alone = (distance + 1e3 * np.eye(14)).min(axis=1) > 26
    assert alone.sum() >= 7
    # Levels near 200 carry 8e-6 grey of rounding: 25^2 pixels, 6 px away on average, over a mass
    # of at least 2 pi 1.6^2 45 = 720 move a centroid by less than 1e-4 px.
    found = centroids(dots, truth[alone], 12)
    np.testing.assert_allclose(found, truth[alone], atol=1e-4)


def test_centroids_of_fiducials_are_the_truth() -> None:
    length_m = 0.0877
    seen, bare = camera(), camera(fiducial_depth_grey=0.0)
    dots = bare.expected_levels([[length_m]])[0] - seen.expected_levels([[length_m]])[0]
    truth = seen.true_fiducials_px(length_m)
    np.testing.assert_allclose(centroids(dots, truth, 15), truth, atol=1e-4)


def test_a_fit_to_noise_free_8_bit_frames_finds_the_fiducials() -> None:
    def dot(at, x_px, y_px, sigma, depth, base, tilt_x, tilt_y):  # type: ignore[no-untyped-def]
        x, y = at
        spot = depth * np.exp(-((x - x_px) ** 2 + (y - y_px) ** 2) / (2 * sigma**2))
        return base + tilt_x * x + tilt_y * y - spot

    seen = camera(**SILENT)
    for length_m in (0.0612, 0.0913, 0.1234):
        frame = seen.render([[length_m] * 5], first_index=0)[0]
        for x_px, y_px in seen.true_fiducials_px(length_m):
            column, row = round(x_px), round(y_px)
            y, x = np.mgrid[-9:10, -9:10]
            grey = frame[row - 9 : row + 10, column - 9 : column + 10].astype(float)
            start = (0.0, 0.0, 3.0, 100.0, 210.0, 0.0, 0.0)
            best, _ = curve_fit(dot, (x.ravel(), y.ravel()), grey.ravel(), p0=start)
            # Cramer-Rao: sqrt(2 / pi) noise / depth with rounding noise 1 / sqrt(12): 0.0019 px;
            # 5 standard deviations.
            bound_px = 5 * np.sqrt(2 / np.pi) / np.sqrt(12) / 120
            assert abs(column + best[0] - x_px) < bound_px
            assert abs(row + best[1] - y_px) < bound_px


@settings(max_examples=30, deadline=None)
@given(length_m=st.floats(0.02, 0.14))
def test_the_rows_of_fiducials_are_the_length_apart(length_m: float) -> None:
    seen = camera(particles=0)
    upper, lower = np.split(seen.true_fiducials_px(length_m), 2)
    scale = seen.config.scale_m_per_px
    np.testing.assert_allclose((lower - upper)[:, 1] * scale, length_m, rtol=1e-12)
    np.testing.assert_array_equal(lower[:, 0], upper[:, 0])
    np.testing.assert_array_equal(upper[:, 1], seen.config.top_px)


def test_stretch_is_homogeneous_and_lateral_motion_grows_off_the_mid_line() -> None:
    seen = camera()
    rest, pulled = seen.true_particle_px(0.06), seen.true_particle_px(0.12)
    top_px, mid_px = seen.config.top_px, (seen.config.width_px - 1) / 2
    np.testing.assert_allclose((pulled - top_px)[:, 1] / (rest - top_px)[:, 1], 2, rtol=1e-12)
    inward_px = -np.sign(rest[:, 0] - mid_px) * (pulled - rest)[:, 0]
    across = np.abs(rest[:, 0] - mid_px) / (HALF_WIDTH_M / seen.config.scale_m_per_px)
    thirds = [inward_px[(across >= a) & (across < a + 0.33)] for a in (0.0, 0.33, 0.66)]
    assert (inward_px > 0).all()
    assert thirds[0].mean() < thirds[1].mean() < thirds[2].mean()
    # The free side itself moves by half_width * neck * (difference of the stretches), 0.05 * 1.875
    # * 200 px = 18.75 px; a particle 4 % inside, and not quite at mid-length, by less.
    assert 0.6 * 18.75 < inward_px.max() < 18.75


def test_particles_keep_their_distance_when_laid() -> None:
    seen = camera(neck_coefficient=0.0)
    placed = seen.true_particle_px(2.0 * FREE_LENGTH_M)
    distance = np.hypot(*(placed[:, None] - placed[None]).transpose(2, 0, 1))
    scale = seen.config.scale_m_per_px
    area = 0.96 * 2 * HALF_WIDTH_M / scale * 0.8 * 2 * FREE_LENGTH_M / scale
    assert distance[~np.eye(350, dtype=bool)].min() >= 0.6 * np.sqrt(area / 350) * (1 - 1e-12)


def test_motion_blur_is_the_mean_of_sharp_images() -> None:
    seen = camera()
    lengths_m = np.array([0.0900, 0.0903, 0.0911, 0.0914, 0.0920])
    blurred = seen.expected_levels([lengths_m])[0]
    sharp = seen.expected_levels(lengths_m[:, np.newaxis])
    # A pixel is the sum of at most some 40 terms below 256, each rounded to 2^-24 of itself.
    np.testing.assert_allclose(blurred, sharp.mean(axis=0), atol=40 * 256 * 2.0**-24)
    assert np.abs(blurred - sharp[2]).max() > 10


def test_noise_follows_the_configured_law() -> None:
    seen = camera(seed=3)
    length_m, frames = 0.09, 24
    mean = seen.expected_levels([[length_m]])[0].astype(float)
    c = seen.config
    # Rounding adds 1/12, to exp(-2 pi^2 variance) < 1e-8 of it.
    variance = c.shot_gain_grey * mean + c.read_noise_grey**2 + 1 / 12
    z = (seen.render([[length_m]] * frames, first_index=0) - mean) / np.sqrt(variance)
    for low, high in ((20, 100), (100, 150), (150, 195), (195, 230)):
        group = z[:, (mean >= low) & (mean < high)]
        assert group.size > 1e5
        assert abs(group.mean()) < 5 / np.sqrt(group.size)
        assert abs((group**2).mean() - 1) < 5 * np.sqrt(2 / group.size)
    pairs = (z[:, :, 1:] * z[:, :, :-1], z[:, 1:] * z[:, :-1], z[1:] * z[:-1])
    for pair in pairs:
        assert abs(pair.mean()) < 5 / np.sqrt(pair.size)
    assert abs((z**3).mean()) < 5 * np.sqrt(6 / z.size)
    assert abs((z**4).mean() - 3) < 0.05


def test_levels_saturate_at_both_ends() -> None:
    seen = camera(background_grey=250.0, clamp_grey=255.0, sheet_grey=1.0, read_noise_grey=3.0)
    mean = seen.expected_levels([[0.09]])[0]
    frame = seen.render([[0.09]], first_index=0)[0].astype(float)
    assert frame.min() == 0
    assert frame.max() == 255
    # The generator ends at 5.19 standard deviations; half a level of rounding.
    reach = 5.19 * np.sqrt(0.025 * np.maximum(mean, 0) + 9) + 0.5
    assert (np.abs(frame - np.clip(mean, 0, 255)) <= reach + 1e-3).all()


def test_frames_have_the_same_bits_in_any_order_and_on_any_number_of_threads() -> None:
    lengths_m = 0.09 + 0.01 * np.sin(np.arange(24 * 5) / 7).reshape(24, 5)
    whole = camera().render(lengths_m, first_index=100)
    seen = camera()

    def one(frame: int) -> NDArray[np.uint8]:
        return seen.render(lengths_m[frame : frame + 1], first_index=100 + frame)[0]

    for workers in (1, 2, 5):
        with ThreadPoolExecutor(workers) as pool:
            backwards = list(pool.map(one, reversed(range(24))))
        np.testing.assert_array_equal(np.array(backwards[::-1]), whole)


def test_a_twin_that_is_interrupted_as_it_starts_its_threads_leaves_none_behind(monkeypatch):
    """A pool does not know such a thread yet: the program would wait for it for ever."""
    twin = make_twin(TwinConfig(), seed=1).camera
    before = set(threading.enumerate())
    whole = threading.Thread.start

    def interrupted(thread: threading.Thread) -> None:
        whole(thread)
        raise KeyboardInterrupt

    monkeypatch.setattr(twin_bench, "_THREADS", 2)
    monkeypatch.setattr(threading.Thread, "start", interrupted)
    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        twin.render(np.full((2, 5), 0.06))
    monkeypatch.undo()
    for thread in set(threading.enumerate()) - before:
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
    assert len(twin.render(np.full((2, 5), 0.06))) == 2


def test_seed_and_index_choose_the_noise() -> None:
    still = np.full((2, 1), 0.09)
    a = camera(seed=1, particles=0).render(still, first_index=0)
    b = camera(seed=2, particles=0).render(still, first_index=0)
    # Two independent roundings of noise of 1.9 to 2.3 grey agree in 1 / (2 sd sqrt(pi)) of the
    # pixels, 0.12 to 0.15.
    assert 0.11 < (a == b).mean() < 0.16
    assert 0.11 < (a[0] == a[1]).mean() < 0.16
    assert (camera(seed=1).true_particle_px(0.09) != camera(seed=2).true_particle_px(0.09)).all()


def test_an_exposure_is_centred_on_its_frame() -> None:
    times_s = camera(exposure_s=2e-3, exposure_samples=4).exposure_times_s([0.0, 0.5])
    middle = np.array([-0.75e-3, -0.25e-3, 0.25e-3, 0.75e-3])
    np.testing.assert_allclose(times_s, [middle, 0.5 + middle], atol=1e-15)


@pytest.mark.parametrize("length_m", [0.01, 0.16, np.nan])
def test_a_length_outside_the_picture_is_refused(length_m: float) -> None:
    # (511 - 15 - 60) px and 2 (16 + 1.6) px of 0.35 mm.
    with pytest.raises(LimitError, match=r"sheet length = .* outside \[0\.01232, 0\.1526\] m"):
        camera().render([[0.09, length_m]], first_index=0)


def test_bad_requests_are_refused() -> None:
    seen = camera(particles=0)
    with pytest.raises(InputError, match=r"shape \(2,\), but it must be \(frames, samples\)"):
        seen.render([0.09, 0.09], first_index=0)
    with pytest.raises(InputError, match="first_index is -1, but"):
        seen.render([[0.09]], first_index=-1)
    with pytest.raises(LimitError, match=r"neck_coefficient = 0.5 .* would fold"):
        camera(neck_coefficient=0.5)
    with pytest.raises(LimitError, match=r"is 10 mm wide, but .* Lower that scale"):
        TwinCamera(TwinCameraConfig(), 0.005, FREE_LENGTH_M, seed=0)
    with pytest.raises(LimitError, match=r"needs at least \d+ rows"):
        camera(height_px=100)
    with pytest.raises(ValidationError, match="longer than a frame"):
        TwinCameraConfig(rate_hz=400, exposure_s=3e-3)
    with pytest.raises(ValidationError, match="dots outside"):
        TwinCameraConfig(width_px=200)
    with pytest.raises(ValidationError, match="Extra inputs"):
        TwinCameraConfig.model_validate({"gain": 1})


def test_one_core_renders_300_frames_a_second(capsys: pytest.CaptureFixture[str]) -> None:
    seen = camera()
    lengths_m = 0.09 + 0.01 * np.sin(np.arange(60 * 5) / 7).reshape(60, 5)
    best_s = np.inf
    for _ in range(5):
        start_s = time.thread_time()
        seen.render(lengths_m, first_index=0)
        best_s = min(best_s, time.thread_time() - start_s)
    with capsys.disabled():
        print(f"[{60 / best_s:.0f} frames/s of 512 x 512 with 5 samples, one core]", end="")
    assert 60 / best_s > 300
