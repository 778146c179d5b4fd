"""When a recording was made, how long it took, and by which commit."""

from __future__ import annotations

import re

from haselab.store.manifest import recorded_when
from haselab.store.source_commit import source_commit


def test_date_and_duration_are_those_of_the_manifest() -> None:
    manifest = {"opened": "2026-01-02T03:04:05.6+00:00", "closed": "2026-01-02T03:05:05.9+00:00"}
    assert recorded_when(manifest) == {"date": "2026-01-02T03:04:05+00:00", "wall_time_s": 60.3}


def test_an_older_or_broken_manifest_says_what_it_can() -> None:
    assert recorded_when({}) == {}
    assert recorded_when({"opened": "yesterday", "closed": "today"}) == {}
    assert recorded_when({"opened": "2026-01-02T03:04:05+00:00"}) == {
        "date": "2026-01-02T03:04:05+00:00"
    }


def test_the_commit_is_a_hash_or_empty() -> None:
    assert re.fullmatch(r"([0-9a-f]{12,40}(-dirty)?)?|.*-g[0-9a-f]+(-dirty)?", source_commit())
