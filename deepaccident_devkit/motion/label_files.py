"""Motion labels of many samples in one folder: a npz file a scenario and agent, read a sample at a time.

schema/motion_labels.md says what is in them. What follows from instance maps is not stored: segmentation, centerness
and offset come from the instances' centres, flow from one vector an instance.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.errors import ConfigError, LabelFilesError, TokenError
from deepaccident_devkit.files import replacing, write_bytes
from deepaccident_devkit.motion.config import MotionLabelConfig
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.sample_labels import motion_labels
from deepaccident_devkit.motion.stored_labels import StoredLabels, read_array, write_array
from deepaccident_devkit.parallel import run_batch
from deepaccident_devkit.taxonomy import CHANNELS

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from deepaccident_devkit.dataset import Dataset, RowArgument

FORMAT: Final = "DeepAccident motion labels"
FORMAT_VERSION: Final = 1
MANIFEST: Final = "manifest.json"
_OPEN_FILES: Final = 8
_DAMAGED: Final = (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile, zlib.error)
"""What reading a damaged archive raises."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelsWritten:
    """What `write_label_files` did.

    Attributes:
        samples: how many the folder now holds of those asked for.
        written: files made.
        kept: files that were there and hold the same.
    """

    samples: int
    written: int
    kept: int


def write_label_files(
    dataset: Dataset,
    folder: str | os.PathLike[str],
    tokens: Iterable[RowArgument],
    config: MotionLabelConfig | None = None,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> LabelsWritten:
    """Write the motion labels of samples into a folder, one file a scenario and agent.

    Files are whole or absent. A call that was broken off goes on where it stopped; samples may be added later; what
    the release changed in the meantime is written anew.

    Args:
        dataset: the release.
        folder: made where needed; or one with labels of the same configuration.
        tokens: tokens or records of labelled samples.
        config: what labels show; None for the released ones in the devkit's orientation.
        workers: processes; None takes what the work is worth.
        executor: to run on instead, any of `concurrent.futures`.
        progress: whether to show a bar.

    Raises:
        ConfigError: the folder holds labels of another configuration; it is left as it is.
        LabelFilesError: the folder holds something else, or its manifest cannot be read.
        TokenError: no such sample.
        NotAvailableError: a sample has no label.
    """
    root, chosen = Path(folder).expanduser(), config or MotionLabelConfig()
    wanted = _by_recording(dataset, tokens)
    manifest = _Manifest.read(root) if (root / MANIFEST).exists() else _Manifest.new(root, chosen)
    manifest.check(root, chosen)
    manifest.write(root)
    tasks = [
        _Task(dataset, root, recording, tuple(sorted({*frames, *manifest.samples.get(recording, ())})), chosen)
        for recording, frames in wanted.items()
    ]
    made = run_batch(
        _write_recording, tasks, workers=workers, executor=executor, label="motion labels", progress=progress
    )
    manifest.samples.update({task.recording: list(task.frames) for task in tasks})
    manifest.write(root)
    return LabelsWritten(samples=sum(map(len, wanted.values())), written=sum(made), kept=len(made) - sum(made))


class LabelFiles(Mapping[str, MotionLabels]):
    """Motion labels in a folder, by sample token; a read takes some milliseconds.

    Cheap to pickle and safe in forked workers: each process opens its own files, a few at a time.
    """

    def __init__(self, folder: str | os.PathLike[str], config: MotionLabelConfig | None = None) -> None:
        """Open a folder that `write_label_files` or `deepaccident labels` made.

        Args:
            folder: where.
            config: what the labels must show; None for whatever they do.

        Raises:
            LabelFilesError: there is no such folder, or its making was broken off.
            ConfigError: the labels are of another configuration.
        """
        self.folder = Path(folder).expanduser()
        manifest = _Manifest.read(self.folder)
        if not manifest.samples:
            raise LabelFilesError(f"{self.folder}: its making was broken off; run `deepaccident labels` on it again")
        if config is not None:
            manifest.check(self.folder, config)
        self.config = manifest.config
        self._frames = {recording: frozenset(frames) for recording, frames in manifest.samples.items()}
        self._open: OrderedDict[str, zipfile.ZipFile] = OrderedDict()
        self._process = os.getpid()

    def __getstate__(self) -> dict[str, Any]:
        """Everything but open files."""
        return {**self.__dict__, "_open": OrderedDict()}

    def __len__(self) -> int:
        """Number of samples."""
        return sum(map(len, self._frames.values()))

    def __iter__(self) -> Iterator[str]:
        """Sample tokens by scenario, agent and time."""
        for recording, frames in sorted(self._frames.items()):
            yield from (f"{recording}/{frame:03d}" for frame in sorted(frames))

    def __contains__(self, token: object) -> bool:
        """Whether a sample's labels are here."""
        recording, number = _parts(token)
        return number in self._frames.get(recording, ())

    def __getitem__(self, token: str) -> MotionLabels:
        """The labels of a sample, each frame in its own ego frame.

        Raises:
            TokenError: the sample is not here.
            LabelFilesError: its file is missing or damaged.
        """
        if token not in self:
            raise TokenError(f"{self.folder}: has no labels of {token!r}; `deepaccident labels` can add them")
        recording, number = _parts(token)
        path = _path(self.folder, recording)
        try:
            stored = StoredLabels.read(self._archive(recording), f"{number:03d}")
        except _DAMAGED as error:
            self._open.pop(recording, None)
            raise LabelFilesError(f"{path}: {error}; remove it and run `deepaccident labels` again") from error
        return stored.labels(self.config)

    def _archive(self, recording: str) -> zipfile.ZipFile:
        if self._process != os.getpid():  # a fork shares positions in open files with its parent
            self._open, self._process = OrderedDict(), os.getpid()
        if recording not in self._open:
            self._open[recording] = zipfile.ZipFile(_path(self.folder, recording))
            if len(self._open) > _OPEN_FILES:
                self._open.popitem(last=False)[1].close()
        self._open.move_to_end(recording)
        return self._open[recording]


@dataclass(frozen=True, slots=True)
class _Task:
    """One file to write."""

    dataset: Dataset
    root: Path
    recording: str
    frames: tuple[int, ...]
    config: MotionLabelConfig


def _write_recording(task: _Task) -> bool:
    """Write the labels of one scenario and agent; False if they are there already."""
    path = _path(task.root, task.recording)
    source = _source(task)
    if _source_of(path) == source:
        return False
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        write_array(archive, "source", np.array(source))
        for frame in task.frames:
            labels = motion_labels(task.dataset, f"{task.recording}/{frame:03d}", task.config)
            StoredLabels.of(labels).write(archive, f"{frame:03d}")
    return True


def _source(task: _Task) -> str:
    """A digest of all that a file's labels are made from: configuration, samples, and the scenario's rows."""
    digest = hashlib.blake2b(digest_size=16)
    digest.update(f"{FORMAT_VERSION} {task.config.digest} {task.recording} {task.frames}".encode())
    for array in _scenario_arrays(task.dataset, task.recording.rsplit("/", 1)[0]):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _scenario_arrays(dataset: Dataset, scenario: str) -> Iterator[AnyArray]:
    """What the tables hold of a scenario that labels are drawn from, of all agents."""
    row, samples = dataset.getind("scenario", scenario), dataset.columns("sample")
    first, last = samples["scenario_row"].searchsorted((row, row + 1))
    yield dataset.columns("ego_pose")["matrix"][first:last]
    used = dataset.columns("sample_data")["calibrated_sensor_row"][first * len(CHANNELS) : last * len(CHANNELS)]
    yield dataset.columns("calibrated_sensor")["matrix"][np.unique(used)]
    counts = samples["num_annotations"][first:last]
    yield counts
    if counts.any():
        start = int(samples["first_annotation_row"][first:last][counts > 0].min())
        for name in ("translation", "size", "yaw", "actor_id", "category", "num_lidar_pts", "camera_visible"):
            yield dataset.columns("annotation")[name][start : start + int(counts.sum())]


def _source_of(path: Path) -> str | None:
    """The digest that a file was made with; None if there is no whole file."""
    try:
        with zipfile.ZipFile(path) as archive:
            return str(read_array(archive, "source"))
    except _DAMAGED:
        return None


@dataclass(frozen=True, slots=True)
class _Manifest:
    """What a folder of labels says of itself: the configuration, and once it is whole, which samples it has."""

    config: MotionLabelConfig
    samples: dict[str, list[int]]

    @classmethod
    def new(cls, root: Path, config: MotionLabelConfig) -> _Manifest:
        if root.exists() and (not root.is_dir() or any(root.iterdir())):
            raise LabelFilesError(f"{root}: is not empty and holds no motion labels; choose a new folder")
        return cls(config, {})

    @classmethod
    def read(cls, root: Path) -> _Manifest:
        path = root / MANIFEST
        if not path.is_file():
            raise LabelFilesError(
                f"{root}: holds no motion labels (no {MANIFEST}); make them with `deepaccident labels`"
            )
        try:
            told = json.loads(path.read_text(encoding="utf-8"))
            if told["format"] != FORMAT or told["version"] != FORMAT_VERSION:
                raise LabelFilesError(
                    f"{path}: expected {FORMAT} of version {FORMAT_VERSION}, found {told['format']} of version "
                    f"{told['version']}; another version of the devkit made it"
                )
            samples = {
                str(recording): [int(frame) for frame in frames] for recording, frames in told["samples"].items()
            }
            return cls(MotionLabelConfig.from_dict(told["config"]), samples)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            if isinstance(error, LabelFilesError):
                raise
            raise LabelFilesError(
                f"{path}: cannot be read ({error}); make the labels anew in an empty folder"
            ) from error

    def check(self, root: Path, config: MotionLabelConfig) -> None:
        """Refuse another configuration; raises ConfigError that names what differs."""
        mine, others = (_flat(one.as_dict()) for one in (self.config, config))
        changed = sorted(name for name in {*mine, *others} if mine.get(name) != others.get(name))
        if changed:
            told = "; ".join(f"{name}: {mine.get(name)!r}, asked for {others.get(name)!r}" for name in changed)
            raise ConfigError(f"{root}: holds labels of another configuration ({told}); choose another folder")

    def write(self, root: Path) -> None:
        told = {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "config_digest": self.config.digest,
            "config": self.config.as_dict(),
            "samples": dict(sorted(self.samples.items())),
        }
        lists_in_a_line = re.sub(r"\[[^][{}]*\]", lambda found: " ".join(found[0].split()), json.dumps(told, indent=1))
        write_bytes(root / MANIFEST, f"{lists_in_a_line}\n".encode())


def _flat(described: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration's description with the switches of its protocol beside the other settings."""
    return {**described, **described["protocol"], "protocol": None}


def _by_recording(dataset: Dataset, tokens: Iterable[RowArgument]) -> dict[str, list[int]]:
    """Scenario and agent → frame numbers, each once, ascending."""
    found: dict[str, set[int]] = {}
    for token in tokens:
        recording, number = _parts(dataset.get("sample", token)["token"])
        found.setdefault(recording, set()).add(number)
    return {recording: sorted(frames) for recording, frames in sorted(found.items())}


def _parts(token: object) -> tuple[str, int]:
    recording, _, number = str(token).rpartition("/")
    return recording, int(number) if number.isdecimal() else 0


def _path(root: Path, recording: str) -> Path:
    return root / f"{recording}.npz"
