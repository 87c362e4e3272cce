"""A pytest plugin: a test that itself needs a room which this installation lacks is skipped, and one of the core runs.

tests/test_rooms.py has pytest load it. A test needs a room that its own lines import, or that the core names to it; an
import by a line of the package, which must not need the room, fails the test.
"""

import os
import re
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import deepaccident_devkit
from deepaccident_devkit.errors import MissingRoomError

PACKAGE = str(Path(deepaccident_devkit.__file__).parent)
ROOMS = os.environ["DEEPACCIDENT_WITHOUT"].replace(",", "|")
IMPORTED = re.compile(
    rf"No module named 'deepaccident_devkit\.({ROOMS})\b|cannot import name '({ROOMS})' from 'deepaccident_devkit'"
)


def needed_by_the_test(error: BaseException | None) -> bool:
    """Whether an error is that the room which is missing was asked for by the test."""
    while error is not None:
        if isinstance(error, MissingRoomError):
            return True
        frames = traceback.extract_tb(error.__traceback__)
        if isinstance(error, ImportError) and IMPORTED.search(str(error)):
            return not any(frame.filename.startswith(PACKAGE) for frame in frames)
        error = error.__cause__
    return False


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[Any]:
    report: Any = yield
    call = getattr(report, "call", None)
    if report.failed and call is not None and needed_by_the_test(call.excinfo.value):
        report.outcome, report.longrepr, report.result = "skipped", (str(collector.path), 0, "needs a room"), []
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[Any]:
    report: Any = yield
    if report.failed and call.excinfo is not None and needed_by_the_test(call.excinfo.value):
        report.outcome, report.longrepr = "skipped", (str(item.path), 0, "needs a room")
    return report
