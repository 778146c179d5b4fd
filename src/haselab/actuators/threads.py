"""Run a function in several threads without delaying Ctrl-C."""

from __future__ import annotations

import queue
from collections import deque
from collections.abc import Callable, Iterable
from threading import Thread
from typing import TypeVar

__all__ = ["in_threads"]

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(job: Callable[[Item], Result], items: Iterable[Item], most: int) -> list[Result]:
    """Apply a function to each item, in several threads.

    A `KeyboardInterrupt` ends this function, and the program, at once. A `ThreadPoolExecutor` would
    first wait for all running calls, which may be simulations of many seconds.

    Args:
        job: applied to each item.
        items: arguments of the calls.
        most: largest number of threads at the same time.
    Returns:
        The results, in the order of the items.
    Raises:
        Exception: The first one that the function raised.
    Example:
        >>> in_threads(abs, [-1, 2, -3], 2)
        [1, 2, 3]
    """
    todo = deque(enumerate(items))
    count = len(todo)
    done: queue.SimpleQueue[tuple[int, Result | None, BaseException | None]] = queue.SimpleQueue()

    def work() -> None:
        while todo:
            try:
                k, item = todo.popleft()
            except IndexError:  # another thread took the last one
                return
            try:
                done.put((k, job(item), None))
            except BaseException as error:
                done.put((k, None, error))

    found: dict[int, Result] = {}
    try:
        for _ in range(min(most, count)):
            Thread(target=work, daemon=True).start()
        for _ in range(count):
            k, result, error = done.get()
            if error is not None:
                raise error
            found[k] = result  # type: ignore[assignment]
    finally:
        todo.clear()
    return [found[k] for k in range(count)]
