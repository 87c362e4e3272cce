"""Slow work in a background thread, one job after the other; results are kept."""

import itertools
import logging
import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any, Final, Literal

from deepaccident_devkit.errors import DeepAccidentError

logger = logging.getLogger(__name__)

State = Literal["waiting", "running", "ready", "failed"]
_DONE_STATES = ("ready", "failed")
# Largest number of jobs; above it, the least recently used finished job is removed, so that memory
# does not grow.
MAX_JOBS: Final = 200


class Job:
    """A piece of work in the background.

    Attributes:
        name: Name that identifies the job.
        title: Title for readers, such as `lead times`.
        state: State of the work.
        result: Result of the work; None until it is ready.
        error: Why the work failed, for readers; empty if it did not.
        last_request: Number of the last request for the job; numbers increase with time.
    """

    def __init__(self, name: str, title: str, work: Callable[[], Any]) -> None:
        self.name = name
        self.title = title
        self._work = work
        self.state: State = "waiting"
        self.result: Any = None
        self.error = ""
        self.last_request = 0

    @property
    def is_done(self) -> bool:
        """Whether the work is ready or has failed."""
        return self.state in _DONE_STATES

    def run(self) -> None:
        """Do the work; its errors are stored instead of raised, so that the next job still runs."""
        self.state = "running"
        try:
            self.result = self._work()
        except Exception as error:
            logger.debug("%s failed", self.name, exc_info=True)
            is_expected = isinstance(error, DeepAccidentError | OSError)
            self.error = str(error) if is_expected else f"{type(error).__name__}: {error}"
            self.state = "failed"
        else:
            self.state = "ready"


class Jobs:
    """All requested work; each piece is done only once as long as its result is kept."""

    def __init__(self) -> None:
        self._jobs: dict[str, Job] = {}
        self._queue: SimpleQueue[Job | None] = SimpleQueue()
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._requests = itertools.count()

    def ask(self, name: str, title: str, work: Callable[[], Any]) -> Job:
        """Return the job with a name; a new one starts after all jobs requested before it."""
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
            self._jobs[name].last_request = next(self._requests)
            return self._jobs[name]

    def all(self) -> list[Job]:
        """Return all jobs, in the order in which they were requested."""
        with self._changed:
            return list(self._jobs.values())

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until all requested jobs are done, and return whether they are."""
        with self._changed:
            return self._changed.wait_for(
                lambda: all(job.is_done for job in self._jobs.values()), timeout
            )

    def end(self) -> None:
        """Start no more jobs. A running job is not awaited: its thread ends with the process."""
        self._queue.put(None)

    def _make_room(self) -> None:
        finished = [job for job in self._jobs.values() if job.is_done]
        if finished and len(self._jobs) >= MAX_JOBS:
            oldest = min(finished, key=lambda job: job.last_request)
            del self._jobs[oldest.name]

    def _run(self) -> None:
        for job in iter(self._queue.get, None):
            job.run()
            with self._changed:
                self._changed.notify_all()
