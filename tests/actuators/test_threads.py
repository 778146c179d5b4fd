"""Calls in threads: order of the results, errors, and Ctrl-C, which does not wait for them."""

import subprocess
import sys
import threading

import pytest

from haselab.actuators.threads import in_threads

# The calls take longer than the test waits; a second thread sends Ctrl-C once they run.
SCRIPT = """
import os, signal, sys, threading, time
from haselab.actuators.threads import in_threads
runs = threading.Event()
def job(item):
    runs.set()
    time.sleep(900.0)
def ask():
    runs.wait()
    time.sleep(0.2)
    os.kill(os.getpid(), signal.SIGINT)
threading.Thread(target=ask, daemon=True).start()
try:
    in_threads(job, range(5), 2)
except KeyboardInterrupt:
    sys.exit(130)
"""


def test_results_have_the_order_of_the_items():
    assert in_threads(lambda k: k * k, range(50), 3) == [k * k for k in range(50)]


def test_no_more_threads_than_stated_run_at_once():
    used = set()
    both = threading.Barrier(2, timeout=60)

    def job(_):
        both.wait()
        used.add(threading.get_ident())

    in_threads(job, range(6), 2)
    assert len(used) == 2
    assert in_threads(abs, [], 2) == []


def test_an_error_leaves_out_the_items_that_have_not_begun():
    begun, left, ended = [], threading.Event(), threading.Event()

    def job(k):
        begun.append(k)
        if k == 0:
            raise ValueError(f"item {k}")
        left.wait(60.0)
        ended.set()

    with pytest.raises(ValueError, match="item 0"):
        in_threads(job, range(100), 1)
    left.set()
    if len(begun) > 1:
        ended.wait(60.0)
    assert begun in ([0], [0, 1])


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX's")
def test_an_interrupt_does_not_wait_for_calls_that_run():
    done = subprocess.run([sys.executable, "-c", SCRIPT], timeout=300, check=False)
    assert done.returncode == 130
