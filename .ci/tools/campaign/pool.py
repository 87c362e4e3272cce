"""Cases spread over several workers; each worker's process has a thread here that feeds it."""

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
from campaign.mutations import GROUPS, fitting
from campaign.worker import SECONDS, Case, Outcome

WORKERS = 2
KINDS_MODULE = "campaign.kinds"
_CONNECT = "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT"
"""How long dask tries to reach a scheduler."""
_TOOLS = Path(__file__).parents[1]
_TOP = _TOOLS.parents[1]


def drawn(count: int, seed: int, kinds: Collection[str] = tuple(KINDS)) -> list[Case]:
    """So many cases of each kind: groups of mutations by turns, the mutation of a group by chance.

    A kind has a seed of its own, so that a new kind changes nothing of the others. Kinds that need
    a package which is not there are left out.
    """
    return [
        case
        for name in kinds
        if KINDS[name].can_be_read
        for case in _drawn_of(KINDS[name], count, seed)
    ]


def left_out(kinds: Collection[str] = tuple(KINDS)) -> dict[str, str]:
    """The kinds that `drawn` leaves out, and what they need."""
    return {name: KINDS[name].needs for name in kinds if not KINDS[name].can_be_read}


def _drawn_of(kind: Kind, count: int, seed: int) -> Iterator[Case]:
    rng = seeded(kind.name, seed)
    groups = [names for group in GROUPS if (names := fitting(kind.form, group))]
    for number in range(count):
        names = groups[number % len(groups)]
        yield Case(
            kind.name, names[int(rng.integers(len(names)))], number // len(groups) + 1000 * seed
        )


def run(
    cases: Iterable[Case],
    healthy: Path,
    *,
    seconds: float = SECONDS,
    workers: int = WORKERS,
    kinds: str = KINDS_MODULE,
    tell: Callable[[Outcome], object] = lambda _: None,
) -> list[Outcome]:
    """The outcomes of the cases, in their order.

    Args:
        cases: of kinds of files in the module `kinds`.
        healthy: the files that are changed; each worker makes a copy beside them.
        seconds: of the processor's time that a case may take.
        workers: how many processes.
        kinds: the module of the kinds of files.
        tell: is called with each outcome.
    """
    waiting: SimpleQueue[tuple[int, Case]] = SimpleQueue()
    for entry in enumerate(cases):
        waiting.put(entry)
    outcomes: dict[int, Outcome] = {}

    def feed(number: int) -> None:
        with _server(healthy, number, kinds) as (asked, answered):
            while True:
                try:
                    position, case = waiting.get_nowait()
                except Empty:
                    return
                asked.write(json.dumps([asdict(case), seconds]) + "\n")
                asked.flush()
                outcomes[position] = Outcome(**{**json.loads(answered.readline()), "case": case})
                tell(outcomes[position])

    threads = [threading.Thread(target=feed, args=(number,)) for number in range(workers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [outcomes[number] for number in sorted(outcomes)]


@contextmanager
def _server(healthy: Path, number: int, kinds: str) -> Iterator[tuple[IO[str], IO[str]]]:
    """A process that answers cases, with its input and its output."""
    home = healthy.with_name(f"{healthy.name} of worker {number}")
    command = [sys.executable, "-W", "ignore", worker.__file__, str(healthy), str(home), kinds]
    paths = os.pathsep.join(
        [str(_TOOLS), str(_TOP / "tests"), str(_TOP), os.environ.get("PYTHONPATH", "")]
    )
    environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", _CONNECT: "1s"}
    environment.pop("DEEPACCIDENT_LIMITS", None)
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment) as process:
        assert process.stdin
        assert process.stdout
        yield process.stdin, process.stdout
        process.stdin.close()
