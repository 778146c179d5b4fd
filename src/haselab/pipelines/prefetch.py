"""Work that goes on in the background while what is done is used."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar, cast

__all__ = ["ahead", "in_order"]

S = TypeVar("S")
T = TypeVar("T")
_END = object()


def ahead(items: Iterator[T], depth: int = 2) -> Iterator[T]:
    """The same items, the next ones made in a thread of their own.

    Args:
        items: whatever takes time to make; its errors are raised here, in their place.
        depth: how many items are made ahead at most.
    Returns:
        The items in their order.
    Example:
        >>> list(ahead(iter([1, 2, 3])))
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


def in_order(work: Callable[[S], T], items: Iterator[S], workers: int) -> Iterator[T]:
    """The work on each item, done in threads while earlier results are used.

    Args:
        work: must let other threads run where it is heavy, as reading and the C kernels do. With
            one worker it may go on from item to item; with more it must not.
        items: as many as workers are taken ahead, and one more.
        workers: threads.
    Returns:
        The results in the order of the items.
    Example:
        >>> list(in_order(abs, iter([-1, 2, -3]), workers=2))
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
