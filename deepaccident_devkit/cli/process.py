"""A verb's process: signals end it and its workers in two seconds; output never makes it fail."""

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

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
_MESSAGE: Final = b"interrupted; no file is half-written, and the same command can be run again\n"
# Time for the verb to remove its temporary files before the process is ended.
_CLEANUP_S: Final = 1.5
# Time after which a signal is sent again if Python ignored its exception.
_RESEND_S: Final = 0.02
# Signals within this time count as one: some programs send a signal to a process and to its group.
_SAME_SIGNAL_S: Final = 0.2
# Beginning of a progress bar's text: a return to the start of the line, or a move to another bar's
# line.
_BAR_START: Final = re.compile(r"\r|\n*(?:\x1b\[A)+\Z")


class _Interrupted(BaseException):
    """Raised in the main thread by a signal.

    It is not a KeyboardInterrupt, so click and most code let it pass.
    """


class _Signals:
    """Handling of signals while a verb runs."""

    def __init__(self) -> None:
        self.first: int | None = None
        self._since = 0.0
        self._verb_ended = False
        self._raising_again = False
        self._previous_hook = sys.unraisablehook

    def install(self) -> None:
        """Handle both signals.

        A thread also watches them, since the handler waits while the main thread is in a library.
        """
        reading, writing = os.pipe()
        os.set_blocking(writing, False)
        signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
        threading.Thread(target=self._watch, args=(reading,), name="signals", daemon=True).start()
        for number in _SIGNALS:
            signal.signal(number, self._handle)
        sys.unraisablehook = self._raise_again
        # while Python ends, a signal would kill a verb that has done its work
        atexit.register(_ignore_signals)

    def verb_ended(self) -> None:
        """Raise no more exceptions: Python's own ending would print a traceback."""
        self._verb_ended = True

    def _handle(self, number: int, _frame: Any) -> None:
        if self._verb_ended or self._raising_again:
            return
        if self.first is None:
            self.first, self._since = number, time.monotonic()
            raise _Interrupted
        if time.monotonic() - self._since > _SAME_SIGNAL_S:
            _end_now(number)

    def _raise_again(self, ignored: sys.UnraisableHookArgs) -> None:
        """Send a signal again if its exception was lost, such as in a `__del__`."""
        if ignored.exc_type is not _Interrupted:
            self._previous_hook(ignored)
        elif self.first is not None and not self._verb_ended:
            number, self.first = self.first, None
            self._raising_again = True  # an exception before this returns is lost, too
            threading.Thread(
                target=self._send_again, args=(number,), name="signal again", daemon=True
            ).start()
            self._raising_again = False

    def _send_again(self, number: int) -> None:
        """Send a signal until the handler has raised for it."""
        while self.first is None and not self._verb_ended:
            time.sleep(_RESEND_S)
            os.kill(os.getpid(), number)

    def _watch(self, reading: int) -> None:
        number = 0
        while number not in _SIGNALS:  # a library may handle other signals
            number = os.read(reading, 1)[0]
        time.sleep(_CLEANUP_S)
        _end_now(number)


def run_interruptibly(verb: Callable[[], None]) -> None:
    """Call `verb`, as the process's only work: signals stay handled afterwards."""
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
        _print_message()
        sys.exit(128 + signals.first)


def _ignore_signals() -> None:
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _end_now(number: int) -> NoReturn:
    try:
        _kill_children()
        _print_message()
    finally:
        os._exit(128 + number)


def _kill_children() -> None:
    """End the workers.

    The module is looked up in `sys.modules`, since an import waits while another thread imports.
    """
    children = getattr(sys.modules.get("multiprocessing.process"), "active_children", list)
    for child in children():
        child.kill()


def _print_message() -> None:
    with suppress(OSError):  # there may be no reader
        os.write(2, _MESSAGE)  # not sys.stderr, which an interrupted print may hold


class Stream:
    """Shows text on another stream, and never fails: text that cannot be written is lost and noted.

    Control characters are shown as JSON escapes, so that JSON stays the same document; a letter
    that the encoding lacks becomes a question mark.
    """

    buffer = None  # otherwise click would write into it if the encoding is ASCII

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.fault: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Show a text, as far as the stream can."""
        match = _BAR_START.match(text)
        start = "" if match is None else match[0]
        visible_text = start + escaped(text[len(start) :])
        encoding = self._stream.encoding or "utf-8"
        self._try(self._stream.write, visible_text.encode(encoding, "replace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        """Write buffered text."""
        self._try(self._stream.flush)

    def _try(self, output: Callable[..., object], *text: str) -> None:
        try:
            output(*text)
        except OSError as error:
            self.fault = self.fault or error
            with suppress(OSError):  # buffered and later text goes to the null device
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


@contextmanager
def lasting_streams() -> Iterator[None]:
    """Let a verb end its work even if its output fails, and report failures of standard output.

    A pipe with a reader that went away gives exit status 141, as for programs ended by the signal
    SIGPIPE; any other fault one line and exit status 2; a failed verb keeps its own. Streams are
    not restored: the verb is the process's only work.
    """
    streams = (sys.stdin, sys.stdout, sys.stderr)
    # a closed stream is replaced by the null device, so that no other file gets its number
    sys.stdin, out, err = (
        stream or Path(os.devnull).open("r+", encoding="utf-8")  # noqa: SIM115
        for stream in streams
    )
    output = Stream(out)
    sys.stdout, sys.stderr = cast("TextIO", output), cast("TextIO", Stream(err))
    try:
        yield
    except SystemExit as ended:
        if ended.code:
            raise
    if isinstance(output.fault, BrokenPipeError):
        sys.exit(141)
    if output.fault is not None:
        fault = (
            f"cannot be written ({output.fault.strerror}); files that the command wrote are whole"
        )
        click.echo(f"error: standard output: {fault}", err=True)
        sys.exit(2)
