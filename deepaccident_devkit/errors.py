"""The devkit's own exceptions: every error that a caller can fix derives from `DeepAccidentError`.

There are three kinds: `ArgumentError`, `FileError` and `UnavailableError`. Each error is also the
built-in kind that a caller would expect (`ValueError`, `KeyError`, …) and is built from one
sentence with the file, the line and the remedy. It has one argument only: an exception with more
does not survive the pickling on its way out of a worker process.

Text from foreign files appears in these sentences too. So sentences have a maximum length, and
nothing in them moves a terminal's cursor, rings or turns the direction of letters.
"""

import re
from typing import ClassVar, Final

MOST_SAID: Final = 2000
"""Characters of a message."""
MOST_QUOTED: Final = 100
"""Characters of foreign text in a message."""
MOST_TOLD: Final = 300
"""Characters of a fault's description by a library: numbers, a remedy, perhaps foreign text."""
# Control characters except new line and tab, marks that turn the direction of letters, and lone
# surrogates.
_INVISIBLE: Final = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]"
)


def shortened(text: str, max_length: int = MOST_QUOTED) -> str:
    """Return foreign text for a message, without the middle if it is long."""
    if len(text) <= max_length:
        return text
    half = (max_length - 3) // 2
    return f"{text[:half]} … {text[-half:]}"


def escaped(text: str) -> str:
    r"""Return foreign text for a terminal, with invisible characters as in JSON: `\u001b`."""
    return _INVISIBLE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


class DeepAccidentError(Exception):
    """Base of all errors raised on purpose by the devkit."""

    # In a list, each line may be as long as another error's message.
    _is_list: ClassVar[bool] = False

    def __init__(self, *message: object) -> None:
        """Store the sentence, shortened in the middle, with visible control characters."""
        super().__init__(*map(self._sanitize, message))

    def _sanitize(self, message: object) -> str:
        parts = str(message).split("\n") if self._is_list else [str(message)]
        return "\n".join(shortened(escaped(part), MOST_SAID) for part in parts)

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle as the sentence: dask cannot copy errors that are OSError and ValueError."""
        return type(self), self.args

    def __str__(self) -> str:
        """Return the sentence itself (`KeyError` would show its repr)."""
        if self.args:
            return str(self.args[0])
        return ""


class ArgumentError(DeepAccidentError):
    """Your argument cannot be used: change the call."""


class FileError(DeepAccidentError):
    """This file or folder cannot be read, used or written: mend it, or give another."""


class UnavailableError(DeepAccidentError):
    """Something that the call needs is missing, or does not run, here."""


class ReleaseError(FileError, ValueError):
    """Something in the release on disk does not keep to its format."""


class DatarootError(ReleaseError, FileNotFoundError):
    """The dataroot does not exist, holds no release, or has unreadable archives; lists them."""

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
    """A calibration file cannot be read, or holds something else."""


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
    """A folder of written motion labels is missing, damaged or something else."""


class ExportError(FileError, OSError):
    """A folder of an export cannot be made, written to or read, or it holds something else."""


class OutputFolderError(FileError, OSError):
    """An output would leave its folder, or would replace a device, a pipe or a folder."""


class ResultsError(FileError, ValueError):
    """A results file, or a bundle of an evaluation, cannot be used as it is."""


class LookupFailedError(ArgumentError, KeyError):
    """A table, token, field or channel does not exist."""


class TokenError(LookupFailedError):
    """No row has this token."""


class TableError(LookupFailedError):
    """No table has this name."""


class FieldError(LookupFailedError):
    """The table has no such field."""


class MissingNameError(ArgumentError, AttributeError):
    """An object has no attribute of this name; the nuScenes devkit's has."""


class KeywordError(ArgumentError, TypeError):
    """A function has no argument of this name; the nuScenes devkit's has."""


class ChoiceError(ArgumentError, ValueError):
    """An argument is not one of the values it can take (a frame, a channel, a layout, …)."""


class GeometryError(ArgumentError, ValueError):
    """An array is no valid transform, box or point set."""


class ConfigError(ArgumentError, ValueError):
    """A configuration cannot be carried out."""


class EvaluationError(ArgumentError, ValueError):
    """Predictions do not fit together: a sample occurs twice or is missing, or settings differ."""


class NotAvailableError(UnavailableError, LookupError):
    """The call needs something that this release does not have (labels, an agent, split files)."""


class WorkerError(UnavailableError, RuntimeError):
    """A worker was killed or cannot do the work, or no scheduler answers."""


class SomeFailedError(UnavailableError, RuntimeError):
    """Some items of bulk work failed, and the others are done; the message lists every failure."""

    _is_list = True


class MissingExtraError(UnavailableError, ImportError):
    """An optional dependency is needed and not installed."""


class MissingPluginError(UnavailableError, ImportError):
    """A plug-in is needed that this installation lacks."""
