"""Skip tests that need a plug-in that this installation lacks; all tests of the core run.

tests/test_plugins.py has pytest load this module. A test needs a plug-in if its own lines import
the plug-in, or if an error of the core names it. If a line of the package imports the plug-in, the
test fails, because the package must not need it.
"""

import os
import re
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import deepaccident_devkit
from deepaccident_devkit.errors import MissingPluginError

PACKAGE = str(Path(deepaccident_devkit.__file__).parent)
MISSING_PLUGINS = os.environ["DEEPACCIDENT_WITHOUT"].replace(",", "|")
MISSING_IMPORT = re.compile(
    rf"No module named 'deepaccident_devkit\.plugins\.({MISSING_PLUGINS})\b|"
    rf"cannot import name '({MISSING_PLUGINS})' from 'deepaccident_devkit\.plugins'"
)


def is_needed_by_test(error: BaseException | None) -> bool:
    """Return whether the test itself asked for the missing plug-in."""
    while error is not None:
        if isinstance(error, MissingPluginError):
            return True
        frames = traceback.extract_tb(error.__traceback__)
        if isinstance(error, ImportError) and MISSING_IMPORT.search(str(error)):
            return not any(frame.filename.startswith(PACKAGE) for frame in frames)
        error = error.__cause__
    return False


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[Any]:
    report: Any = yield
    call = getattr(report, "call", None)
    if report.failed and call is not None and is_needed_by_test(call.excinfo.value):
        report.outcome = "skipped"
        report.longrepr = (str(collector.path), 0, "needs a plug-in")
        report.result = []
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[Any]:
    report: Any = yield
    if report.failed and call.excinfo is not None and is_needed_by_test(call.excinfo.value):
        report.outcome = "skipped"
        report.longrepr = (str(item.path), 0, "needs a plug-in")
    return report
