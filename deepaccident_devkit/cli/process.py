"""The process of a subcommand: signals end it within two seconds; failing output does not."""

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
from typing import Any, NoReturn, TextIO, cast

import click

from deepaccident_devkit.errors import escaped

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_MESSAGE = b"interrupted; no file is half-written, and the same command can be run again\n"
# Time in which a subcommand may remove its temporary files before the process is ended.
_CLEANUP_S = 1.5
# Time after which a signal is sent again if Python ignored its exception.
_RESEND_S = 0.02
# Signals within this time count as one, because some programs signal a process and its group.
_SAME_SIGNAL_S = 0.2
# Start of a progress bar's text: a return to the start of the line, or a move to the line of
# another bar.
_BAR_START = re.compile(r"\r|\n*(?:\x1b\[A)+\Z")


class _Interrupted(BaseException):
    """An exception that a signal raises in the main thread.

    It is not a KeyboardInterrupt, so that click and most code let it pass.
    """


class _Signals:
    """Handling of signals while a subcommand runs."""

    def __init__(self) -> None:
        self.first: int | None = None
        self._first_time = 0.0
        self._verb_ended = False
        self._raising_again = False
        self._previous_hook = sys.unraisablehook

    def install(self) -> None:
        """Start to handle both signals.

        A thread also watches them, because the handler has to wait while the main thread is in a
        library.
        """
        reading, writing = os.pipe()
        os.set_blocking(writing, False)
        signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
        threading.Thread(target=self._watch, args=(reading,), name="signals", daemon=True).start()
        for number in _SIGNALS:
            signal.signal(number, self._handle)
        sys.unraisablehook = self._raise_again
        # while Python shuts down, a signal would kill a subcommand that has finished its work
        atexit.register(_ignore_signals)

    def verb_ended(self) -> None:
        """Stop raising exceptions, because Python would print a traceback when it shuts down."""
        self._verb_ended = True

    def _handle(self, number: int, _frame: Any) -> None:
        if self._verb_ended or self._raising_again:
            return
        if self.first is None:
            self.first = number
            self._first_time = time.monotonic()
            raise _Interrupted
        if time.monotonic() - self._first_time > _SAME_SIGNAL_S:
            _end_now(number)

    def _raise_again(self, ignored: sys.UnraisableHookArgs) -> None:
        """Send a signal again if its exception was lost, for example in a `__del__`."""
        if ignored.exc_type is not _Interrupted:
            self._previous_hook(ignored)
        elif self.first is not None and not self._verb_ended:
            number = self.first
            self.first = None
            self._raising_again = True  # an exception that comes before this returns is lost, too
            threading.Thread(
                target=self._send_again, args=(number,), name="signal again", daemon=True
            ).start()
            self._raising_again = False

    def _send_again(self, number: int) -> None:
        """Send a signal repeatedly until the handler has raised for it."""
        while self.first is None and not self._verb_ended:
            time.sleep(_RESEND_S)
            os.kill(os.getpid(), number)

    def _watch(self, reading: int) -> None:
        """Wait for a signal, and end the process some time later."""
        number = 0
        while number not in _SIGNALS:  # a library may handle other signals
            number = os.read(reading, 1)[0]
        time.sleep(_CLEANUP_S)
        _end_now(number)


def run_interruptibly(verb: Callable[[], None]) -> None:
    """Call `verb` as the process's only work; signals are still handled afterwards."""
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
        _end_children()
        sys.exit(128 + signals.first)


def _ignore_signals() -> None:
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _end_now(number: int) -> NoReturn:
    try:
        _end_children()
    finally:
        os._exit(128 + number)


def _end_children() -> None:
    """End the workers, and print the message.

    The module is looked up in `sys.modules`, because an import would wait for imports in other
    threads.
    """
    module = sys.modules.get("multiprocessing.process")
    list_children = getattr(module, "active_children", list)
    for child in list_children():
        child.kill()
    with suppress(OSError):  # nothing may be reading the output
        os.write(2, _MESSAGE)  # not sys.stderr, whose lock an interrupted print may hold


class Stream:
    """A stream that writes text to another one and never fails; text that it cannot write is lost.

    The error is stored instead. Control characters are written as JSON escapes, so that JSON
    documents keep their meaning. Letters that the encoding lacks become question marks.
    """

    buffer = None  # click would write to it if the encoding is ASCII

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.fault: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text, as far as the stream can."""
        match = _BAR_START.match(text)
        start = ""
        if match is not None:
            start = match[0]
        visible_text = start + escaped(text[len(start) :])
        encoding = self._stream.encoding or "utf-8"
        encoded_text = visible_text.encode(encoding, "replace")
        self._try(self._stream.write, encoded_text.decode(encoding))
        return len(text)

    def flush(self) -> None:
        """Flush the buffered text."""
        self._try(self._stream.flush)

    def _try(self, output: Callable[..., object], *text: str) -> None:
        try:
            output(*text)
        except OSError as error:
            self.fault = self.fault or error
            with suppress(OSError):  # buffered text and all later text go to the null device
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


@contextmanager
def lasting_streams() -> Iterator[None]:
    """Let a subcommand finish even if its output fails, then report how it failed.

    If the reader of a pipe has gone away, the exit status is 141, as for programs that SIGPIPE
    ends. Any other error prints one line and gives exit status 2; a subcommand that failed keeps
    its exit status. Streams are not restored, because the process has no other work.
    """
    streams = (sys.stdin, sys.stdout, sys.stderr)
    # the null device replaces a closed stream, so that no other file gets its number
    sys.stdin, out, err = (
        stream or Path(os.devnull).open("r+", encoding="utf-8")  # noqa: SIM115
        for stream in streams
    )
    output = Stream(out)
    sys.stdout = cast("TextIO", output)
    sys.stderr = cast("TextIO", Stream(err))
    try:
        yield
    except SystemExit as ended:
        if ended.code:
            raise
    if isinstance(output.fault, BrokenPipeError):
        sys.exit(141)
    if output.fault is not None:
        fault = (
            f"cannot be written ({output.fault.strerror}); the files that the command wrote are "
            "complete"
        )
        click.echo(f"error: standard output: {fault}", err=True)
        sys.exit(2)
