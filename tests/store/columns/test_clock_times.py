"""Clock times in text tables, as loggers and spreadsheets write them."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import haselab as hl
from haselab.base import InputError
from haselab.store.columns.reader import open_columns
from haselab.store.columns.text.clock import clock_s

START = datetime(2026, 3, 29, 23, 59, 57)  # the record passes midnight
TIME_S = np.arange(500) / 50.0
U = np.repeat(np.random.default_rng(1).normal(size=50), 10)


def write(folder: Path, times: list[str], header: str = "Zeitstempel,u,y") -> Path:
    mark = ";" if ";" in header else ","
    rows = [mark.join((t, f"{u:.6f}", f"{2 * u:.6f}")) for t, u in zip(times, U, strict=True)]
    path = folder / "logged.csv"
    path.write_text("\n".join([header, *rows]))
    return path


def stamps(form: str, start: datetime = START) -> list[str]:
    """As `strftime`, with milliseconds for %f."""
    found = [start + timedelta(seconds=float(t)) for t in TIME_S]
    return [one.strftime(form.replace("%f", f"{one.microsecond // 1000:03d}")) for one in found]


@pytest.mark.parametrize(
    ("form", "header"),
    [
        ("%Y-%m-%dT%H:%M:%S.%f", "Zeitstempel,u,y"),
        ("%Y-%m-%d %H:%M:%S.%fZ", "when,u,y"),
        ("%Y-%m-%dT%H:%M:%S.%f+02:00", "time,u,y"),
        ('"%Y-%m-%d %H:%M:%S.%f"', '"time","u","y"'),
        ("%d.%m.%Y %H:%M:%S,%f", "Datum/Uhrzeit;u;y"),
        ("%H:%M:%S.%f", "Uhrzeit,u,y"),
        ("%I:%M:%S.%f %p", "time,u,y"),
    ],
)
def test_dates_and_times_give_the_rate_across_midnight(
    form: str, header: str, tmp_path: Path
) -> None:
    (found,) = hl.records(write(tmp_path, stamps(form), header))
    assert found.input_rate_hz == pytest.approx(50.0, rel=1e-9)


@pytest.mark.parametrize("form", ["%H:%M:%S.%f", "%m/%d/%Y %H:%M:%S.%f", "%m/%d/%Y %I:%M:%S.%f %p"])
def test_times_of_a_day_need_no_date(form: str, tmp_path: Path) -> None:
    path = write(tmp_path, stamps(form, START.replace(hour=12)))
    assert hl.load(path).time_s[-1] - hl.load(path).time_s[0] == pytest.approx(TIME_S[-1])
    assert hl.records(path)[0].input_rate_hz == pytest.approx(50.0)


def test_a_date_whose_order_is_not_known_must_not_change(tmp_path: Path) -> None:
    path = write(tmp_path, stamps("%m/%d/%Y %H:%M:%S.%f"))
    with pytest.raises(InputError, match=r"has '03/30/2026 00:00:00.000' in line 152, which"):
        hl.records(path)


@pytest.mark.parametrize("form", ["%Y-%m-%dT%H:%M:%S", "%H:%M:%S", "%d.%m.%Y %H:%M:%S"])
def test_whole_seconds_are_no_times_of_fast_rows(form: str, tmp_path: Path) -> None:
    """A stated rate is used as before; without one, the reason is named."""
    path = write(tmp_path, stamps(form, START.replace(hour=12)))
    with pytest.raises(InputError, match=r"no sampling rate\. Column Zeitstempel does not rise"):
        hl.records(path)
    assert hl.records(path, rate_hz=50.0)[0].input_rate_hz == 50.0
    with open_columns(path, ["u"]) as stream:
        assert stream.rate_hz is None


def test_dates_of_the_same_digits_differ() -> None:
    _, day = clock_s("1/11/2026 10:00:00") or (0.0, 0)
    assert clock_s("11/1/2026 10:00:00", day) is None
    assert clock_s("1/11/2026 10:00:01", day) == (36001.0, day)


def test_a_word_among_clock_times_is_named(tmp_path: Path) -> None:
    times = stamps("%Y-%m-%dT%H:%M:%S.%f")
    times[450] = "lost"
    with pytest.raises(InputError, match=r"Column Zeitstempel has 'lost' in line 452"):
        hl.records(write(tmp_path, times), time="Zeitstempel")


def test_a_column_of_numbers_called_time_comes_first(tmp_path: Path) -> None:
    path = tmp_path / "both.csv"
    rows = [f"{t},{s},{u}" for t, s, u in zip(TIME_S, stamps("%H:%M:%S.%f"), U, strict=True)]
    path.write_text("\n".join(["time_s,start,u", *rows]))
    assert hl.load(path).time_name == "time_s"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "12",
        "12:30",
        "25:00:00",
        "2026-13-01T00:00:00",
        "32.01.2026 00:00:00",
        "1:2:3",
        "24:30:00",
        "12:00:75",
        "13:00:00 PM",
    ],
)
def test_what_is_no_clock_time(text: str) -> None:
    assert clock_s(text) is None


@pytest.mark.parametrize(
    "text",
    ["2026-03-29T23:59:57.125+02:00", "2026-03-29 23:59:57.125-05:30", "2024-02-29T00:00:01Z"],
)
def test_the_seconds_are_those_of_pandas(text: str) -> None:
    seconds, day = clock_s(text) or (0.0, 0)
    since = pd.Timestamp(text).tz_convert("UTC").tz_localize(None) - pd.Timestamp(
        datetime.fromordinal(day)
    )
    assert seconds == pytest.approx(since.total_seconds(), abs=1e-9)
