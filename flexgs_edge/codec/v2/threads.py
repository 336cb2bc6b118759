"""Code chunks and fit groups in parallel threads: none needs another, and NumPy releases the interpreter's lock."""

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

THREADS_MOST = 2  # Most chunks in work at once. Each takes memory, and more than two wait for the interpreter's lock.


def thread_count(chunks: int) -> int:
    """Number of threads that code so many chunks on this machine."""
    try:
        processors = len(os.sched_getaffinity(0))
    except AttributeError:
        processors = os.cpu_count() or 1
    return max(min(THREADS_MOST, processors, chunks), 1)


def in_order(
    work: Callable[[Item], Result], items: Iterable[Item], threads: int, always: bool = False
) -> Generator[Result, None, None]:
    """Yield `work(item)` of every item, in order; at most `threads` items are in work or finished ahead.

    With one thread, the caller does the work itself, unless `always` asks for a thread.
    """
    if threads <= 1 and not always:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        waiting: deque[Future[Result]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(work, item))
                if len(waiting) > threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
