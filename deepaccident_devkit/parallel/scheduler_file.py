"""The file that a dask scheduler writes its address into. Dask itself would wait for it for ever, and read anything."""

import errno
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Final

import msgspec

from deepaccident_devkit.support.json_text import parsed_record
from deepaccident_devkit.support.reading import read_bytes

_SECONDS: Final = 10.0


class _Scheduler(msgspec.Struct):
    """What is needed of the file."""

    address: Annotated[str, msgspec.Meta(min_length=1, max_length=300)]


def address_in(file: Path) -> str:
    """The address; waits for a scheduler which has just begun and may not have written it yet.

    Raises:
        OSError: there is no such file, also after some seconds, or it cannot be read.
        ValueError: it holds something else.
    """
    end, content = time.monotonic() + _SECONDS, b""
    while not content:
        with suppress(FileNotFoundError):
            content = read_bytes(file, "spec")
        if not content and time.monotonic() > end:
            raise FileNotFoundError(errno.ENOENT, "there is no such file, or it is empty")
        time.sleep(0 if content else 0.1)
    return parsed_record(content, _Scheduler).address
