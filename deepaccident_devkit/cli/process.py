"""A verb's process: Ctrl-C and SIGTERM end it and its workers within two seconds; output streams never fail it."""

from __future__ import annotations

import atexit
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, NoReturn, TextIO, cast

import click

from deepaccident_devkit.errors import escaped

_ENDING: Final = (signal.SIGINT, signal.SIGTERM)
_LINE: Final = b"interrupted; no file is half-written, and the same command can be run again\n"
# Time for the verb to remove its temporary files; then the process ends as it is.
_TIDYING_SECONDS: Final = 1.5
# Seconds after which a signal whose exception Python ignored is sent again.
_AGAIN_AFTER: Final = 0.02
# Seconds: some programs send a signal to a process and then to its group.
_SAME_SIGNAL: Final = 0.2
# how a text of a progress bar begins: at the start of the line, or it only moves up to another bar's line
_OF_BARS: Final = re.compile(r"\r|\n*(?:\x1b\[A)+\Z")


class _Interrupted(BaseException):
    """Raised in the main thread by a signal; click and most code let it pass, as it is not a KeyboardInterrupt."""


class _Signals:
    """What signals do while a verb runs."""

    def __init__(self) -> None:
        self.first: int | None = None
        self._since = 0.0
        self._verb_ended = False
        self._raising_again = False
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
        atexit.register(
            _ignore
        )  # amid its own ending Python would let a signal kill a verb that has done its work

    def verb_ended(self) -> None:
        """Raise no more: Python's own ending would print a traceback."""
        self._verb_ended = True

    def _handle(self, number: int, _frame: Any) -> None:
        if self._verb_ended or self._raising_again:
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
            self._raising_again = True  # what is raised before this returns is lost, too
            threading.Thread(
                target=self._send_again, args=(number,), name="signal again", daemon=True
            ).start()
            self._raising_again = False

    def _send_again(self, number: int) -> None:
        """Send a signal until the handler has raised for it."""
        while self.first is None and not self._verb_ended:
            time.sleep(_AGAIN_AFTER)
            os.kill(os.getpid(), number)

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


class Stream:
    """Shows what the stream beneath it can show, and never fails: what it cannot write is lost, and noted.

    Control characters are shown as JSON escapes, so that JSON stays the same document; a letter that the encoding
    lacks becomes a question mark.
    """

    buffer = None  # there is no way around: click would write into it if the encoding is ASCII

    def __init__(self, beneath: TextIO) -> None:
        self._beneath = beneath
        self.fault: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._beneath, name)

    def write(self, text: str) -> int:
        """Show a text, as far as the stream can."""
        start = "" if (bar := _OF_BARS.match(text)) is None else bar[0]
        shown, encoding = start + escaped(text[len(start) :]), self._beneath.encoding or "utf-8"
        self._try(self._beneath.write, shown.encode(encoding, "replace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        """Pass on what was written."""
        self._try(self._beneath.flush)

    def _try(self, output: Callable[..., object], *text: str) -> None:
        try:
            output(*text)
        except OSError as error:
            self.fault = self.fault or error
            with suppress(OSError):  # what is buffered, and all that comes, is written into nothing
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._beneath.fileno())


@contextmanager
def lasting_streams() -> Iterator[None]:
    """Let a verb end its work whatever its output leads to, and tell at the end what became of standard output.

    A pipe whose reader went away gives exit status 141, as of programs that the signal SIGPIPE ends; any other fault
    one line and exit status 2; a verb that failed keeps its own. Nothing is put back: the verb is the process's only
    work.
    """
    given = (sys.stdin, sys.stdout, sys.stderr)
    # one that was closed leads into nothing, so that no file of ours takes its number
    sys.stdin, out, err = (each or Path(os.devnull).open("r+", encoding="utf-8") for each in given)  # noqa: SIM115
    sys.stdout, sys.stderr = cast("TextIO", shown := Stream(out)), cast("TextIO", Stream(err))
    try:
        yield
    except SystemExit as ended:
        if ended.code:
            raise
    if isinstance(shown.fault, BrokenPipeError):
        sys.exit(141)
    if shown.fault is not None:
        told = f"cannot be written ({shown.fault.strerror}); files that the command wrote are whole"
        click.echo(f"error: standard output: {told}", err=True)
        sys.exit(2)
