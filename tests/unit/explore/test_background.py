"""Slow work: each piece once, in order, and a failure does not keep the others from being done."""

import threading
from typing import Any

import pytest

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.explore import background
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


def test_the_results_that_were_not_asked_for_the_longest_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(background, "_MOST", 3)
    jobs, done, go = Jobs(), [], threading.Event()

    def ask(name: str) -> None:
        jobs.ask(name, "", lambda: done.append(name))
        assert jobs.wait(10)

    for name in ("a", "b", "c", "a", "d", "a", "b"):  # with d, b has to go, and with b, c
        ask(name)
    assert done == ["a", "b", "c", "d", "b"]
    for name in ("slow", "late", "later", "last"):
        jobs.ask(name, "", go.wait)
    assert [job.name for job in jobs.all()] == ["slow", "late", "later", "last"]  # what is not done stays
    go.set()
    assert jobs.wait(10)


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
