"""Where a file belongs in a release, by the folders that lead to it in an archive or below a URL."""

import re
from collections.abc import Sequence
from typing import Final

from deepaccident_devkit.taxonomy import MINI_SPLITS, SPLITS

MINI_FOLDER: Final = "DeepAccident_mini"
SPLIT_FOLDERS: Final = SPLITS
SPLIT_FILE_FOLDER: Final = "split_txt_files"
SCENARIO_TYPE: Final = re.compile(r"type\d+_subtype\d+_(?:accident|normal)")
SPLIT_FILES: Final = tuple(f"{split}.txt" for split in (*SPLITS, *MINI_SPLITS))
_FROM_MACOS: Final = "__MACOSX"
"""The folder that macOS adds to its archives."""


def release_folder(parts: Sequence[str]) -> str | None:
    """The folder of a release that a folder stands for: from its scenario type on, below its split folder if any.

    `DeepAccident/train/type1_subtype1_accident/meta` stands for `train/type1_subtype1_accident/meta`. What leads there
    does not matter, so that an archive may hold any part of a release, below any folders.

    Args:
        parts: the names of the folders that lead to it and its own.

    Returns:
        The folder with `/` between names, empty for the release's own; None for one that holds files of no release.
    """
    if any(name.startswith(".") or name == _FROM_MACOS for name in parts):  # hidden, or leading out of an archive
        return None
    types = [place for place, name in enumerate(parts) if SCENARIO_TYPE.fullmatch(name)]
    if not types:
        return ""
    above = [name for name in parts[: types[-1]] if name in (*SPLIT_FOLDERS, MINI_FOLDER)]
    return "/".join([*above[-1:], *parts[types[-1] :]])


def is_release_file(folder: str, name: str) -> bool:
    """Whether a file is of a release: below a scenario type, or a split file in the release's own folder."""
    return bool(folder) or name in SPLIT_FILES
