"""Cases spread over several workers; each worker's process is fed by a thread of this process."""

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO

from fault_injection.mutations import seeded

from campaign import worker
from campaign.kind import Kind
from campaign.kinds import KINDS
from campaign.mutations import GROUPS, mutation_names
from campaign.worker import CASE_CPU_S, Case, Outcome

WORKERS = 2
KINDS_MODULE = "campaign.kinds"
_CONNECT_TIMEOUT = "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT"
"""Variable that limits how long dask tries to reach a scheduler."""
_TOOLS = Path(__file__).parents[1]
_TOP = _TOOLS.parents[1]


def draw_cases(count: int, seed: int, kinds: Collection[str] = tuple(KINDS)) -> list[Case]:
    """Draw cases of each kind: the groups of mutations take turns, the mutation is random.

    Each kind has a seed of its own, so that a new kind changes no cases of the others. Kinds that
    need a package which is not installed are left out.

    Args:
        count: Number of cases of each kind.
        seed: Seed of the drawing.
        kinds: Names of the kinds.
    """
    readable_kinds = [KINDS[name] for name in kinds if KINDS[name].can_be_read]
    return [case for kind in readable_kinds for case in _draw_cases_of_kind(kind, count, seed)]


def find_missing_packages(kinds: Collection[str] = tuple(KINDS)) -> dict[str, str]:
    """Return the package that is not installed, for each kind that `draw_cases` leaves out."""
    unreadable_kinds = [KINDS[name] for name in kinds if not KINDS[name].can_be_read]
    return {kind.name: kind.needs for kind in unreadable_kinds}


def _draw_cases_of_kind(kind: Kind, count: int, seed: int) -> Iterator[Case]:
    rng = seeded(kind.name, seed)
    names_by_group = [mutation_names(kind.form, group) for group in GROUPS]
    groups = [names for names in names_by_group if names]
    for number in range(count):
        names = groups[number % len(groups)]
        mutation = names[rng.integers(len(names))]
        yield Case(kind.name, mutation, number // len(groups) + 1000 * seed)


def run(
    cases: Iterable[Case],
    healthy: Path,
    *,
    seconds: float = CASE_CPU_S,
    workers: int = WORKERS,
    kinds: str = KINDS_MODULE,
    report: Callable[[Outcome], object] = lambda _: None,
) -> list[Outcome]:
    """Run cases and return their outcomes, in the order of the cases.

    Args:
        cases: Cases of kinds in the module `kinds`.
        healthy: Folder of the files that are changed; each worker makes a copy beside it.
        seconds: CPU time that a case may take.
        workers: Number of processes.
        kinds: Name of the module of the kinds of files.
        report: Function that is called with each outcome.
    """
    waiting: SimpleQueue[tuple[int, Case]] = SimpleQueue()
    for entry in enumerate(cases):
        waiting.put(entry)
    outcomes: dict[int, Outcome] = {}

    def feed_worker(number: int) -> None:
        with _start_worker(healthy, number, kinds) as (requests, answers):
            while True:
                try:
                    position, case = waiting.get_nowait()
                except Empty:
                    return
                requests.write(json.dumps([asdict(case), seconds]) + "\n")
                requests.flush()
                answer = json.loads(answers.readline())
                outcomes[position] = Outcome(**{**answer, "case": case})
                report(outcomes[position])

    threads = [threading.Thread(target=feed_worker, args=(number,)) for number in range(workers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [outcomes[position] for position in sorted(outcomes)]


@contextmanager
def _start_worker(healthy: Path, number: int, kinds: str) -> Iterator[tuple[IO[str], IO[str]]]:
    """Start a process that answers cases; yield its input and its output."""
    home = healthy.with_name(f"{healthy.name} of worker {number}")
    command = [sys.executable, "-W", "ignore", worker.__file__, str(healthy), str(home), kinds]
    paths = [str(_TOOLS), str(_TOP / "tests"), str(_TOP), os.environ.get("PYTHONPATH", "")]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(paths),
        "OMP_NUM_THREADS": "1",
        _CONNECT_TIMEOUT: "1s",
    }
    environment.pop("DEEPACCIDENT_LIMITS", None)
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment) as process:
        assert process.stdin
        assert process.stdout
        yield process.stdin, process.stdout
        process.stdin.close()
