"""Capacitance and displacements from arrays: against what made them."""

import numpy as np
import pandas as pd
import pytest

import haselab as hl
from haselab.base import InputError
from haselab.store.video.writer import VideoWriter

RATE_HZ, CARRIER_HZ = 200_000.0, 2000.0
CAPACITANCE_F, RESISTANCE_OHM = 1.2e-9, 50e3


def monitors() -> pd.DataFrame:
    """5 kV/V and 2 mA/V monitors of a capacitor with a resistor in series, at the carrier."""
    phase = 2.0 * np.pi * CARRIER_HZ * np.arange(20_000) / RATE_HZ
    impedance_ohm = RESISTANCE_OHM + 1.0 / (2j * np.pi * CARRIER_HZ * CAPACITANCE_F)
    volts, amperes = 100.0, 100.0 / impedance_ohm
    frame = pd.DataFrame({
        "v_monitor_v": (volts * np.exp(1j * phase)).real / 5000.0,
        "i_monitor_v": (amperes * np.exp(1j * phase)).real / 2e-3,
    })  # fmt: skip
    rng = np.random.default_rng(1)
    return frame + 1e-5 * rng.normal(size=frame.shape)


def test_the_capacitor_and_its_resistor_are_found():
    sensed = hl.sense(monitors(), carrier_hz=CARRIER_HZ, rate_hz=RATE_HZ)
    assert sensed["valid"].all() and sensed["time_s"].size == 10
    for name, truth in (("capacitance", CAPACITANCE_F), ("resistance", RESISTANCE_OHM)):
        unit = "f" if name == "capacitance" else "ohm"
        off = np.abs(sensed[f"{name}_{unit}"] - truth)
        assert (off < 5.0 * sensed[f"{name}_std_{unit}"]).all()
    assert sensed.to_xarray().resistance_ohm.attrs["units"] == "ohm"


def test_what_is_missing_is_named():
    frame = monitors()
    with pytest.raises(InputError, match="no sampling rate"):
        hl.sense(frame, carrier_hz=CARRIER_HZ)
    with pytest.raises(InputError, match="no column 'U'"):
        hl.sense(frame, carrier_hz=CARRIER_HZ, rate_hz=RATE_HZ, v="U")
    with pytest.raises(InputError, match="one block has 2000"):
        hl.sense(frame[:1000], carrier_hz=CARRIER_HZ, rate_hz=RATE_HZ)


def frames(shifts_px: list[float]) -> list[np.ndarray]:
    """A smooth pattern that moves to the right."""
    x, y = np.meshgrid(np.arange(120.0), np.arange(90.0))
    waves = np.random.default_rng(2).uniform([0.2, 0.2, 0.0], [0.7, 0.7, 6.28], (12, 3))
    images = []
    for shift_px in shifts_px:
        bright = sum(np.cos(a * (x - shift_px) + b * y + c) for a, b, c in waves)
        images.append(np.clip(127.0 + 12.0 * bright, 0, 255).round().astype(np.uint8))
    return images


def test_points_follow_a_moving_pattern():
    shifts_px = [0.0, 0.5, 1.25, 2.0]
    points = pd.DataFrame({"x_px": [40.0, 80.0], "y_px": [45.0, 45.0]})
    found = hl.track(frames(shifts_px), points, rate_hz=50.0, scale_mm_per_px=0.1)
    frame = found.to_pandas()
    assert frame["valid"].all() and len(frame) == 8
    moved_px = frame["x_px"] - np.tile([40.0, 80.0], 4)
    # Grey levels are whole numbers: the deviation that is given counts their rounding.
    off = np.abs(moved_px - np.repeat(shifts_px, 2))
    assert (off < 5.0 * np.maximum(frame["std_x_px"], 0.005)).all()
    assert frame["time_s"].iloc[-1] == pytest.approx(3 / 50.0)
    assert np.array_equal(frame["x_mm"], 0.1 * frame["x_px"])
    assert np.allclose(frame["displacement_x_m"], 1e-4 * moved_px, rtol=0.0, atol=1e-12)
    assert np.abs(frame["displacement_y_m"]).max() < 1e-4 * 0.05


def test_a_file_gives_the_tracks_of_its_frames_and_its_own_times(tmp_path):
    images, points = frames([0.0, 0.5, 1.25, 2.0]), np.array([[40.0, 45.0]])
    writer = VideoWriter(tmp_path / "clip.mkv", 50.0)  # lossless
    writer.append(np.stack(images), np.arange(4) / 50.0)
    writer.close()
    found = hl.track(tmp_path / "clip.mkv", points)
    assert np.array_equal(found["x_px"], hl.track(images, points)["x_px"])
    assert np.allclose(found["time_s"], np.arange(4) / 50.0, atol=1e-3)  # Matroska counts in ms


def test_a_video_without_frames_is_refused():
    with pytest.raises(InputError, match="no frame"):
        hl.track([], np.zeros((1, 2)))


@pytest.mark.parametrize(
    ("headers", "factors"),
    [
        (("v (mV)", "i (V)"), (1e3, 1.0)),
        (("v (V)", "i (mA)"), (1.0, 2e-3 * 1e3)),
        (("v (kV)", "i (V)"), (5000.0 * 1e-3, 1.0)),
    ],
)
def test_units_of_a_file_give_the_scales(tmp_path, headers, factors):
    rows = monitors().to_numpy() * factors
    path = tmp_path / "a.csv"
    np.savetxt(path, rows, "%.10g", ",", header=",".join(headers), comments="")
    sensed = hl.sense(path, carrier_hz=CARRIER_HZ, rate_hz=RATE_HZ, v="v", i="i")
    assert sensed["valid"].all()
    assert sensed["capacitance_f"] == pytest.approx(CAPACITANCE_F, rel=0.01)


def test_a_column_of_another_quantity_is_refused(tmp_path):
    path = tmp_path / "a.csv"
    np.savetxt(path, monitors().to_numpy(), "%.10g", ",", header="v (V),i (pF)", comments="")
    with pytest.raises(InputError, match=r"column of --i is in pF, but must be in V or A"):
        hl.sense(path, carrier_hz=CARRIER_HZ, rate_hz=RATE_HZ, v="v", i="i")


def test_one_column_for_both_monitors_is_refused():
    data = {"time_s": np.arange(2000) / 2e5, "v": np.sin(np.arange(2000.0))}
    with pytest.raises(InputError, match=r"^Column 'v' is named for two quantities\. Name another"):
        hl.sense(data, carrier_hz=2000.0, v="v", i="v")
