"""Live signals in shared memory: what a page sees of every sample."""

from __future__ import annotations

import errno
import math
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haselab.base import DeviceError
from haselab.panel.columns import SIGNALS, LiveReader, LiveWriter

RATE_HZ, BLOCK = 200e3, 2000
BLOCK_S = BLOCK / RATE_HZ
NOTHING = (math.nan,) * len(SIGNALS)


def blocks(count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).integers(-500, 500, (count, BLOCK, 2)).astype(np.int16)


def test_a_spike_of_one_sample_is_in_the_column_of_its_time_at_every_zoom(tmp_path: Path) -> None:
    rng, codes = np.random.default_rng(3), blocks(600)
    where = rng.choice(600 * BLOCK, 1000, replace=False)
    codes[where // BLOCK, where % BLOCK, 0] = 30000
    with LiveWriter(tmp_path / "live", RATE_HZ, BLOCK, (1.0, 1.0)) as writer:
        for k, block in enumerate(codes):
            writer.append(block, (k + 1) * BLOCK_S, NOTHING)
        reader = LiveReader(tmp_path / "live")
        for span_s in (6.0, 3.0, 0.5, 0.05, 0.004):
            for sample in where:
                spike_s = (sample + 0.5) / RATE_HZ
                from_s = min(max(spike_s - span_s * rng.random(), 0.0), 6.0 - span_s)
                seen = reader.monitors(from_s, from_s + span_s, 600)
                column = math.floor((spike_s - seen.start_s) / seen.step_s)
                if not 0 <= column < len(seen.high):  # partial columns at the ends are not shown
                    assert min(spike_s - from_s, from_s + span_s - spike_s) <= seen.step_s
                    continue
                assert seen.high[column, 0] == 30000.0
        reader.close()
    assert not (tmp_path / "live").exists()


@settings(max_examples=40, deadline=None)
@given(
    from_s=st.floats(0.0, 0.39), span_s=st.floats(1e-4, 0.4), most=st.integers(16, 2000),
    channel=st.integers(0, 1),
)  # fmt: skip
def test_columns_are_the_extremes_of_their_samples(
    tmp_path_factory: pytest.TempPathFactory, from_s: float, span_s: float, most: int, channel: int
) -> None:
    codes = blocks(40, seed=7)
    path = tmp_path_factory.mktemp("panel") / "live"
    with LiveWriter(path, RATE_HZ, BLOCK, (0.5, 2.0)) as writer:
        for k, block in enumerate(codes):
            writer.append(block, (k + 1) * BLOCK_S, NOTHING)
        reader = LiveReader(path)
        seen = reader.monitors(from_s, from_s + span_s, most)
        reader.close()
    assert len(seen.high) <= most + 1
    samples, scale = codes.reshape(-1, 2)[:, channel], (0.5, 2.0)[channel]
    per, first = round(seen.step_s * RATE_HZ), round(seen.start_s * RATE_HZ)
    for k in range(len(seen.high)):
        part = samples[first + k * per : first + (k + 1) * per]
        assert (seen.low[k, channel], seen.high[k, channel]) == (
            part.min() * scale,
            part.max() * scale,
        )


def test_signals_skip_missing_values_and_end_at_a_gap(tmp_path: Path) -> None:
    with LiveWriter(tmp_path / "live", RATE_HZ, BLOCK, (1.0, 1.0)) as writer:
        codes = blocks(1)[0]
        reader = LiveReader(tmp_path / "live")
        for k in range(10):
            writer.append(codes, (k + 1) * BLOCK_S, NOTHING)
            assert math.isnan(reader.gap_s)
        for k in range(20):  # after a gap of 5 s
            value = math.nan if k % 2 else float(k)
            writer.append(codes, 5.0 + (k + 1) * BLOCK_S, (value, *NOTHING[1:]))
        seen = reader.signals(0.0, 5.2, 10)
        assert seen.start_s == pytest.approx(5.0)  # what was before the gap is not shown
        assert seen.low[:, 0].tolist() == seen.high[:, 0].tolist() == list(range(0, 20, 2))
        assert np.isnan(seen.low[:, 1]).all()
        assert reader.monitors(0.0, 5.2, 400).start_s >= 5.0
        assert reader.gap_s == pytest.approx(5.0)
        assert reader.end_s == pytest.approx(5.2)
        reader.close()


@pytest.mark.parametrize("missing", [1, 3, 150])
def test_what_was_before_a_short_gap_is_shown_at_its_time(tmp_path: Path, missing: int) -> None:
    """0 V is read back with blocks that no page sees: what led to a STOP must not vanish."""
    codes, late_s = blocks(40), 0.3 * BLOCK_S
    with LiveWriter(tmp_path / "live", RATE_HZ, BLOCK, (1.0, 1.0)) as writer:
        reader, end_s = LiveReader(tmp_path / "live"), 0.0
        for k in range(40):
            end_s = (k + 1) * BLOCK_S + (missing * BLOCK_S + late_s if k >= 20 else 0.0)
            writer.append(codes[k], end_s, (float(k), *NOTHING[1:]))
        assert math.isnan(reader.gap_s) and reader.end_s == pytest.approx(end_s)
        for most in (40 * BLOCK * 2, (40 + missing) * 100, 40 + missing):  # by sample, finer, block
            seen = reader.monitors(0.0, end_s, most)
            time_s = seen.start_s + (np.arange(len(seen.low)) + 0.5) * seen.step_s - late_s
            known = ~np.isnan(seen.low[:, 0])
            after_s = (20 + missing) * BLOCK_S
            inside = (time_s > 20 * BLOCK_S + seen.step_s) & (time_s < after_s - seen.step_s)
            assert not known[inside].any(), "a block that nobody saw has no value"
            for part, chosen in (
                (codes[:20], time_s < 20 * BLOCK_S), (codes[20:], time_s > after_s)
            ):  # fmt: skip
                assert known[chosen].all()
                assert np.nanmax(seen.high[chosen, 0]) <= part[..., 0].max()
                assert np.nanmin(seen.low[chosen, 1]) >= part[..., 1].min()
            assert np.nanmax(seen.high[:, 0]) == codes[..., 0].max()
        drive = reader.signals(0.0, end_s, 1000).high[:, 0]
        assert drive[~np.isnan(drive)].tolist() == list(range(40))
        assert np.isnan(drive).sum() == missing
        reader.close()


def test_a_ring_that_has_wrapped_around_shows_its_newest_part(tmp_path: Path) -> None:
    with LiveWriter(tmp_path / "live", 1000.0, 250, (1.0, 1.0)) as writer:
        codes = np.zeros((250, 2), np.int16)
        for k in range(9000):  # the level of single samples keeps 8000 blocks
            codes[:, 0] = k % 30000
            writer.append(codes, (k + 1) * 0.25, NOTHING)
        reader = LiveReader(tmp_path / "live")
        seen = reader.monitors(2240.0, 2250.0, 20_000)
        assert seen.step_s == 1e-3 and len(seen.high) == 10_000
        assert seen.high[-1, 0] == 8999.0
        early = reader.monitors(0.0, 2250.0, 4000)  # no coarser level reaches back: 250 samples
        assert early.start_s > 200.0
        reader.close()


def test_the_space_is_reserved_before_the_bench_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else memory that is full ends the bench process by SIGBUS, in the middle of a run."""
    with LiveWriter(tmp_path / "live", RATE_HZ, BLOCK, (1.0, 1.0)):
        found = (tmp_path / "live").stat()
        assert 512 * found.st_blocks >= found.st_size

    def full(*given: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(DeviceError, match=r"No space left on device.*Free at least \d+ MB"):
        LiveWriter(tmp_path / "other", RATE_HZ, BLOCK, (1.0, 1.0))
