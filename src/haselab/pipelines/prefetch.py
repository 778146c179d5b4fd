"""Do work in background threads while earlier results are used."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar, cast

__all__ = ["map_in_order", "prefetch"]

S = TypeVar("S")
T = TypeVar("T")
_END = object()


def prefetch(items: Iterator[T], depth: int = 2) -> Iterator[T]:
    """Produce items ahead of time in a background thread.

    Args:
        items: an iterator that takes time; its errors are raised here, in order.
        depth: how many items are produced ahead at most.
    Returns:
        The items, in order.
    Example:
        >>> list(prefetch(iter([1, 2, 3])))
        [1, 2, 3]
    """
    maker = ThreadPoolExecutor(1)
    try:
        waiting = deque(maker.submit(next, items, _END) for _ in range(depth))
        while (item := waiting.popleft().result()) is not _END:
            waiting.append(maker.submit(next, items, _END))
            yield cast(T, item)
    finally:
        maker.shutdown(wait=True, cancel_futures=True)


def map_in_order(work: Callable[[S], T], items: Iterator[S], workers: int) -> Iterator[T]:
    """Apply a function to each item in threads, and return the results in order.

    Args:
        work: the function. Its heavy parts must release the interpreter lock, as reading and the C
            kernels do. It may carry state from item to item only with one worker.
        items: of these, one more than there are workers is taken ahead.
        workers: number of threads.
    Returns:
        The results in the order of the items.
    Example:
        >>> list(map_in_order(abs, iter([-1, 2, -3]), workers=2))
        [1, 2, 3]
    """
    pool = ThreadPoolExecutor(workers)
    waiting: deque[Future[T]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
