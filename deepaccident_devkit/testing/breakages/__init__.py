"""`BREAKAGES`: the named ways to break a release, and the devkit's findings for each."""

from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.release import ScenarioFolder, find_release
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import VEHICLE_AGENTS
from deepaccident_devkit.testing.breakages import files, folders
from deepaccident_devkit.testing.breakages.breakage import (
    Breakage,
    BrokenRelease,
    ScenarioEditor,
    Victim,
)
from deepaccident_devkit.testing.releases import SmallRelease, write_small_release

_GROUPS = (
    files.LABEL_FORM,
    files.LABEL_MEANING,
    files.CALIB_FORM,
    files.CALIB_MEANING,
    files.META_FORM,
    files.META_MEANING,
    files.SENSOR_FORM,
    files.SENSOR_MISSING,
    files.SENSOR_MEANING,
    folders.BROKEN,
    folders.ODD,
    folders.SPLIT_FILE,
    folders.LEGAL,
)
BREAKAGES: Mapping[str, Breakage] = {
    breakage.name: breakage for group in _GROUPS for breakage in group.breakages
}
"""Name → breakage."""


def break_release(root: Path, name: str) -> BrokenRelease:
    """Break the first labelled scenario of a release in place; hard-linked copies stay intact.

    The release should be made by this test kit, or be a copy.

    Args:
        root: Folder of the release.
        name: One of `BREAKAGES`.

    Raises:
        ChoiceError: If `name` is not in `BREAKAGES`.
        ConfigError: If the release has no labelled scenario, or lacks a part that is to be broken.
    """
    breakage = checked_breakage(name)
    editor = _WatchedEditor(root, _first_labelled(root))
    vehicles = [agent for agent in editor.agents if agent in VEHICLE_AGENTS]
    agent = (vehicles or editor.agents)[0]
    frame = editor.frames[len(editor.frames) // 2]
    marker = root.with_name(f"{root.name} - code has run")
    victim = Victim(editor=editor, agent=agent, frame=frame, marker=marker)
    try:
        path = breakage.apply(victim)
    except (FileNotFoundError, LookupError, ValueError) as error:
        raise ConfigError(
            f"{root}: {name!r} cannot break {editor.token}, which lacks a part: {error}; choose a "
            "complete release, such as one of SmallRelease()"
        ) from error
    if not editor.has_changed():
        raise ConfigError(
            f"{root}: {name!r} changes nothing in {editor.token}; choose a release that has the "
            "part that it breaks, such as one of SmallRelease()"
        )
    return BrokenRelease(
        root=root,
        breakage=breakage,
        scenario=editor.token,
        agent=agent,
        frame=frame,
        path=path,
        marker=marker,
    )


def broken_release(out: Path, name: str, config: SmallRelease | None = None) -> BrokenRelease:
    """Write a small release and break its first accident.

    Args:
        out: Folder to make; it must be empty, or not exist yet.
        name: One of `BREAKAGES`.
        config: Options of the release; `SmallRelease()` if None.

    Raises:
        ChoiceError: If `name` is not in `BREAKAGES`.
        ConfigError: If `out` is a file or is not empty, or if a release with these options lacks a
            part that is to be broken.
    """
    checked_breakage(name)
    return break_release(write_small_release(out, config), name)


def checked_breakage(name: str) -> Breakage:
    """Return the breakage with a name; raise ChoiceError if it does not exist."""
    return BREAKAGES[choice("breakage", name, BREAKAGES)]


class _WatchedEditor(ScenarioEditor):
    """An editor that notices whether any file has changed."""

    def __init__(self, root: Path, scenario: ScenarioFolder) -> None:
        super().__init__(root, scenario)
        self._before: dict[Path, bytes | None] = {}

    def changing(self, path: Path) -> None:
        """Remember a digest of a file's content before its first change."""
        if path not in self._before:
            self._before[path] = _digest(path)

    def has_changed(self) -> bool:
        """Return whether any file was changed, created or removed."""
        for path, before in self._before.items():
            if _digest(path) != before:
                return True
        return False


def _digest(path: Path) -> bytes | None:
    if not path.is_file():
        return None
    return sha256(path.read_bytes()).digest()


def _first_labelled(root: Path) -> ScenarioFolder:
    for scenario in find_release(root).scenarios:
        if scenario.kind_folder(scenario.agents[0], "label").is_dir():
            return scenario
    raise ConfigError(f"{root}: has no labelled scenario to break; give another release")


__all__ = [
    "BREAKAGES",
    "Breakage",
    "BrokenRelease",
    "break_release",
    "broken_release",
    "checked_breakage",
]
