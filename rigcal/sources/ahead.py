"""Work on items in a second thread while the next ones are fetched.

Owns      the thread and the order.
Leaves    what is fetched and what is made of it to the readers of pictures, whose decoders take one core each.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

# More would take the memory of a picture each, for every camera that is read at the same time.
AHEAD = 1
Item = TypeVar("Item")
Made = TypeVar("Made")


def made_ahead(make: Callable[[Item], Made], items: Iterable[Item]) -> Iterator[Made]:
    """What ``make`` makes of each item, in their order.

    Args:
        make: Called with one item at a time, in another thread.
        items: Fetched in the caller's thread, up to AHEAD more than what has been handed out.
    """
    with ThreadPoolExecutor(1) as worker:
        coming: deque[Future[Made]] = deque()
        for item in items:
            coming.append(worker.submit(make, item))
            if len(coming) > AHEAD:
                yield coming.popleft().result()
        while coming:
            yield coming.popleft().result()
