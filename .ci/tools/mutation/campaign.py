"""The pytest plugin that runs all tests once, and then for each mutant the tests that reach it."""

import contextlib
import functools
import gc
import importlib
import json
import os
import resource
import signal
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest
from _pytest.runner import runtestprotocol

from mutation.mutants import Mutant, mutated
from mutation.planting import plant
from mutation.sample import PACKAGE, ROOT, fingerprint

TESTS = {
    "geometry": "unit/geometry property/test_geometry property/test_se3 "
    "property/test_handedness parity/test_poses",
    "motion/reference_arithmetic": "unit/motion property/test_postprocessing property/test_warps "
    "parity/test_accident parity/test_labels parity/test_postprocess parity/test_warps",
    "motion": "unit/motion property/test_motion_labels "
    "property/test_postprocessing property/test_warps "
    "parity/test_fiery parity/test_labels parity/test_postprocess "
    "parity/test_trajectories parity/test_visibility "
    "parity/test_warps",
    "evaluation/results": "unit/evaluation/results unit/plugins/baselines/test_predict_results",
    "evaluation/runs": "unit/evaluation/runs test_cli_evaluate unit/test_reprs",
    "evaluation/__init__": "unit/evaluation/runs",
    "evaluation": "unit/evaluation property/test_accident property/test_detection "
    "property/test_motion_metrics "
    "parity/test_accident parity/test_anticipation parity/test_attributes "
    "parity/test_detection parity/test_motion parity/test_planning parity/test_forecasting "
    "parity/test_trajectories unit/test_reprs",
    "v2x": "unit/v2x unit/plugins/baselines/test_outlook property/test_v2x "
    "parity/test_poses parity/test_visibility",
    "selection/splits": "unit/selection/test_splits",
}
"""Beginnings of the paths of each package's tests, which run beside its docstring examples."""
_MAX_TEST_S = 10.0
"""Longer tests take no part: they start processes, or repeat what shorter tests check."""
_MUTANT_BUDGET_S = 8.0
"""CPU time of a mutant's tests at most; on average they need much less."""
_WALL_S_PER_CPU_S = 10
"""A fork that takes longer is taken to hang."""
_MAX_MEMORY_BYTES = 6 << 30
_MAX_MESSAGE_CHARACTERS = 500
_SURVIVED, _KILLED, _NOT_PLANTED = 0, 1, 2


@dataclass
class _Test:
    """Durations of a test without its fixtures, and the functions that it reaches.

    Attributes:
        seconds: Wall time.
        cpu_seconds: CPU time.
        reached: File and first line of each function of the package.
    """

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    reached: list[list[Any]] = field(default_factory=list)


class Campaign:
    """Plugin that runs the tests of each mutant, and appends the outcome to a file.

    Attributes:
        mutants: Mutants to run.
        results: File of JSON lines.
    """

    def __init__(self, mutants: Sequence[Mutant], results: Path) -> None:
        self.mutants, self.results = mutants, results
        paths = {mutant.path for mutant in mutants}
        self._sources = {path: (PACKAGE / path).read_text(encoding="utf-8") for path in paths}
        self._tests: dict[str, _Test] = {}

    def run(self) -> int:
        """Run pytest with this plugin in this process; return its exit status."""
        areas = sorted({_area_of(mutant.path) for mutant in self.mutants})
        prefixes = [prefix for area in areas for prefix in _test_prefixes(area)]
        test_paths = {path for prefix in prefixes for path in ROOT.glob(f"{prefix}*")}
        # the package after its tests, as in pytest's own order
        arguments = map(str, sorted(test_paths, reverse=True))
        options = ["-q", "-m", "", "-p", "no:cacheprovider", "-p", "no:xdist"]
        return pytest.main([*options, *arguments], plugins=[self])

    @staticmethod
    def pytest_collection() -> None:
        """Turn off Hypothesis' shrinking before tests are imported: the first failure is enough."""
        from hypothesis import HealthCheck, Phase, settings

        parent = settings.get_profile("repeatable")
        phases, checks = (Phase.explicit, Phase.generate), list(HealthCheck)
        settings.register_profile(
            "mutation", parent=parent, phases=phases, suppress_health_check=checks
        )
        settings.load_profile("mutation")

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Learn which functions each test reaches, then run the tests of each mutant."""
        import cv2

        cv2.setNumThreads(1)  # its threads do not outlive a fork
        if session.testsfailed:
            raise session.Interrupted("not all tests could be collected")
        items = {item.nodeid: item for item in session.items}
        self._caches = _caches()
        self._learn(session.items)
        gc.collect()
        gc.freeze()  # memory that a fork does not touch stays shared
        trusted_tests: set[str] = set()
        for number, mutant in enumerate(self.mutants, start=1):
            began = time.monotonic()
            test_names = self._tests_of(mutant, items)
            outcome, message = self._run_in_fork([items[name] for name in test_names], mutant)
            if not test_names and outcome != "not planted":
                outcome = "not reached"
            killer = message.split(": ")[0]
            if killer in items and killer not in trusted_tests:
                if self._run_in_fork([items[killer]], None)[0] != "survived":
                    raise session.Interrupted(f"fails in a fork without a mutant: {message}")
            trusted_tests.add(killer)
            record = {
                "key": mutant.key,
                "outcome": outcome,
                "line": mutant.line,
                "change": mutant.change,
                "tests": len(test_names),
                "by": message,
                "seconds": round(time.monotonic() - began, 2),
            }
            with self.results.open("a", encoding="utf-8") as file:
                file.write(json.dumps(record, ensure_ascii=False) + "\n")
            line = (number, mutant.path, mutant.line, mutant.change, outcome, record["seconds"])
            print(*line, flush=True)
        return True

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        """Measure wall and CPU time of a test without its fixtures."""
        wall_start, cpu_start = time.monotonic(), time.process_time()
        try:
            yield
        finally:
            if item.nodeid in self._tests:
                test = self._tests[item.nodeid]
                test.seconds = time.monotonic() - wall_start
                test.cpu_seconds = time.process_time() - cpu_start

    def _learn(self, items: Sequence[pytest.Item]) -> None:
        """Run the tests that changed since they were measured, and one for each session fixture."""
        package = "".join(
            path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))
        )
        fingerprints = {
            item.path: fingerprint(package + item.path.read_text(encoding="utf-8"))
            for item in items
        }
        cache_path = self.results.with_suffix(".tests.json")
        records = json.loads(cache_path.read_text(encoding="utf-8")) if cache_path.exists() else {}
        for item in items:
            if records.get(item.nodeid, {}).get("fingerprint") != fingerprints[item.path]:
                records.pop(item.nodeid, None)
        pending = _tests_to_measure(items, records)
        for item, next_item in zip(pending, [*pending[1:], *pending[:1]], strict=True):
            self._measure(item, next_item)
            test = asdict(self._tests[item.nodeid])
            records[item.nodeid] = {**test, "fingerprint": fingerprints[item.path]}
        cache_path.write_text(json.dumps(records), encoding="utf-8")
        for item in items:
            values = dict(records[item.nodeid])
            del values["fingerprint"]
            self._tests[item.nodeid] = _Test(**values)
        print(f"{len(pending)} of {len(items)} tests were run to know what they reach", flush=True)

    def _measure(self, item: pytest.Item, next_item: pytest.Item) -> None:
        """Run a test, and note which functions of the package it reaches and how long it takes."""
        reached: set[CodeType] = set()
        self._tests[item.nodeid] = _Test()

        def trace(frame: FrameType, event: str, argument: object) -> None:
            reached.add(frame.f_code)

        self._clear_caches()
        sys.settrace(trace)
        try:
            reports = _run_test(item, next_item)
        finally:
            sys.settrace(None)
        if any(report.failed for report in reports):
            print("fails without a mutant, and takes no part:", item.nodeid, flush=True)
            return
        self._tests[item.nodeid].reached = [
            [code.co_filename[len(str(PACKAGE)) + 1 :], code.co_firstlineno]
            for code in reached
            if code.co_filename.startswith(str(PACKAGE))
        ]

    def _clear_caches(self) -> None:
        """Clear the package's caches, so that calls are computed again."""
        for cached_function in self._caches:
            cached_function.cache_clear()

    def _tests_of(self, mutant: Mutant, names: Iterable[str]) -> list[str]:
        """Return the names of the tests that may notice a mutant, the quickest first.

        They are tests of its area that reach its function or, for a mutant outside of functions,
        any file that imports its file; as many as fit into the budget of CPU time.
        """
        prefixes = _test_prefixes(_area_of(mutant.path))
        files = {mutant.path} if mutant.span else {mutant.path, *_importing_files(mutant.path)}
        first, last = mutant.span or (0, sys.maxsize)
        chosen_names, cpu_seconds = [], 0.0
        for name in sorted(names, key=lambda name: self._tests[name].seconds):
            test = self._tests[name]
            if cpu_seconds >= _MUTANT_BUDGET_S or test.seconds >= _MAX_TEST_S:
                break
            reached = any(file in files and first <= line <= last for file, line in test.reached)
            if reached and name.startswith(prefixes):
                chosen_names.append(name)
                cpu_seconds += test.cpu_seconds
        return chosen_names

    def _run_in_fork(self, items: Sequence[pytest.Item], mutant: Mutant | None) -> tuple[str, str]:
        """Plant a mutant in a fork and run tests there until one fails.

        Returns:
            The outcome, and the message of the test that failed.
        """
        cpu_limit = 30 + 4 * sum(self._tests[item.nodeid].cpu_seconds for item in items)
        reading, writing = os.pipe()
        child = os.fork()
        if not child:
            os.close(reading)
            os.setpgid(0, 0)
            status = _KILLED
            try:
                signal.signal(signal.SIGALRM, signal.SIG_DFL)
                signal.setitimer(signal.ITIMER_PROF, cpu_limit)
                signal.setitimer(signal.ITIMER_REAL, _WALL_S_PER_CPU_S * cpu_limit)
                resource.setrlimit(resource.RLIMIT_DATA, (_MAX_MEMORY_BYTES, _MAX_MEMORY_BYTES))
                status = self._run_child(items, mutant, writing)
            except BaseException as error:  # noqa: BLE001 - such as a module that no longer imports
                os.write(writing, repr(error)[:_MAX_MESSAGE_CHARACTERS].encode())
            finally:
                os._exit(status)
        os.close(writing)
        _, status = os.waitpid(child, 0)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # processes that its tests started
        os.set_blocking(reading, False)
        with os.fdopen(reading, "rb", buffering=0) as pipe:
            message = (pipe.read() or b"").decode()
        return _outcome(status), message

    def _run_child(self, items: Sequence[pytest.Item], mutant: Mutant | None, pipe: int) -> int:
        """Plant a mutant in this process and run tests; write the first failure into the pipe."""
        self._clear_caches()
        if mutant is not None:
            module = importlib.import_module(_module_name(mutant.path))
            if not plant(module, mutated(self._sources[mutant.path], mutant.number)):
                return _NOT_PLANTED
        if items:  # leave the last test's folders, except those of the first test here
            items[0].session._setupstate.teardown_exact(items[0])
        for item, next_item in zip(items, [*items[1:], *items[:1]], strict=True):
            failures = [report for report in _run_test(item, next_item) if report.failed]
            if failures:
                message = failures[0].longreprtext[-_MAX_MESSAGE_CHARACTERS:]
                os.write(pipe, f"{item.nodeid}: {message}".encode())
                return _KILLED
        return _SURVIVED


def _tests_to_measure(
    items: Sequence[pytest.Item], records: Mapping[str, Any]
) -> list[pytest.Item]:
    """Return the tests without a record, and others that make the remaining session fixtures."""
    chosen_items, fixtures = set(), set()
    durations = {name: record["seconds"] for name, record in records.items()}
    for item in sorted(items, key=lambda item: durations.get(item.nodeid, 0.0)):
        item_fixtures = _session_fixtures(item)
        if item.nodeid not in records or not item_fixtures <= fixtures:
            chosen_items.add(item)
            fixtures |= item_fixtures
    return [item for item in items if item in chosen_items]


def _outcome(status: int) -> str:
    """Return the outcome that the wait status of a fork means."""
    if os.WIFSIGNALED(status):
        is_late = os.WTERMSIG(status) in {signal.SIGPROF, signal.SIGALRM}
        if is_late:
            return "timed out"
        return "killed"
    outcomes = {_SURVIVED: "survived", _KILLED: "killed", _NOT_PLANTED: "not planted"}
    return outcomes[os.WEXITSTATUS(status)]


def _module_name(path: str) -> str:
    """Return the module name of a file below the package's folder."""
    parts = (PACKAGE.name, *Path(path).with_suffix("").parts)
    return ".".join(parts).removesuffix(".__init__")


def _caches() -> list[Any]:
    """Return the cached functions of the package."""
    cache_type = type(functools.lru_cache(len))
    cached_functions = [item for item in gc.get_objects() if isinstance(item, cache_type)]
    return [item for item in cached_functions if str(item.__module__).startswith(PACKAGE.name)]


def _run_test(item: pytest.Item, next_item: pytest.Item) -> list[pytest.TestReport]:
    """Run a test, which may have run before."""
    doctest_globals = dict(item.dtest.globs) if hasattr(item, "dtest") else {}
    reports = runtestprotocol(item, nextitem=next_item, log=False)
    if doctest_globals:
        item.dtest.globs.update(doctest_globals)
    return reports


def _session_fixtures(item: pytest.Item) -> set[str]:
    """Return the names of the session fixtures of a test."""
    definitions = getattr(getattr(item, "_fixtureinfo", None), "name2fixturedefs", {})
    return {name for name, defined in definitions.items() if defined[-1].scope == "session"}


def _test_prefixes(area: str) -> tuple[str, ...]:
    """Return the beginnings of the paths of an area's tests, relative to the repository."""
    prefixes = [f"tests/{path}" for path in TESTS[area].split()]
    return (*prefixes, f"{PACKAGE.name}/{area}")


def _area_of(path: str) -> str:
    """Return the key in `TESTS` for a file below the package's folder."""
    return next(area for area in TESTS if path.startswith(area))


@functools.cache
def _importing_files(path: str) -> tuple[str, ...]:
    """Return the files that import from a file."""
    name = _module_name(path)
    texts = ((file, file.read_text(encoding="utf-8")) for file in PACKAGE.rglob("*.py"))
    return tuple(
        str(file.relative_to(PACKAGE)) for file, text in texts if f"from {name} import" in text
    )
