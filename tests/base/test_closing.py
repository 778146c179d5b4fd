"""What closes itself does so however its block ends."""

import pytest

from haselab.base import Closing


class Open(Closing):
    closed = 0

    def close(self) -> None:
        self.closed += 1


def test_the_end_of_the_block_closes_once() -> None:
    with Open() as opened:
        assert opened.closed == 0
    assert opened.closed == 1


def test_an_error_closes_too_and_is_passed_on() -> None:
    opened = Open()
    with pytest.raises(RuntimeError, match=r"of the block"), opened:
        raise RuntimeError("of the block")
    assert opened.closed == 1
