"""Parts of a release, which `deepaccident export release` writes: what they should have."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from deepaccident_devkit.errors import DatarootError
from deepaccident_devkit.release.store import ReleasePath, read_content
from deepaccident_devkit.support.json_text import parsed_record
from deepaccident_devkit.support.values import ReadOnlyValues

# Name of the file in the folder of a part that says what the part should have.
_MANIFEST_NAME = "release.manifest.json"
_REMEDY = "export the part again into a new folder"


@dataclass(frozen=True, slots=True, kw_only=True)
class PartManifest:
    """The manifest of a part of a release.

    Attributes:
        release: Sources of the part; None until the part is complete.
        contents: Number of files that the part should have in each scenario, by the scenario's
            token and then by `recording_name`; empty until the part is complete. Files that are
            empty, or of frames without labels and calib, do not count.
    """

    release: ReadOnlyValues | None = None
    contents: Mapping[str, Mapping[str, int]] = field(default_factory=dict)


def recording_name(agent: str | None, kind: str) -> str:
    """Return the name of an agent's files of one kind, such as `ego_vehicle/label`.

    Without an agent, it is the kind itself, which is `meta`.
    """
    return kind if agent is None else f"{agent}/{kind}"


def read_part_manifest(root: ReleasePath) -> PartManifest | None:
    """Return the manifest of a part of a release; None for a release without one.

    Args:
        root: Folder of the release.

    Raises:
        DatarootError: If the manifest cannot be read.
    """
    path = root / _MANIFEST_NAME
    if not path.is_file():
        return None
    content = read_content(path, "bundle", DatarootError, _REMEDY)
    try:
        return parsed_record(content, PartManifest)
    except ValueError as error:
        raise DatarootError(
            f"{path}: is not the manifest of a part of a release ({error}); {_REMEDY}"
        ) from error
