"""Slow work: each piece once, in order, and a failure does not keep the others from being done."""

import threading
from unittest.mock import Mock

import pytest

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.plugins.explore import background
from deepaccident_devkit.plugins.explore.background import Jobs


def test_a_failure_is_told_and_the_next_is_done() -> None:
    jobs = Jobs()
    jobs.ask("missing", "", Mock(side_effect=NotAvailableError("no labels here")))
    jobs.ask("broken", "", Mock(side_effect=ZeroDivisionError("of nothing")))
    jobs.ask("good", "", lambda: 3)
    assert jobs.wait(60)
    assert [(job.state, job.error) for job in jobs.all()] == [
        ("failed", "no labels here"),
        ("failed", "ZeroDivisionError: of nothing"),
        ("ready", ""),
    ]


def test_the_results_that_were_not_asked_for_the_longest_go(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(background, "MAX_JOBS", 3)
    jobs, done = Jobs(), []
    for name in ("a", "b", "c", "a", "d", "a", "b"):  # with d, b has to go, and with b, c
        jobs.ask(name, "", lambda name=name: done.append(name))
        assert jobs.wait(60)
    assert done == ["a", "b", "c", "d", "b"]


def test_what_runs_is_not_waited_for() -> None:
    jobs, go = Jobs(), threading.Event()
    slow = jobs.ask("slow", "", go.wait)
    late = jobs.ask("late", "", lambda: 1)
    assert (jobs.wait(0.05), slow.is_done) == (False, False)
    jobs.end()
    go.set()
    assert jobs.wait(60)
    assert late.result == 1  # it was asked for before the end
