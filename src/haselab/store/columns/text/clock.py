"""Clock times in the cells of a text table, such as 2026-03-29T14:05:01.25 or 14:05:01,25."""

from __future__ import annotations

import re
from datetime import date

__all__ = ["DAY_S", "clock_s"]

_CLOCK = re.compile(
    r"(?:(?P<year>\d{4})-(?P<month>\d\d)-(?P<day>\d\d)[T ]\s*"
    r"|(?P<day2>\d\d?)\.(?P<month2>\d\d?)\.(?P<year2>\d{4})[T ,]\s*"
    r"|(?P<slashes>\d{1,4}/\d\d?/\d{1,4})[T ,]\s*)?"
    r"(?P<hour>\d\d?):(?P<minute>\d\d):(?P<second>\d\d(?:[.,]\d+)?)"
    r"\s*(?P<half>[AP]M)?"
    r"\s*(?:Z|UTC|(?P<sign>[+-])(?P<offset>\d\d):?(?P<minutes>\d\d))?",
    re.IGNORECASE,
)
DAY_S, _HOUR_S, _MINUTE_S = 86_400, 3_600, 60


def clock_s(cell: str, first_day: int | None = None) -> tuple[float, int] | None:
    """Seconds of a clock time.

    Without a date, the time is that of the day. Dates are written year-month-day or day.month.year.
    With slashes, the order of day and month would be a guess, so such a date must not change.

    Args:
        cell: text.
        first_day: from whose midnight the seconds are counted; None: that of the cell.
    Returns:
        Seconds, and the number of the day from which they are counted (negative: a date with
        slashes); None if the text is no clock time, or if a date with slashes has changed.
    Example:
        >>> clock_s("2026-03-29T00:01:00.5")
        (60.5, 739704)
        >>> clock_s("30.03.2026 00:00:00", first_day=739704)
        (86400.0, 739704)
    """
    found = _CLOCK.fullmatch(cell.strip().strip('"'))
    if found is None:
        return None
    hour, second = int(found["hour"]), float(found["second"].replace(",", "."))
    if hour > (12 if found["half"] else 23) or int(found["minute"]) > 59 or second >= 61.0:
        return None  # a leap second has 60
    if found["half"]:
        hour = hour % 12 + (12 if found["half"].upper() == "PM" else 0)
    year = found["year"] or found["year2"]
    day = 0
    if year:
        try:
            month, of_month = found["month"] or found["month2"], found["day"] or found["day2"]
            day = date(int(year), int(month), int(of_month)).toordinal()
        except ValueError:
            return None
    elif found["slashes"]:
        day = -int("".join(part.zfill(4) for part in found["slashes"].split("/")))
    first_day = day if first_day is None else first_day
    if day != first_day and min(day, first_day) < 0:
        return None
    seconds = _HOUR_S * hour + _MINUTE_S * int(found["minute"]) + second
    if found["sign"]:
        ahead = _HOUR_S * int(found["offset"]) + _MINUTE_S * int(found["minutes"])
        seconds -= ahead if found["sign"] == "+" else -ahead
    return DAY_S * (day - first_day) + seconds, first_day
