"""Tasks are handed in as their results are taken: no more of either is in memory than was asked for."""

from __future__ import annotations

from concurrent.futures import Executor, Future

import pytest

from barpc.base.tasks import one_by_one


class Counting(Executor):
    """Works at once, and counts what nobody has taken yet."""

    def __init__(self) -> None:
        self.given = 0

    def submit(self, fn, /, *args, **kwargs):
        self.given += 1
        future = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@pytest.mark.parametrize("ahead", [1, 3, 20, None])
def test_results_come_in_order_and_so_many_are_handed_in_ahead(ahead):
    executor, tasks = Counting(), [(k,) for k in range(10)]
    for taken, found in enumerate(one_by_one(executor, abs, tasks, "abs", ahead=ahead)):
        assert found == taken
        assert executor.given == min(10, taken + (ahead or 10))
