"""Standard output and standard error, as verbs use them: for texts of strangers, and for readers that went away."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, TextIO, cast

import click

from deepaccident_devkit.errors import escaped

# how a text of a progress bar begins: at the start of the line, or it only moves up to another bar's line
_OF_BARS: Final = re.compile(r"\r|\n*(?:\x1b\[A)+\Z")


class _Stream:
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
        start = "" if (bar := _OF_BARS.match(text)) is None else bar[0]
        shown, encoding = start + escaped(text[len(start) :]), self._beneath.encoding or "utf-8"
        self._try(self._beneath.write, shown.encode(encoding, "replace").decode(encoding))
        return len(text)

    def flush(self) -> None:
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
    sys.stdout, sys.stderr = cast("TextIO", shown := _Stream(out)), cast("TextIO", _Stream(err))
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
