"""The bytes and lines of the release's files, with the devkit's errors if they cannot be read."""

from deepaccident_devkit.errors import MissingFileError, ReleaseError
from deepaccident_devkit.reading import FileKind, fault_text, read_bytes
from deepaccident_devkit.release.store import ReleasePath


def read_content(path: ReleasePath, kind: FileKind, fault: type[ReleaseError], remedy: str) -> bytes:
    """A file's bytes.

    Raises:
        MissingFileError: there is no such file.
        ReleaseError: of the type `fault`, if it cannot be read: a folder or a pipe, too large for its kind, no
            permission, a failing disk.
    """
    try:
        return read_bytes(path, kind)
    except FileNotFoundError:
        raise MissingFileError(f"{path}: no such file; unpack the archive that holds it") from None
    except OSError as error:
        raise fault(f"{path}: {fault_text(error)}; {remedy}") from error


def read_lines(path: ReleasePath, kind: FileKind, fault: type[ReleaseError], remedy: str) -> list[str]:
    """The lines of a UTF-8 file, without line ends.

    Raises as `read_content` does, and `fault` if the file is no text.
    """
    try:
        return read_content(path, kind, fault, remedy).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise fault(f"{path}: not a text file ({error.reason}); {remedy}") from error
