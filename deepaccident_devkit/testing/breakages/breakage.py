"""`Breakage`, and `ScenarioEditor`, which replaces the raw files of a scenario."""

import io
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from deepaccident_devkit.errors import ReleaseError
from deepaccident_devkit.release import ScenarioFolder, read_calib, write_raw_calib
from deepaccident_devkit.release.labels import LABEL_FIELDS
from deepaccident_devkit.release.layout import frame_numbers
from deepaccident_devkit.release.npz import KEY, read_npz
from deepaccident_devkit.release.store import real_path
from deepaccident_devkit.support.arrays import AnyArray, ShortRepr
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.taxonomy import CHANNEL_FORMAT, INFRASTRUCTURE, AgentName

LabelRows = list[list[str]]
"""The words of a label file's lines; the first line is the header."""
FILE_ENDINGS: Mapping[str, str] = {"label": "txt", "calib": "pkl", **CHANNEL_FORMAT}
"""Kind of file → its extension."""
FIELD: Mapping[str, int] = {name: index for index, name in enumerate(LABEL_FIELDS)}
"""Field of a label line → its index in the line."""
Apply = Callable[["Victim"], Path]
"""Function that breaks a scenario and returns the broken file or folder."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Breakage(ShortRepr):
    """A named way to break a release, or to make it unusual in ways that its format allows.

    Attributes:
        name: A name such as `label-cut`.
        group: What is broken: `label`, `calib`, `meta`, `sensor` or `release`; `legal` for unusual
            content that a loader must accept.
        description: One sentence.
        codes: Codes that `deepaccident validate` reports for a small release with this breakage,
            and not for a healthy one, sorted; empty if it reports none.
        deep: Whether `--deep` is needed to find them.
        opening: Error that `DeepAccident(...)` raises; None if the release can be opened.
        reading: Error that the broken file's reader raises; None if no file is broken, or it can be
            read.
        channel: Sensor whose files it needs; None if it only needs labels, calib and meta.
        apply: Function that breaks a scenario and returns the broken file or folder.
    """

    name: str
    group: str
    description: str
    codes: tuple[str, ...]
    deep: bool
    opening: type[ReleaseError] | None
    reading: type[ReleaseError] | None
    channel: str | None
    apply: Apply = field(repr=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class BrokenRelease(ShortRepr):
    """A release after it was broken.

    Attributes:
        root: Folder of the release.
        breakage: The breakage.
        scenario: Token of the broken scenario; the others are unchanged.
        agent: Agent whose files are broken; None if it is not just one.
        frame: Frame whose files are broken; None if it is not just one.
        path: File or folder that is broken, missing or unusual.
        marker: Folder that is created if anybody runs a program hidden in the release; it must
            never exist.
    """

    root: Path
    breakage: Breakage
    scenario: str
    agent: AgentName
    frame: int
    path: Path
    marker: Path


class ScenarioEditor:
    """Damages the files of one scenario; safe for hard links, as no file is edited in place.

    Methods that write, edit or remove return the path that they changed.

    Attributes:
        root: Folder of the release.
        scenario: Folder of the scenario.
        token: Token of the scenario.
        agents: Agents with calib files.
        frames: Numbers of the frames, from the first agent's calib files.
    """

    def __init__(self, root: Path, scenario: ScenarioFolder) -> None:
        self.root = root
        self.scenario = scenario
        self.token = scenario.token
        self.agents = scenario.agents
        self.frames = frame_numbers(scenario.kind_folder(scenario.agents[0], "calib"), "pkl")[0]

    def changing(self, path: Path) -> None:
        """Prepare for a file's change or removal; a subclass can save the old file here."""

    def file(self, agent: str, kind: str, frame: int) -> Path:
        """Return the path of a file of one kind: `label`, `calib` or a channel."""
        path = self.scenario.file(agent, kind, frame, FILE_ENDINGS[kind])
        return real_path(path)

    def folder(self, agent: str, kind: str) -> Path:
        """Return the folder with the files of one kind: `label`, `calib` or a channel."""
        return real_path(self.scenario.kind_folder(agent, kind))

    def write(self, path: Path, content: bytes) -> Path:
        """Create or replace a file."""
        self.changing(path)
        write_bytes(path, content)
        return path

    def append(self, path: Path, content: bytes) -> Path:
        """Add bytes to the end of a file."""
        return self.write(path, path.read_bytes() + content)

    def remove(self, path: Path) -> Path:
        """Remove a file."""
        self.changing(path)
        path.unlink()
        return path

    def remove_folder(self, folder: Path) -> Path:
        """Remove a folder and its contents; do nothing if it does not exist."""
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                self.changing(path)
        shutil.rmtree(folder, ignore_errors=True)
        return folder

    def rename(self, path: Path, name: str) -> None:
        """Rename a file within its folder."""
        self.write(path.with_name(name), path.read_bytes())
        self.remove(path)

    def exchange(self, path: Path, other: Path) -> None:
        """Swap the contents of two files."""
        content = path.read_bytes()
        other_content = other.read_bytes()
        self.write(path, other_content)
        self.write(other, content)

    def rows(self, agent: str, frame: int) -> LabelRows:
        """Return the words in each line of a label file."""
        text = self.file(agent, "label", frame).read_text("ascii")
        return [line.split() for line in text.splitlines()]

    def write_rows(self, agent: str, frame: int, rows: LabelRows) -> Path:
        """Replace the content of a label file by these lines, each a list of words."""
        text = "\n".join(map(" ".join, rows))
        path = self.file(agent, "label", frame)
        return self.write(path, text.encode("ascii"))

    def edit_rows(
        self,
        agent: str,
        frames: Sequence[int],
        edit: Callable[[list[str]], None],
        *,
        actor: int | None = None,
    ) -> Path:
        """Apply `edit` to the words of each box line in these frames.

        If `actor`, a label id, is not None, only its lines are edited.
        """
        for frame in frames:
            rows = self.rows(agent, frame)
            for row in rows[1:]:
                if actor in (None, int(row[FIELD["id"]])):
                    edit(row)
            self.write_rows(agent, frame, rows)
        return self.folder(agent, "label")

    def calib(self, agent: str, frame: int) -> dict[str, AnyArray]:
        """Return the dict in a calib file; raise CalibError if the file is already damaged."""
        return read_calib(self.file(agent, "calib", frame), raw=True)

    def write_calib(self, agent: str, frame: int, calib: Mapping[str, AnyArray]) -> Path:
        """Replace a calib file without any checks."""
        path = self.file(agent, "calib", frame)
        self.changing(path)
        write_raw_calib(path, calib)
        return path

    def edit_calib(
        self, agent: str, frames: Sequence[int], key: str, edit: Callable[[AnyArray], AnyArray]
    ) -> Path:
        """Replace one array in the calib files of several frames."""
        for frame in frames:
            calib = self.calib(agent, frame)
            self.write_calib(agent, frame, {**calib, key: edit(calib[key])})
        return self.folder(agent, "calib")

    def array(self, agent: str, channel: str, frame: int) -> AnyArray:
        """Return the array in an npz file as stored."""
        return read_npz(self.file(agent, channel, frame), "lidar")

    def write_array(
        self, agent: str, channel: str, frame: int, array: Any, *, key: str = KEY
    ) -> Path:
        """Replace an npz file; the array may have any type, including object, and any key."""
        content = io.BytesIO()
        np.savez_compressed(content, **{key: array})
        path = self.file(agent, channel, frame)
        return self.write(path, content.getvalue())

    def meta_lines(self) -> list[str]:
        """Return the lines in the meta file."""
        path = real_path(self.scenario.meta_path)
        return path.read_text("ascii").splitlines()

    def write_meta_lines(self, lines: Sequence[str]) -> Path:
        """Replace the meta file."""
        path = real_path(self.scenario.meta_path)
        return self.write(path, "\n".join(lines).encode("ascii"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Victim:
    """The scenario that a breakage is applied to.

    Attributes:
        editor: Editor of the scenario.
        agent: The vehicle whose files are broken.
        frame: A frame in the middle of the scenario.
        marker: See `BrokenRelease`.
    """

    editor: ScenarioEditor
    agent: AgentName
    frame: int
    marker: Path

    @property
    def other(self) -> AgentName:
        """Another vehicle; raise LookupError if there is none."""
        for agent in self.editor.agents:
            if agent not in (self.agent, INFRASTRUCTURE):
                return agent
        raise LookupError("a second vehicle that records")

    def file(self, kind: str) -> Path:
        """Return the agent's file of one kind in the frame."""
        return self.editor.file(self.agent, kind, self.frame)

    def folder(self, kind: str) -> Path:
        """Return the folder with the agent's files of one kind."""
        return self.editor.folder(self.agent, kind)

    def read_rows(self) -> LabelRows:
        """Return the words in each line of the agent's label in the frame."""
        return self.editor.rows(self.agent, self.frame)

    def write_rows(self, rows: LabelRows) -> Path:
        """Replace the agent's label in the frame; return its path."""
        return self.editor.write_rows(self.agent, self.frame, rows)

    def replace_pose(self, change: Callable[[AnyArray], AnyArray]) -> Path:
        """Change the agent's pose in the frame's calib file; return the path of the file."""
        self.editor.edit_calib(self.agent, [self.frame], "ego_to_world", change)
        return self.file("calib")

    def overwrite(self, kind: str, content: bytes) -> Path:
        """Replace the agent's file of one kind in the frame; return its path."""
        return self.editor.write(self.file(kind), content)

    def replace(self, kind: str, change: Callable[[bytes], bytes]) -> Path:
        """Change the bytes of the agent's file of one kind in the frame; return its path."""
        path = self.file(kind)
        return self.editor.write(path, change(path.read_bytes()))

    def replace_array(
        self, channel: str, change: Callable[[AnyArray], AnyArray], *, key: str = KEY
    ) -> Path:
        """Change the array in the agent's npz file in the frame; return the path of the file."""
        array = change(self.editor.array(self.agent, channel, self.frame))
        return self.editor.write_array(self.agent, channel, self.frame, array, key=key)


@dataclass(slots=True)
class BreakageGroup:
    """Collects the breakages of a module; their functions define name and description."""

    name: str
    opening: type[ReleaseError] | None = None
    reading: type[ReleaseError] | None = None
    deep: bool = False
    breakages: list[Breakage] = field(default_factory=list)

    def enter(self, *codes: str, channel: str | None = None) -> Callable[[Apply], Apply]:
        """Return a decorator that adds a function to the group.

        Args:
            *codes: Codes that `deepaccident validate` reports.
            channel: Sensor whose files the breakage needs; None if it needs none.
        """

        def decorate(apply: Apply) -> Apply:
            breakage = Breakage(
                name=apply.__name__.replace("_", "-"),
                group=self.name,
                description=" ".join((apply.__doc__ or "").split()),
                codes=tuple(sorted(codes)),
                deep=self.deep,
                opening=self.opening,
                reading=self.reading,
                channel=channel,
                apply=apply,
            )
            self.breakages.append(breakage)
            return apply

        return decorate
