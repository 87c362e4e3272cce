"""`train.txt`, `val.txt`, …: which scenario belongs to which split (docs/format.md, Tree)."""

from collections.abc import Sequence
from pathlib import Path

from deepaccident_devkit.errors import SplitFileError, shortened
from deepaccident_devkit.release._content import read_lines
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.support.files import write_bytes


def read_split_file(path: ReleasePath, *, raw: bool = False, unique: bool = False) -> list[str]:
    """The scenarios of a split file, in its order, each once, as tokens `<scenario_type>/<scenario>`.

    Blank lines, blanks at line ends and CRLF are read.

    Args:
        path: the file.
        raw: keep scenarios that stand in several lines as often.
        unique: a scenario in two lines is an error; if not set, it counts once.

    Raises:
        MissingFileError: there is no such file.
        SplitFileError: a line has not two words, the file is no text, or a scenario stands twice and `unique` is set.
    """
    lines = read_lines(path, "split", SplitFileError, "restore it from the release")
    words = [(number, tuple(line.split(maxsplit=2))) for number, line in enumerate(lines, start=1) if line.strip()]
    for number, line_words in words:
        if len(line_words) != 2:
            raise SplitFileError(
                f"{path}:{number}: expected '<scenario_type> <scenario>', found {shortened(' '.join(line_words))!r}; "
                "mend or remove the line"
            )
    if unique:
        _check_unique(path, words)
    tokens = ["/".join(line_words) for _, line_words in words]
    return tokens if raw else list(dict.fromkeys(tokens))


def write_split_file(path: Path, scenario_tokens: Sequence[str]) -> None:
    """Write scenario tokens, one line each."""
    lines = [f"{scenario_type} {name}\n" for scenario_type, name in (token.split("/") for token in scenario_tokens)]
    write_bytes(path, "".join(lines).encode())


def _check_unique(path: ReleasePath, words: Sequence[tuple[int, tuple[str, ...]]]) -> None:
    first_line: dict[tuple[str, ...], int] = {}
    for number, line_words in words:
        if line_words in first_line:
            raise SplitFileError(
                f"{path}:{number}: {shortened(' '.join(line_words))!r} stands in line {first_line[line_words]} "
                "already; remove one of the two lines"
            )
        first_line[line_words] = number
