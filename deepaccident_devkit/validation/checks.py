"""`ScenarioCheck`: what was found in one scenario; and what decides it."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass

from deepaccident_devkit._version import __version__
from deepaccident_devkit.release import ScenarioFolder
from deepaccident_devkit.release.store import Entry, ReleasePath, listed
from deepaccident_devkit.support.reading import LIMITS_VARIABLE
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.tables.boxes import VelocityFit, total_fit
from deepaccident_devkit.tables.scan import times_digest
from deepaccident_devkit.taxonomy import AGENTS, CHANNELS
from deepaccident_devkit.validation.completeness import FileCount

NO_FIT = total_fit([])


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioCheck:
    """What was found in one scenario.

    Attributes:
        token: the scenario's.
        findings: in the order of the checks.
        samples: agents times frames.
        files: how many are here and missing.
        velocity: what the labels' velocities fit.
    """

    token: str
    findings: tuple[Finding, ...]
    samples: int
    files: tuple[FileCount, ...]
    velocity: VelocityFit = NO_FIT

    def to_json(self) -> str:
        """One JSON object, from which `of_json` makes an equal one."""
        return json.dumps(asdict(self))

    @classmethod
    def of_json(cls, text: bytes) -> ScenarioCheck:
        """The check that `to_json` wrote."""
        stored = json.loads(text)  # names of files may have half characters
        return cls(
            token=stored["token"],
            findings=tuple(Finding(**each) for each in stored["findings"]),
            samples=stored["samples"],
            files=tuple(FileCount(**each) for each in stored["files"]),
            velocity=VelocityFit(**stored["velocity"]),
        )


def check_key(scenario: ScenarioFolder, *, deep: bool) -> str:
    """A digest of all that decides a scenario's check: the devkit, settings, names, sizes and times of its files."""
    settings = (__version__, deep, str(scenario.root), scenario.folder, os.environ.get(LIMITS_VARIABLE))
    digest = hashlib.blake2b(f"{settings} {times_digest(scenario)}".encode(), digest_size=8)
    for agent in AGENTS:
        for channel in CHANNELS:
            for words in (f"{agent}/{channel}", *_entries(scenario.kind_folder(agent, channel))):
                digest.update(os.fsencode(f"{words}\n"))
    return digest.hexdigest()


def _entries(folder: ReleasePath) -> list[str]:
    """Name, size and time of everything in a folder; nothing if it cannot be listed."""
    try:
        return sorted(f"{entry.name} {_times(entry)}" for entry in listed(folder))
    except OSError:
        return []


def _times(entry: Entry) -> str:
    try:
        status = entry.stat()
    except OSError:  # a link that leads nowhere
        return "none"
    return f"{status.st_size} {status.st_mtime_ns}"
