"""The devkit's own exceptions: every error that a caller can fix derives from `DeepAccidentError`.

There are three kinds: `ArgumentError`, `FileError` and `UnavailableError`. Each error also derives
from the built-in class that a caller would expect (`ValueError`, `KeyError`, …). Its message is one
sentence that names the file, the line and the remedy. That is its only argument: an exception with
several does not survive pickling when it leaves a worker process.

Messages may quote text from untrusted files. So they have a maximum length, and control characters,
which could move a terminal's cursor, ring its bell or reverse the writing direction, are escaped.
"""

import re
from typing import ClassVar, Final

MAX_MESSAGE_LENGTH: Final = 2000
"""Maximum number of characters of a message."""
MAX_QUOTE_LENGTH: Final = 100
"""Maximum number of characters that a message quotes from a file."""
MAX_REASON_LENGTH: Final = 300
"""Maximum number of characters of a library's own error message, which may quote a file."""
# Control characters except newline and tab, bidirectional marks, and lone surrogates.
_INVISIBLE = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]"
)


def shortened(text: str, max_length: int = MAX_QUOTE_LENGTH) -> str:
    """Return text for a message, with its middle left out if it exceeds `max_length` characters."""
    if len(text) <= max_length:
        return text
    half = (max_length - 3) // 2
    return f"{text[:half]} … {text[-half:]}"


def escaped(text: str) -> str:
    r"""Return text for a terminal, with invisible characters escaped as in JSON: `\u001b`."""
    return _INVISIBLE.sub(_escape_character, text)


def _escape_character(match: re.Match[str]) -> str:
    code = ord(match[0])
    return f"\\u{code:04x}"


class DeepAccidentError(Exception):
    """Base of all errors that the devkit raises deliberately."""

    # Whether the message is a list, each line of which may have the maximum length of a message.
    _is_list: ClassVar[bool] = False

    def __init__(self, *message: object) -> None:
        """Store the message, shortened in the middle, with control characters escaped."""
        super().__init__(*map(self._sanitize, message))

    def _sanitize(self, message: object) -> str:
        """Escape control characters, and shorten the message (a list: each of its lines)."""
        lines = [str(message)]
        if self._is_list:
            lines = lines[0].split("\n")
        return "\n".join([shortened(escaped(line), MAX_MESSAGE_LENGTH) for line in lines])

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle only the message: dask cannot copy errors that are OSError and ValueError."""
        return type(self), self.args

    def __str__(self) -> str:
        """Return the message itself (`KeyError` would show its repr)."""
        if self.args:
            return str(self.args[0])
        return ""


class ArgumentError(DeepAccidentError):
    """An argument is invalid: change the call."""


class FileError(DeepAccidentError):
    """A file or folder cannot be read, used or written: repair it, or choose another."""


class UnavailableError(DeepAccidentError):
    """Something that the call needs is missing or does not run on this machine."""


class ReleaseError(FileError, ValueError):
    """Something in the release on disk does not follow the release's format."""


class DatarootError(ReleaseError, FileNotFoundError):
    """The dataroot does not exist, contains no release, or has unreadable archives (all listed)."""

    _is_list = True


class VersionError(ReleaseError):
    """The requested version is unknown or is not under this folder."""


class MissingFileError(ReleaseError, FileNotFoundError):
    """A file of the release is missing: an archive was not unpacked, or the mirror is partial."""


class LabelError(ReleaseError):
    """A label file cannot be read."""


class MetaError(ReleaseError):
    """A meta file cannot be read."""


class CalibError(ReleaseError):
    """A calibration file cannot be read, or is not a calibration."""


class SensorFileError(ReleaseError):
    """An image, a point cloud or a BEV camera array cannot be read."""


class SplitFileError(ReleaseError):
    """A split file cannot be read, or puts a scenario into two splits."""


class SourceError(ReleaseError):
    """A source's axes, ground or cameras differ from the devkit's conventions."""


class BrokenReleaseError(ReleaseError):
    """Indexing found broken scenarios; the message lists every one of them."""

    _is_list = True


class IndexStoreError(FileError, OSError):
    """The index cannot be written to its folder, or read from it."""


class LabelFilesError(FileError, OSError):
    """A folder of written motion labels is missing or damaged, or contains something else."""


class ExportError(FileError, OSError):
    """An export's folder cannot be created, written to or read, or contains something else."""


class OutputFolderError(FileError, OSError):
    """An output would lie outside its folder, or replace a device, a pipe or a folder."""


class ResultsError(FileError, ValueError):
    """A results file, or an evaluation's bundle, is damaged or unsuitable."""


class LookupFailedError(ArgumentError, KeyError):
    """A table, token, field or channel does not exist."""


class TokenError(LookupFailedError):
    """No row has this token."""


class TableError(LookupFailedError):
    """No table has this name."""


class FieldError(LookupFailedError):
    """The table has no such field."""


class MissingNameError(ArgumentError, AttributeError):
    """An object lacks an attribute that the nuScenes devkit's counterpart has."""


class KeywordError(ArgumentError, TypeError):
    """A function lacks an argument that the nuScenes devkit's counterpart has."""


class ChoiceError(ArgumentError, ValueError):
    """An argument is not one of the values it can take (a frame, a channel, a layout, …)."""


class GeometryError(ArgumentError, ValueError):
    """An array is not a valid transform, box or point set."""


class ConfigError(ArgumentError, ValueError):
    """A configuration is invalid or contradicts itself."""


class EvaluationError(ArgumentError, ValueError):
    """Predictions do not fit together: a sample occurs twice or is missing, or settings differ."""


class NotAvailableError(UnavailableError, LookupError):
    """The call needs something that this release does not have (labels, an agent, split files)."""


class WorkerError(UnavailableError, RuntimeError):
    """A worker was killed or cannot do the work, or no scheduler answers."""


class SomeFailedError(UnavailableError, RuntimeError):
    """Some items of a batch failed and all others are done; the message lists every failure."""

    _is_list = True


class MissingExtraError(UnavailableError, ImportError):
    """An optional dependency that the call needs is not installed."""


class MissingPluginError(UnavailableError, ImportError):
    """A plug-in that the call needs is not installed."""


class ImageSizeWarning(UserWarning):
    """The images of a camera are not of the size that its calib files are made for."""
