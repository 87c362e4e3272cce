"""Ctrl-C and SIGTERM: a verb and its workers end within two seconds, with one line and exit status 130 or 143."""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, NoReturn

_ENDING: Final = (signal.SIGINT, signal.SIGTERM)
_LINE: Final = b"interrupted; no file is half-written, and the same command can be run again\n"
_TIDYING_SECONDS: Final = 1.5
"""Time for the verb to remove its temporary files; then the process ends as it is."""
_AGAIN_AFTER: Final = 0.02
"""Seconds after which a signal is sent once more whose exception Python ignored."""
_SAME_SIGNAL: Final = 0.2
"""Seconds: some programs send a signal to a process and then to its group."""


class _Interrupted(BaseException):
    """Raised in the main thread by a signal; click and most code let it pass, as it is not a KeyboardInterrupt."""


class _Signals:
    """What signals do while a verb runs."""

    def __init__(self) -> None:
        self.first: int | None = None
        self._since = 0.0
        self._verb_ended = False
        self._told_before = sys.unraisablehook

    def install(self) -> None:
        """Take over both signals. A thread watches too: the handler waits while the main thread is in a library."""
        reading, writing = os.pipe()
        os.set_blocking(writing, False)
        signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
        threading.Thread(target=self._watch, args=(reading,), name="signals", daemon=True).start()
        for number in _ENDING:
            signal.signal(number, self._handle)
        sys.unraisablehook = self._raise_again
        atexit.register(_ignore)  # amid its own ending Python would let a signal kill a verb that has done its work

    def verb_ended(self) -> None:
        """Raise no more: Python's own ending would print a traceback."""
        self._verb_ended = True

    def _handle(self, number: int, _frame: Any) -> None:
        if self._verb_ended:
            return
        if self.first is None:
            self.first, self._since = number, time.monotonic()
            raise _Interrupted
        if time.monotonic() - self._since > _SAME_SIGNAL:
            _end_now(number)

    def _raise_again(self, ignored: sys.UnraisableHookArgs) -> None:
        """A signal came amid what Python calls in between, a `__del__` say, whose exceptions lead nowhere."""
        if ignored.exc_type is not _Interrupted:
            self._told_before(ignored)
        elif self.first is not None and not self._verb_ended:
            number, self.first = self.first, None
            threading.Timer(_AGAIN_AFTER, os.kill, (os.getpid(), number)).start()

    def _watch(self, reading: int) -> None:
        number = 0
        while number not in _ENDING:  # a library may handle others
            number = os.read(reading, 1)[0]
        time.sleep(_TIDYING_SECONDS)
        _end_now(number)


def run_interruptibly(verb: Callable[[], None]) -> None:
    """Call `verb`, as the process's only work: it stays in charge of the signals afterwards."""
    signals = _Signals()
    try:
        signals.install()
        verb()
    except BaseException:
        if signals.first is None:
            raise
    finally:
        signals.verb_ended()
    if signals.first is not None:
        _kill_children()
        _say_so()
        sys.exit(128 + signals.first)


def _ignore() -> None:
    for number in _ENDING:
        signal.signal(number, signal.SIG_IGN)


def _end_now(number: int) -> NoReturn:
    try:
        _kill_children()
        _say_so()
    finally:
        os._exit(128 + number)


def _kill_children() -> None:
    """End the workers. The module is only asked for: an import waits while another thread imports."""
    children = getattr(sys.modules.get("multiprocessing.process"), "active_children", list)
    for child in children():
        child.kill()


def _say_so() -> None:
    with suppress(OSError):  # nobody may read it
        os.write(2, _LINE)  # and not sys.stderr, which an interrupted print may hold
