"""The runs: a pytest plugin that runs all tests once and then, for each mutant in a fork, those
that may notice it.
"""

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
from collections.abc import Iterable, Iterator, Sequence
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
    "evaluation/results": "unit/evaluation/results",
    "evaluation/runs": "unit/evaluation/runs test_cli_evaluate",
    "evaluation/__init__": "unit/evaluation/runs",
    "evaluation": "unit/evaluation property/test_accident property/test_detection "
    "property/test_motion_metrics "
    "parity/test_accident parity/test_anticipation parity/test_attributes "
    "parity/test_detection parity/test_motion "
    "parity/test_trajectories",
    "v2x": "unit/v2x unit/plugins/baselines/test_outlook property/test_v2x "
    "parity/test_poses parity/test_visibility",
    "selection/splits": "unit/selection/test_splits",
}
"""The tests of each room, by how their paths begin; besides them its examples in docstrings."""
_LONGEST = 10.0
"""Seconds: longer tests do not take part; they start processes of their own, or repeat what shorter
ones say.
"""
_BUDGET = 8.0
"""Seconds of computing for a mutant; on average the tests of one take much less."""
_PATIENCE = 10
"""Seconds a second of computing: a fork that takes more hangs."""
_MEMORY = 6 << 30
_MOST = 500
"""Letters of what a test says that fails."""
_SURVIVED, _KILLED, _NOT_PLANTED = 0, 1, 2


@dataclass
class _Test:
    """What is known of a test: how long it takes and computes without its fixtures, and which
    functions it reaches.
    """

    seconds: float = 0.0
    computing: float = 0.0
    reached: list[list[Any]] = field(default_factory=list)


class Campaign:
    """Runs the tests for each of some mutants and appends what came of it to a file.

    Attributes:
        mutants: to be run.
        results: a file of JSON lines.
    """

    def __init__(self, mutants: Sequence[Mutant], results: Path) -> None:
        self.mutants, self.results = mutants, results
        self._sources = {
            each.path: (PACKAGE / each.path).read_text(encoding="utf-8") for each in mutants
        }
        self._tests: dict[str, _Test] = {}

    def run(self) -> int:
        """All of it, in this process."""
        rooms = sorted({_room_of(mutant.path) for mutant in self.mutants})
        places = [place for room in rooms for place in _places(room)]
        found = {path for place in places for path in ROOT.glob(f"{place}*")}
        paths = map(
            str, sorted(found, reverse=True)
        )  # the package after its tests: as pytest does by itself
        return pytest.main(
            ["-q", "-m", "", "-p", "no:cacheprovider", "-p", "no:xdist", *paths], plugins=[self]
        )

    @staticmethod
    def pytest_collection() -> None:
        """Before the tests' modules are imported: no shrinking, since the first failure is
        enough.
        """
        from hypothesis import HealthCheck, Phase, settings

        parent = settings.get_profile("repeatable")
        phases, checks = (Phase.explicit, Phase.generate), list(HealthCheck)
        settings.register_profile(
            "mutation", parent=parent, phases=phases, suppress_health_check=checks
        )
        settings.load_profile("mutation")

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        import cv2

        cv2.setNumThreads(1)  # its threads do not outlive a fork
        if session.testsfailed:
            raise session.Interrupted("not all tests could be collected")
        items = {item.nodeid: item for item in session.items}
        self._caches = _caches()
        self._learn(session.items)
        gc.collect()
        gc.freeze()  # what a fork does not touch stays shared
        trusted: set[str] = set()
        for number, mutant in enumerate(self.mutants, start=1):
            began = time.monotonic()
            chosen = self._chosen(mutant, items)
            outcome, by = self._in_fork([items[name] for name in chosen], mutant)
            killer = by.split(": ")[0]
            if (
                killer in items
                and killer not in trusted
                and self._in_fork([items[killer]], None)[0] != "survived"
            ):
                raise session.Interrupted(f"fails in a fork without a mutant: {by}")
            trusted.add(killer)
            record = {
                "key": mutant.key,
                "outcome": outcome if chosen or outcome == "not planted" else "not reached",
                "line": mutant.line,
                "change": mutant.change,
                "tests": len(chosen),
                "by": by,
                "seconds": round(time.monotonic() - began, 2),
            }
            with self.results.open("a", encoding="utf-8") as file:
                file.write(json.dumps(record, ensure_ascii=False) + "\n")
            print(
                number,
                mutant.path,
                mutant.line,
                mutant.change,
                record["outcome"],
                record["seconds"],
                flush=True,
            )
        return True

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        """Note how long a test takes without its fixtures, and how long it computes, whatever else
        the machine does.
        """
        began, before = time.monotonic(), time.process_time()
        try:
            yield
        finally:
            if item.nodeid in self._tests:
                self._tests[item.nodeid].seconds = time.monotonic() - began
                self._tests[item.nodeid].computing = time.process_time() - before

    def _learn(self, items: Sequence[pytest.Item]) -> None:
        """Run the tests that are not known as they are now, and of the others enough to have the
        session's fixtures.
        """
        package = "".join(
            path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))
        )
        marks = {
            item.path: fingerprint(package + item.path.read_text(encoding="utf-8"))
            for item in items
        }
        kept = self.results.with_suffix(".tests.json")
        known = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
        for item in items:
            if known.get(item.nodeid, {}).get("mark") != marks[item.path]:
                known.pop(item.nodeid, None)
        waiting, fixtures = [], set()
        for item in sorted(
            items, key=lambda item: known[item.nodeid]["seconds"] if item.nodeid in known else 0.0
        ):
            own = _session_fixtures(item)
            if item.nodeid not in known or not own <= fixtures:
                waiting.append(item)
                fixtures |= own
        waiting = [item for item in items if item in {*waiting}]
        for item, following in zip(waiting, [*waiting[1:], *waiting[:1]], strict=True):
            self._record(item, following)
            known[item.nodeid] = asdict(self._tests[item.nodeid]) | {"mark": marks[item.path]}
        kept.write_text(json.dumps(known), encoding="utf-8")
        for item in items:
            values = {name: value for name, value in known[item.nodeid].items() if name != "mark"}
            self._tests[item.nodeid] = _Test(**values)
        print(f"{len(waiting)} of {len(items)} tests were run to know what they reach", flush=True)

    def _record(self, item: pytest.Item, following: pytest.Item) -> None:
        """Run a test, and note which functions of the package it reaches and how long it takes."""
        reached: set[CodeType] = set()
        self._tests[item.nodeid] = _Test()

        def trace(frame: FrameType, event: str, argument: object) -> None:
            reached.add(frame.f_code)

        self._forget()
        sys.settrace(trace)
        try:
            reports = _ran(item, following)
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

    def _forget(self) -> None:
        """What the package remembers of calls, so that they are made anew."""
        for cached in self._caches:
            cached.cache_clear()

    def _chosen(self, mutant: Mutant, names: Iterable[str]) -> list[str]:
        """The tests of the mutant's room that reach its function or, outside of functions, whoever
        imports its file.

        The quickest first, as many as compute for `_BUDGET` seconds.
        """
        places = _places(_room_of(mutant.path))
        files = {mutant.path} if mutant.span else {mutant.path, *_importing(mutant.path)}
        first, last = mutant.span or (0, sys.maxsize)
        found, computing = [], 0.0
        for name in sorted(names, key=lambda name: self._tests[name].seconds):
            test = self._tests[name]
            reached = any(file in files and first <= line <= last for file, line in test.reached)
            if (
                reached
                and name.startswith(places)
                and computing < _BUDGET
                and test.seconds < _LONGEST
            ):
                found.append(name)
                computing += test.computing
        return found

    def _in_fork(self, items: Sequence[pytest.Item], mutant: Mutant | None) -> tuple[str, str]:
        """How a fork ends that plants a mutant and runs tests until one fails, and which one
        does.
        """
        limit = 30 + 4 * sum(self._tests[item.nodeid].computing for item in items)
        reading, writing = os.pipe()
        child = os.fork()
        if not child:
            os.close(reading)
            os.setpgid(0, 0)
            status = _KILLED
            try:
                signal.signal(signal.SIGALRM, signal.SIG_DFL)
                signal.setitimer(signal.ITIMER_PROF, limit)
                signal.setitimer(signal.ITIMER_REAL, _PATIENCE * limit)
                resource.setrlimit(resource.RLIMIT_DATA, (_MEMORY, _MEMORY))
                status = self._child(items, mutant, writing)
            except BaseException as error:  # noqa: BLE001 - such as of a module that cannot be imported any more
                os.write(writing, repr(error)[:_MOST].encode())
            finally:
                os._exit(status)
        os.close(writing)
        _, status = os.waitpid(child, 0)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # what its tests started
        os.set_blocking(reading, False)
        with os.fdopen(reading, "rb", buffering=0) as told:
            by = (told.read() or b"").decode()
        if os.WIFSIGNALED(status):
            late = os.WTERMSIG(status) in {signal.SIGPROF, signal.SIGALRM}
            return "timed out" if late else "killed", by
        return {_SURVIVED: "survived", _KILLED: "killed", _NOT_PLANTED: "not planted"}[
            os.WEXITSTATUS(status)
        ], by

    def _child(self, items: Sequence[pytest.Item], mutant: Mutant | None, told: int) -> int:
        self._forget()
        if mutant is not None:
            module = importlib.import_module(_module_name(mutant.path))
            if not plant(module, mutated(self._sources[mutant.path], mutant.number)):
                return _NOT_PLANTED
        if items:  # leave the last test's folders, but for those of the first one here
            items[0].session._setupstate.teardown_exact(items[0])
        for item, following in zip(items, [*items[1:], *items[:1]], strict=True):
            failed = [report for report in _ran(item, following) if report.failed]
            if failed:
                os.write(told, f"{item.nodeid}: {failed[0].longreprtext[-_MOST:]}".encode())
                return _KILLED
        return _SURVIVED


def _module_name(path: str) -> str:
    return ".".join((PACKAGE.name, *Path(path).with_suffix("").parts)).removesuffix(".__init__")


def _caches() -> list[Any]:
    """All that the package remembers of calls."""
    kind = type(functools.lru_cache(len))
    return [
        each
        for each in gc.get_objects()
        if isinstance(each, kind) and str(each.__module__).startswith(PACKAGE.name)
    ]


def _ran(item: pytest.Item, following: pytest.Item) -> list[pytest.TestReport]:
    """Run a test, which may have run before."""
    names = dict(item.dtest.globs) if hasattr(item, "dtest") else {}
    reports = runtestprotocol(item, nextitem=following, log=False)
    if names:
        item.dtest.globs.update(names)
    return reports


def _session_fixtures(item: pytest.Item) -> set[str]:
    definitions = getattr(getattr(item, "_fixtureinfo", None), "name2fixturedefs", {})
    return {name for name, defined in definitions.items() if defined[-1].scope == "session"}


def _places(room: str) -> tuple[str, ...]:
    """How the paths of a room's tests begin, below the repository's folder."""
    return (*(f"tests/{place}" for place in TESTS[room].split()), f"{PACKAGE.name}/{room}")


def _room_of(path: str) -> str:
    """The room in `TESTS` of a file below the package's folder."""
    return next(room for room in TESTS if path.startswith(room))


@functools.cache
def _importing(path: str) -> tuple[str, ...]:
    """The files that import from a file."""
    name = _module_name(path)
    texts = ((file, file.read_text(encoding="utf-8")) for file in PACKAGE.rglob("*.py"))
    return tuple(
        str(file.relative_to(PACKAGE)) for file, text in texts if f"from {name} import" in text
    )
