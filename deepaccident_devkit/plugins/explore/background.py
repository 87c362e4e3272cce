"""Slow work beside the pages: one piece after another in a thread of its own; what it gives stays."""

from __future__ import annotations

import itertools
import logging
import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any, Final, Literal

from deepaccident_devkit.errors import DeepAccidentError

logger = logging.getLogger(__name__)

State = Literal["waiting", "running", "ready", "failed"]
_DONE: Final = ("ready", "failed")
# Jobs that are kept: of more, the done one that was not asked for the longest goes, so that memory stays flat.
MOST_JOBS: Final = 200


class Job:
    """A piece of work.

    Attributes:
        name: what it is known by.
        title: what it does, for readers: `lead times`.
        state: whether it is done.
        result: what it gave; None until it is ready.
        error: why it failed, for readers; empty if it did not.
        asked: when it was asked for the last time, by a number that grows.
    """

    def __init__(self, name: str, title: str, work: Callable[[], Any]) -> None:
        self.name, self.title, self._work = name, title, work
        self.state: State = "waiting"
        self.result: Any = None
        self.error = ""
        self.asked = 0

    @property
    def is_done(self) -> bool:
        """Whether it is ready, or has failed."""
        return self.state in _DONE

    def run(self) -> None:
        """Do the work; nothing is raised, so that the work after it is done too."""
        self.state = "running"
        try:
            self.result = self._work()
        except Exception as error:
            logger.debug("%s failed", self.name, exc_info=True)
            known = isinstance(error, DeepAccidentError | OSError)
            self.error = str(error) if known else f"{type(error).__name__}: {error}"
            self.state = "failed"
        else:
            self.state = "ready"


class Jobs:
    """All work that was asked for, each piece once, as long as its result is kept."""

    def __init__(self) -> None:
        self._jobs: dict[str, Job] = {}
        self._queue: SimpleQueue[Job | None] = SimpleQueue()
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._asked = itertools.count()

    def ask(self, name: str, title: str, work: Callable[[], Any]) -> Job:
        """The job of a name; if there is none yet, it is begun after those that were asked for before."""
        with self._changed:
            if name not in self._jobs:
                self._make_room()
                self._jobs[name] = Job(name, title, work)
                self._queue.put(self._jobs[name])
                if self._thread is None:
                    self._thread = threading.Thread(
                        target=self._run, name="explore-background", daemon=True
                    )
                    self._thread.start()
            self._jobs[name].asked = next(self._asked)
            return self._jobs[name]

    def all(self) -> list[Job]:
        """All jobs, in the order in which they were asked for."""
        with self._changed:
            return list(self._jobs.values())

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until all that was asked for is done; whether it is."""
        with self._changed:
            return self._changed.wait_for(
                lambda: all(job.is_done for job in self._jobs.values()), timeout
            )

    def end(self) -> None:
        """Begin no more. What runs is not waited for: its thread ends with the process."""
        self._queue.put(None)

    def _make_room(self) -> None:
        done = [job for job in self._jobs.values() if job.is_done]
        if done and len(self._jobs) >= MOST_JOBS:
            del self._jobs[min(done, key=lambda job: job.asked).name]

    def _run(self) -> None:
        for job in iter(self._queue.get, None):
            job.run()
            with self._changed:
                self._changed.notify_all()
