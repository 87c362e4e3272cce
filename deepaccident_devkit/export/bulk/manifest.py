"""The manifest of an export's folder, which fixes what is in it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit._version import __version__
from deepaccident_devkit.errors import ConfigError, ExportError
from deepaccident_devkit.export.bulk.output import MALFORMED, Tally
from deepaccident_devkit.export.bulk.unfinished import FOLDER
from deepaccident_devkit.files import remove_leftovers, temporary_of, write_bytes
from deepaccident_devkit.json_text import parsed_json
from deepaccident_devkit.reading import fault_text, read_bytes, shortened

_FORMAT: Final = "DeepAccident export"
_ENDING: Final = ".manifest.json"
_AGAIN: Final = "export again into an empty folder"


@dataclass(slots=True, kw_only=True)
class Manifest:
    """What a folder holds.

    Attributes:
        name: of the format; the file is `<name>.manifest.json`.
        settings: everything that decides what is written.
        fingerprint: of the truth of the exported scenarios (`release.fingerprints`); None until it is complete.
        scenarios: token → hashes of its label, meta and calib files, by kind, and of the list of its sensor files,
            `sensors`, where these matter; empty until it is complete.
        tally: counts of all that is there.
    """

    name: str
    settings: Mapping[str, Any]
    fingerprint: str | None = None
    scenarios: Mapping[str, Mapping[str, str | None]] = field(default_factory=dict)
    tally: Tally = field(default_factory=Tally)

    @property
    def complete(self) -> bool:
        """Whether everything has been written."""
        return self.fingerprint is not None

    @classmethod
    def of(cls, folder: Path, name: str, settings: Mapping[str, Any], beside: tuple[str, ...] = ()) -> Manifest:
        """The manifest of a folder into which an export will be written; changes nothing.

        Args:
            folder: it need not exist.
            name: of the format.
            settings: of the export.
            beside: formats whose exports may be there already.

        Raises:
            ConfigError: the folder holds an export with other settings.
            ExportError: it holds something else, is a file, or its manifest cannot be read.
        """
        try:
            if manifest_path(folder, name).exists():
                found = cls.read(folder, name)
                found.check(folder, settings)
                return found
            if folder.exists() and not folder.is_dir():
                raise ExportError(f"{folder}: is a file; give a folder")
            others = [] if not folder.exists() else sorted(each.name for each in folder.iterdir())
        except ExportError:
            raise
        except OSError as error:
            raise ExportError(f"{folder}: cannot be read ({error}); choose another folder") from error
        welcome = any(manifest_path(folder, each).name in others for each in beside)
        own = manifest_path(folder, name).name  # another process may have written it just now
        strange = [each for each in others if not _is_own(each) and each != own]
        if strange and not welcome:
            raise ExportError(
                f"{folder}: is not empty ({shortened(strange[0])}) and holds no {name} export; choose a new folder"
            )
        return cls(name=name, settings=settings)

    @classmethod
    def read(cls, folder: Path, name: str) -> Manifest:
        """The manifest that a folder has; raises ExportError."""
        path = manifest_path(folder, name)
        try:
            told = parsed_json(read_bytes(path, "bundle"))
            if (told["what"], told["format"]) != (_FORMAT, name):
                raise ValueError("another format's")
            release = told["release"]
            return cls(
                name=name,
                settings=dict(told["settings"]),
                fingerprint=None if release is None else str(release["fingerprint"]),
                scenarios={} if release is None else {token: dict(one) for token, one in release["scenarios"].items()},
                tally=Tally.of(told["written"]),
            )
        except OSError as error:
            raise ExportError(f"{path}: {fault_text(error)}; {_AGAIN}") from error
        except MALFORMED as error:
            raise ExportError(
                f"{path}: is no manifest of a {name} export ({shortened(repr(error))}); {_AGAIN}"
            ) from error

    def write(self, folder: Path) -> None:
        """Write it into its folder."""
        release = (
            None
            if self.fingerprint is None
            else {
                "fingerprint": self.fingerprint,
                "scenarios": dict(sorted(self.scenarios.items())),
            }
        )
        content = {
            "what": _FORMAT,
            "format": self.name,
            "devkit": __version__,
            "settings": self.settings,
            "release": release,
            "written": self.tally.as_dict(),
        }
        write_bytes(manifest_path(folder, self.name), f"{json.dumps(content, indent=1)}\n".encode())

    def check(self, folder: Path, settings: Mapping[str, Any]) -> None:
        """Refuse other settings; raises ConfigError that names what differs."""
        asked = json.loads(json.dumps(settings))  # tuples become lists, as in the file
        changed = sorted(name for name in {*self.settings, *asked} if self.settings.get(name) != asked.get(name))
        if changed:
            text = "; ".join(
                f"{name}: {shortened(repr(self.settings.get(name)))}, asked for {shortened(repr(asked.get(name)))}"
                for name in changed
            )
            raise ConfigError(
                f"{folder}: holds an export to {self.name} with other settings ({text}); choose another folder"
            )


def manifest_path(folder: Path, name: str) -> Path:
    """The manifest of a format's export."""
    return folder / f"{name}{_ENDING}"


def remove_half_written(folder: Path) -> None:
    """Remove the temporary files of dead processes; a worker that a scheduler took for lost may live, and goes on.

    The caller has the folder alone.
    """
    begun = {temporary_of(each.name) or "" for each in folder.iterdir()}
    remove_leftovers(folder, [name for name in begun if name.endswith(_ENDING)])  # those are written by this one alone
    for each, _, _ in os.walk(folder):
        remove_leftovers(Path(each))


def _is_own(name: str) -> bool:
    """Whether an export that was killed before it wrote its manifest may have left a file of this name."""
    return name == FOLDER or temporary_of(name) is not None
