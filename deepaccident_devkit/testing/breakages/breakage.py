"""`Breakage`, and `ScenarioEditor`, which replaces raw files of a scenario."""

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
"""Kind of file → its ending."""
FIELD: Mapping[str, int] = {name: index for index, name in enumerate(LABEL_FIELDS)}
"""Field of a label line → its index in the line."""
Apply = Callable[["Victim"], Path]


@dataclass(frozen=True, slots=True, kw_only=True)
class Breakage(ShortRepr):
    """A named way in which a release can be broken, or unusual though its format allows it.

    Attributes:
        name: Name such as `label-cut`.
        group: Broken part: `label`, `calib`, `meta`, `sensor`, `release`; `legal` for unusual
            content that a loader must accept.
        description: One sentence.
        codes: Codes that `deepaccident validate` finds in a small release with this breakage and
            not in a healthy one, sorted; empty if it finds none.
        deep: Whether it needs `--deep` to find them.
        opening: Error of `DeepAccident(...)`; None if the release can be opened.
        reading: Error of the reader of the broken file; None if there is no such file, or it can be
            read.
        channel: Sensor with the files that it needs; None if it needs only labels, calib and meta.
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
        agent: Agent with the broken files, if only one agent has any.
        frame: Frame with the broken files, if only one frame has any.
        path: File or folder that is broken, missing or unusual.
        marker: Folder that a program hidden in the release makes if somebody runs it; it must never
            exist.
    """

    root: Path
    breakage: Breakage
    scenario: str
    agent: AgentName
    frame: int
    path: Path
    marker: Path


class ScenarioEditor:
    """Damages one scenario's files; safe for hard links, because no file is changed in place.

    Methods that write, edit or remove return the path.

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
        """Prepare the change or removal of a file; a subclass can save the old file here."""

    def file(self, agent: str, kind: str, frame: int) -> Path:
        """Return the path of a file of a kind: `label`, `calib` or a channel."""
        path = self.scenario.file(agent, kind, frame, FILE_ENDINGS[kind])
        return real_path(path)

    def folder(self, agent: str, kind: str) -> Path:
        """Return the folder of the files of a kind."""
        return real_path(self.scenario.kind_folder(agent, kind))

    def write(self, path: Path, content: bytes) -> Path:
        """Make or replace a file."""
        self.changing(path)
        write_bytes(path, content)
        return path

    def remove(self, path: Path) -> Path:
        """Remove a file."""
        self.changing(path)
        path.unlink()
        return path

    def remove_folder(self, folder: Path) -> Path:
        """Remove a folder with all its contents; if there is none, do nothing."""
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                self.changing(path)
        shutil.rmtree(folder, ignore_errors=True)
        return folder

    def rename(self, path: Path, name: str) -> None:
        """Give a file another name in its folder."""
        self.write(path.with_name(name), path.read_bytes())
        self.remove(path)

    def exchange(self, path: Path, other: Path) -> None:
        """Exchange the contents of two files."""
        content = path.read_bytes()
        other_content = other.read_bytes()
        self.write(path, other_content)
        self.write(other, content)

    def rows(self, agent: str, frame: int) -> LabelRows:
        """Return the words of a label file's lines."""
        text = self.file(agent, "label", frame).read_text("ascii")
        return [line.split() for line in text.splitlines()]

    def write_rows(self, agent: str, frame: int, rows: LabelRows) -> Path:
        """Replace a label."""
        text = "\n".join(" ".join(row) for row in rows)
        return self.write(self.file(agent, "label", frame), text.encode("ascii"))

    def edit_rows(
        self,
        agent: str,
        frames: Sequence[int],
        edit: Callable[[list[str]], None],
        *,
        actor: int | None = None,
    ) -> Path:
        """Apply `edit` to the words of the frames' box lines; with `actor`, only of this id."""
        for frame in frames:
            rows = self.rows(agent, frame)
            for row in rows[1:]:
                if actor in (None, int(row[FIELD["id"]])):
                    edit(row)
            self.write_rows(agent, frame, rows)
        return self.folder(agent, "label")

    def calib(self, agent: str, frame: int) -> dict[str, AnyArray]:
        """Return the dict in a calib file. Raises CalibError if the file is already damaged."""
        return read_calib(self.file(agent, "calib", frame), raw=True)

    def write_calib(self, agent: str, frame: int, calib: Mapping[str, AnyArray]) -> Path:
        """Replace a calib file; nothing is checked."""
        path = self.file(agent, "calib", frame)
        self.changing(path)
        write_raw_calib(path, calib)
        return path

    def edit_calib(
        self, agent: str, frames: Sequence[int], key: str, edit: Callable[[AnyArray], AnyArray]
    ) -> Path:
        """Replace one array in the calib files of the frames."""
        for frame in frames:
            calib = self.calib(agent, frame)
            self.write_calib(agent, frame, {**calib, key: edit(calib[key])})
        return self.folder(agent, "calib")

    def array(self, agent: str, channel: str, frame: int) -> AnyArray:
        """Return the array of an npz file, unchanged."""
        return read_npz(self.file(agent, channel, frame), "lidar")

    def write_array(
        self, agent: str, channel: str, frame: int, array: Any, *, key: str = KEY
    ) -> Path:
        """Replace an npz file by one with any array, also of objects, under any key."""
        content = io.BytesIO()
        np.savez_compressed(content, **{key: array})
        return self.write(self.file(agent, channel, frame), content.getvalue())

    def meta_lines(self) -> list[str]:
        """Return the lines of the meta file."""
        return real_path(self.scenario.meta_path).read_text("ascii").splitlines()

    def write_meta_lines(self, lines: Sequence[str]) -> Path:
        """Replace the meta file."""
        path = real_path(self.scenario.meta_path)
        return self.write(path, "\n".join(lines).encode("ascii"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Victim:
    """The scenario that a breakage breaks.

    Attributes:
        editor: Editor of the scenario.
        agent: A vehicle.
        frame: A frame in the middle of the scenario.
        marker: As in `BrokenRelease`.
    """

    editor: ScenarioEditor
    agent: AgentName
    frame: int
    marker: Path

    @property
    def other(self) -> AgentName:
        """Another vehicle. Raises LookupError without any."""
        for agent in self.editor.agents:
            if agent not in (self.agent, INFRASTRUCTURE):
                return agent
        raise LookupError("a second vehicle that records")

    def file(self, kind: str) -> Path:
        """Return the agent's file of a kind at the frame."""
        return self.editor.file(self.agent, kind, self.frame)

    def replace(self, kind: str, change: Callable[[bytes], bytes]) -> Path:
        """Change the bytes of the agent's file at the frame; returns its path."""
        path = self.file(kind)
        return self.editor.write(path, change(path.read_bytes()))

    def replace_array(
        self, channel: str, change: Callable[[AnyArray], AnyArray], *, key: str = KEY
    ) -> Path:
        """Change the array of the victim's npz file; returns the file."""
        array = change(self.editor.array(self.agent, channel, self.frame))
        return self.editor.write_array(self.agent, channel, self.frame, array, key=key)


@dataclass(slots=True)
class BreakageGroup:
    """Collects the breakages of a module, named and described by their functions."""

    name: str
    opening: type[ReleaseError] | None = None
    reading: type[ReleaseError] | None = None
    deep: bool = False
    breakages: list[Breakage] = field(default_factory=list)

    def enter(self, *codes: str, channel: str | None = None) -> Callable[[Apply], Apply]:
        """Add the decorated function, with the codes of `validate` and the sensor that it needs."""

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
