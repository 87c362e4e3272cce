"""Slow work is done once and in order, and a failure does not keep the rest from being done."""

import threading
from unittest.mock import Mock

import pytest

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.plugins.explore import background
from deepaccident_devkit.plugins.explore.background import Jobs


def test_a_failure_is_reported_and_the_next_job_is_done() -> None:
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


def test_the_least_recently_used_results_are_evicted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(background, "MAX_JOBS", 3)
    jobs, finished = Jobs(), []
    for name in ("a", "b", "c", "a", "d", "a", "b"):  # d evicts b, and b evicts c
        jobs.ask(name, "", lambda name=name: finished.append(name))
        assert jobs.wait(60)
    assert finished == ["a", "b", "c", "d", "b"]


def test_a_running_job_is_not_waited_for() -> None:
    jobs, go_on = Jobs(), threading.Event()
    slow = jobs.ask("slow", "", go_on.wait)
    late = jobs.ask("late", "", lambda: 1)
    assert (jobs.wait(0.05), slow.is_done) == (False, False)
    jobs.end()
    go_on.set()
    assert jobs.wait(60)
    assert late.result == 1  # it was requested before the end
