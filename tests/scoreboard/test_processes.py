"""Jobs that end their process, hang, print, or leave something behind do not affect the others."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import sys
import threading
import time

import pytest

from haselab.base import InputError
from haselab.scoreboard.processes import Lost, Workers, announce_limit

_SEEN: list[str] = []


def _job(what: str) -> tuple[str, int]:
    """Misbehave, then return how many jobs this process has seen."""
    _SEEN.append(what)
    if what == "exits":
        os._exit(3)
    if what == "crashes":
        os.kill(os.getpid(), signal.SIGSEGV)
    if what == "starts a thread":
        threading.Thread(target=time.sleep, args=(1000.0,)).start()
    if what == "copies itself":
        os.fork()
    if what == "starts a process":
        with multiprocessing.get_context("fork").Pool(1) as pool:
            assert pool.apply(os.getppid) == os.getpid()
    if what == "returns a lambda":
        return (lambda: None), 1  # type: ignore[return-value]
    if what == "prints":
        print("text")
    if what == "hangs":
        announce_limit(0.3, "it takes too long")
        while True:
            try:
                time.sleep(1000.0)
            except Exception:
                continue
    if what == "cancels":
        raise asyncio.CancelledError
    if what == "refuses":
        raise InputError("This is wrong.")
    return what, len(_SEEN)


def _found(items: list[str]) -> dict[str, object]:
    workers = Workers(2)
    try:
        return {items[place]: result for place, result in workers.each(_job, items)}
    finally:
        workers.close()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux forks a process for each job")
def test_what_a_job_does_to_its_process_does_not_affect_the_others(capfd):
    good = ["first", "starts a thread", "starts a process", "copies itself", "prints", "last"]
    bad = {
        "exits": "its process ended with exit code 3",
        "crashes": "its process was ended by SIGSEGV",
        "hangs": "it takes too long",
    }
    found = _found(["first", *bad, "returns a lambda", *good[1:]])
    lost = found.pop("returns a lambda")
    assert isinstance(lost, Lost) and lost.reason.startswith("its result cannot be sent: ")
    assert {name: found[name] for name in bad} == {k: Lost(why) for k, why in bad.items()}
    # no job sees that another one was done before
    assert {name: found[name] for name in good} == {name: (name, 1) for name in good}
    out, err = capfd.readouterr()
    assert out == "" and "text" in err


def test_an_error_of_a_job_is_raised_where_the_jobs_were_given():
    with pytest.raises(InputError, match="This is wrong"):
        _found(["refuses"])
    with pytest.raises(RuntimeError, match="CancelledError"):
        _found(["cancels"])
