"""Chunks side by side: NumPy lets other threads run while it works on arrays, and every chunk is a stream of its own."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

THREADS_MOST = 2
"""Chunks in work at once. Each takes memory while it is coded, and more than two wait for the interpreter."""


def thread_count(chunks: int) -> int:
    """Threads for so many chunks on this machine."""
    try:
        processors = len(os.sched_getaffinity(0))
    except AttributeError:
        processors = os.cpu_count() or 1
    return max(min(THREADS_MOST, processors, chunks), 1)


def in_order(
    work: Callable[[Item], Result], items: Iterable[Item], threads: int, always: bool = False
) -> Generator[Result, None, None]:
    """`work` of every item, in order; at most `threads` of them are in work or finished before they are asked for.

    With one thread no other one is started, unless `always` asks for it.
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
