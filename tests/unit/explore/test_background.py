"""Slow work: each piece once, in order, and a failure does not keep the others from being done."""

import threading
from typing import Any

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.explore.background import Jobs


def test_work_is_done_once_and_in_order() -> None:
    jobs, done = Jobs(), []

    def work(name: str) -> Any:
        def run() -> str:
            done.append(name)
            return name * 2

        return run

    first = jobs.ask("a", "title of a", work("a"))
    jobs.ask("b", "title of b", work("b"))
    assert jobs.ask("a", "another", work("never")) is first
    assert jobs.wait(10)
    assert done == ["a", "b"]
    assert [(job.name, job.title, job.state, job.result) for job in jobs.all()] == [
        ("a", "title of a", "ready", "aa"),
        ("b", "title of b", "ready", "bb"),
    ]
    assert jobs.get("a") is first
    assert jobs.get("c") is None


def test_a_failure_is_told_and_the_next_is_done() -> None:
    jobs = Jobs()

    def missing() -> None:
        raise NotAvailableError("no labels here")

    def broken() -> None:
        raise ZeroDivisionError("of nothing")

    jobs.ask("missing", "", missing)
    jobs.ask("broken", "", broken)
    jobs.ask("good", "", lambda: 3)
    assert jobs.wait(10)
    assert [(job.state, job.error) for job in jobs.all()] == [
        ("failed", "no labels here"),
        ("failed", "ZeroDivisionError: of nothing"),
        ("ready", ""),
    ]


def test_what_runs_is_not_waited_for() -> None:
    jobs, go = Jobs(), threading.Event()
    slow = jobs.ask("slow", "", go.wait)
    late = jobs.ask("late", "", lambda: 1)
    assert not jobs.wait(0.05)
    assert not slow.is_done
    jobs.end()
    go.set()
    assert jobs.wait(10)
    assert late.result == 1  # it was asked for before the end
    after = jobs.ask("after", "", lambda: 2)
    assert not jobs.wait(0.05)
    assert after.state == "waiting"
