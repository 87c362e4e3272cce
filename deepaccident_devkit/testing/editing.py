"""`ScenarioEditor`: changes the raw files of one scenario; files are replaced, never changed in place."""

import io
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deepaccident_devkit.release import ScenarioFolder, read_calib, write_raw_calib
from deepaccident_devkit.release.labels import FIELDS
from deepaccident_devkit.release.layout import frame_numbers
from deepaccident_devkit.release.npz import KEY, read_npz
from deepaccident_devkit.release.store import real_path
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.taxonomy import CHANNEL_FORMAT

Rows = list[list[str]]
"""The words of a label file's lines; the first line is the header."""
ENDINGS: Mapping[str, str] = {"label": "txt", "calib": "pkl", **CHANNEL_FORMAT}
"""Kind of file → its ending."""
FIELD: Mapping[str, int] = {name: place for place, name in enumerate(FIELDS)}
"""Field of a label line → its place in the line."""


class ScenarioEditor:
    """One scenario's files, to be damaged; a release of hard links is safe, because no file is changed in place.

    Attributes:
        root: the release's folder.
        scenario: the scenario's folder.
        token: the scenario's token.
        agents: the agents with calib files.
        frames: numbers of the frames, from the first agent's calib files.
    """

    def __init__(self, root: Path, scenario: ScenarioFolder) -> None:
        self.root = root
        self.scenario = scenario
        self.token = scenario.token
        self.agents = scenario.agents
        self.frames = frame_numbers(scenario.kind_folder(scenario.agents[0], "calib"), "pkl")[0]

    def changing(self, path: Path) -> None:
        """Called before a file is made, replaced or removed; a subclass can save the old file here."""

    def file(self, agent: str, kind: str, frame: int) -> Path:
        """A file of a kind: `label`, `calib` or a channel."""
        return real_path(self.scenario.file(agent, kind, frame, ENDINGS[kind]))

    def folder(self, agent: str, kind: str) -> Path:
        """The folder of the files of a kind."""
        return real_path(self.scenario.kind_folder(agent, kind))

    def write(self, path: Path, content: bytes) -> None:
        """Make or replace a file."""
        self.changing(path)
        write_bytes(path, content)

    def remove(self, path: Path) -> None:
        """Remove a file."""
        self.changing(path)
        path.unlink()

    def remove_folder(self, folder: Path) -> None:
        """Remove a folder with all its contents; if there is none, do nothing."""
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                self.changing(path)
        shutil.rmtree(folder, ignore_errors=True)

    def rename(self, path: Path, name: str) -> None:
        """Give a file another name in its folder."""
        self.write(path.with_name(name), path.read_bytes())
        self.remove(path)

    def exchange(self, one: Path, other: Path) -> None:
        """Exchange the contents of two files."""
        content, other_content = one.read_bytes(), other.read_bytes()
        self.write(one, other_content)
        self.write(other, content)

    def rows(self, agent: str, frame: int) -> Rows:
        """The words of a label file's lines."""
        return [line.split() for line in self.file(agent, "label", frame).read_text("ascii").splitlines()]

    def write_rows(self, agent: str, frame: int, rows: Rows) -> None:
        """Replace a label."""
        self.write(self.file(agent, "label", frame), "\n".join(" ".join(row) for row in rows).encode("ascii"))

    def edit_rows(
        self, agent: str, frames: Sequence[int], edit: Callable[[list[str]], None], *, actor: int | None = None
    ) -> None:
        """Apply `edit` to the words of each box line of the frames; with `actor`, only to lines with this id."""
        for frame in frames:
            rows = self.rows(agent, frame)
            for row in rows[1:]:
                if actor in (None, int(row[FIELD["id"]])):
                    edit(row)
            self.write_rows(agent, frame, rows)

    def calib(self, agent: str, frame: int) -> dict[str, AnyArray]:
        """The dict in a calib file. Raises CalibError if the file is already damaged."""
        return read_calib(self.file(agent, "calib", frame), raw=True)

    def write_calib(self, agent: str, frame: int, calib: Mapping[str, AnyArray]) -> None:
        """Replace a calib file; nothing is checked."""
        path = self.file(agent, "calib", frame)
        self.changing(path)
        write_raw_calib(path, calib)

    def edit_calib(self, agent: str, frames: Sequence[int], key: str, edit: Callable[[AnyArray], AnyArray]) -> None:
        """Replace one array in the calib files of the frames."""
        for frame in frames:
            calib = self.calib(agent, frame)
            self.write_calib(agent, frame, {**calib, key: edit(calib[key])})

    def array(self, agent: str, channel: str, frame: int) -> AnyArray:
        """The array of an npz file, unchanged."""
        return read_npz(self.file(agent, channel, frame), "lidar")

    def write_array(self, agent: str, channel: str, frame: int, array: Any, *, key: str = KEY) -> None:
        """Replace an npz file by one with any array, of objects too, under any key."""
        content = io.BytesIO()
        np.savez_compressed(content, **{key: array})
        self.write(self.file(agent, channel, frame), content.getvalue())

    def meta_lines(self) -> list[str]:
        """The lines of the meta file."""
        return real_path(self.scenario.meta_path).read_text("ascii").splitlines()

    def write_meta_lines(self, lines: Sequence[str]) -> None:
        """Replace the meta file."""
        self.write(real_path(self.scenario.meta_path), "\n".join(lines).encode("ascii"))
