"""Motion labels of many samples in a folder: one npz file for each scenario and agent.

Labels are read sample by sample; schema/motion_labels.md describes the files. Maps that can be
derived from instance maps are not stored: segmentation, centerness and offset are computed from the
instances' cells and centres, and flow from one vector per instance. Training loops without the
devkit can use another format: a plain npz file for each sample, with all maps as another code
base's loader returns them.
"""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np

from deepaccident_devkit.errors import ChoiceError, LabelFilesError, NotAvailableError, TokenError
from deepaccident_devkit.motion.batch_names import BatchNames
from deepaccident_devkit.motion.config import MotionLabelConfig, resolved_label_config
from deepaccident_devkit.motion.label_folder import (
    LABEL_FORMAT_VERSION,
    MANIFEST,
    LabelManifest,
    StoredLabels,
    batch_path,
    folder_path,
    label_path,
    label_store,
    remove_half_written,
    write_array,
)
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.sample_labels import motion_labels_of
from deepaccident_devkit.release.fingerprints import digest_of
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.files import place_in, replacing
from deepaccident_devkit.support.parallel import Places
from deepaccident_devkit.support.reading import DAMAGED_ARCHIVE, open_zip, read_array
from deepaccident_devkit.support.text import PathType, choice, counted
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.tables.tokens import parse_number
from deepaccident_devkit.taxonomy import AGENTS, CHANNELS, LIDAR
from deepaccident_devkit.v2x import cooperating_agents

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.dataset import Dataset, RowArgument
    from deepaccident_devkit.support.parallel import Engine

_MAX_OPEN_FILES = 8
# Columns of annotations that labels depend on.
_SOURCE_COLUMNS = (
    "translation",
    "size",
    "yaw",
    "actor_id",
    "category",
    "num_lidar_pts",
    "camera_visible",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelsWritten:
    """Result of `write_label_files`.

    Attributes:
        samples: Number of the requested samples that the folder now holds.
        written: Number of files written.
        kept: Number of files that already existed with the same content.
    """

    samples: int
    written: int
    kept: int


def write_label_files(
    dataset: Dataset,
    folder: PathType,
    tokens: Iterable[RowArgument],
    config: MotionLabelConfig | str | None = None,
    *,
    names: BatchNames | None = None,
    **engine: Unpack[Engine],
) -> LabelsWritten:
    """Write the motion labels of samples into a folder, one file for each scenario and agent.

    A file is either complete or absent. To continue an interrupted call, repeat it; several
    processes that make the same call share the scenarios. Samples can be added later; files are
    rewritten if the release has changed in the meantime.

    Args:
        dataset: The release.
        folder: Output folder, created if it does not exist; it may hold labels of the same
            configuration.
        tokens: Tokens or records of labelled samples.
        config: Configuration of the labels, or the name of a preset; None for the released labels
            in the devkit's orientation.
        names: Code base to write batches for. With `fiery`, `beverse` or `deepaccident`,
            `MotionLabels.as_batch(names)` of each sample is written to a separate file of about 0.1
            MB, for training loops that use only numpy. With None, the files are for `LabelFiles`,
            and are 25 times smaller.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        ConfigError: The folder contains labels with other settings, or batches with other names;
            it is not changed.
        LabelFilesError: The folder holds something other than labels, its manifest cannot be read,
            or it cannot be written to.
        OutputFolderError: A link in the folder points outside it; nothing is written there.
        TokenError: There is no such sample.
        ChoiceError: `tokens` is empty, or there is no such agent, configuration of agents, or
            code base.
        NotAvailableError: A sample has no label, or an agent whose view counts is missing from this
            (partial) release.
        SomeFailedError: The labels of some samples cannot be made. All others are written, and a
            repeated call tries only the missing ones.
    """
    root = folder_path(folder)
    label_config = resolved_label_config(config)
    names = choice("names", names, (*get_args(BatchNames), None))
    requested = _group_by_recording(dataset, tokens)
    _check_agents(dataset, requested, label_config)
    LabelManifest.of(root, label_config, names)
    command = {"config": label_config.digest, "names": names, "samples": requested}
    store = label_store(root, digest_of(command))
    with store.shared(tidy=partial(remove_half_written, root)) as turn:
        manifest = LabelManifest.of(root, label_config, names)
        if not (root / MANIFEST).exists():
            manifest.write(root)
        tasks = {}
        for recording, frames in requested.items():
            all_frames = _add_stored_frames(dataset, root, recording, frames, manifest)
            tasks[recording] = (recording, all_frames)
        writer = _LabelWriter(dataset, root, manifest.config, names)
        results = store.run(
            writer.write,
            tasks,
            label="Writing motion labels",
            places=Places(reads=dataset.places, writes=(root,)),
            **engine,
        )
        if turn.alone():
            manifest = LabelManifest.of(root, label_config, names)
            for recording, all_frames in tasks.values():
                manifest.samples[recording] = list(all_frames)
            manifest.write(root)
            store.remove()
    num_samples = sum(map(len, requested.values()))
    num_files = sum(map(len, results.values()))
    num_written = sum(map(sum, results.values()))
    return LabelsWritten(samples=num_samples, written=num_written, kept=num_files - num_written)


class LabelFiles(Mapping[str, MotionLabels]):
    """Motion labels in a folder, by sample token; reading a sample takes a few milliseconds.

    The mapping is cheap to pickle, and safe to use from threads and forked workers: each process
    opens its own files, a few at a time. Labels that are added to the folder later become visible
    when the folder is opened again.
    """

    def __init__(self, folder: PathType, config: MotionLabelConfig | str | None = None) -> None:
        """Open a folder that `write_label_files` or `deepaccident labels` has written.

        Args:
            folder: Path of the folder.
            config: Configuration that the labels must have, or the name of a preset; None accepts
                any.

        Raises:
            LabelFilesError: There is no such folder, its labels are incomplete or are batches for
                another code base, or its manifest cannot be read.
            ConfigError: The labels have another configuration.
        """
        self.folder = folder_path(folder)
        manifest = LabelManifest.read(self.folder)
        if manifest.names is not None:
            raise LabelFilesError(
                f"{self.folder}: contains batches of {manifest.names}, which np.load opens "
                "(schema/motion_labels.md); for LabelFiles run `deepaccident labels` without "
                "--names on another folder"
            )
        if config is not None:
            manifest.check(self.folder, resolved_label_config(config))
        if not manifest.samples:
            raise LabelFilesError(
                f"{self.folder}: its labels are not complete; run `deepaccident labels` on it again"
            )
        self.config = manifest.config
        self._digest = manifest.config.digest
        self._frames: dict[str, frozenset[int]] = {}
        for recording in sorted(manifest.samples, key=_table_order):
            self._frames[recording] = frozenset(manifest.samples[recording])
        self._open: OrderedDict[str, zipfile.ZipFile] = OrderedDict()
        self._process = os.getpid()

    def __getstate__(self) -> NamedValues:
        """Return the state without open files."""
        return {**self.__dict__, "_open": OrderedDict()}

    # Comparing mappings would read all files.
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def __repr__(self) -> str:
        sample_count = counted(len(self), "sample")
        return f"<motion labels: {sample_count} in {self.folder}>"

    def __len__(self) -> int:
        """Return the number of samples."""
        return sum(map(len, self._frames.values()))

    def __iter__(self) -> Iterator[str]:
        """Yield sample tokens by scenario, agent and time."""
        for recording, frames in self._frames.items():
            for frame in sorted(frames):
                yield f"{recording}/{frame:03d}"

    def __contains__(self, token: object) -> bool:
        """Return whether the folder holds a sample's labels."""
        recording, frame = _split_token(token)
        frames = self._frames.get(recording, ())
        return frame in frames

    def __getitem__(self, token: str) -> MotionLabels:
        """Return the labels of a sample, each frame in its own ego frame.

        Raises:
            TokenError: The folder does not hold the sample.
            LabelFilesError: The file is missing, is damaged, or has another configuration.
        """
        if token not in self:
            raise TokenError(
                f"{self.folder}: has no labels of {token!r}; `deepaccident labels` can add them"
            )
        recording, frame = _split_token(token)
        try:
            archive = self._open_archive(recording)
            stored = StoredLabels.read(archive, f"{frame:03d}")
            return stored.labels(self.config)
        except DAMAGED_ARCHIVE as error:
            self._open.pop(recording, None)
            path = label_path(self.folder, recording)
            raise LabelFilesError(
                f"{path}: {error}; remove it and run `deepaccident labels` again"
            ) from error

    def _open_archive(self, recording: str) -> zipfile.ZipFile:
        """Return the open file of a scenario and agent.

        Several threads may share it; the garbage collector closes files that are no longer used.
        """
        if self._process != os.getpid():  # a forked process shares file positions with its parent
            self._open = OrderedDict()
            self._process = os.getpid()
        archive = self._open.get(recording)
        if archive is None:
            archive = open_zip(label_path(self.folder, recording))
            if read_array(archive, "config", "motion_labels").item() != self._digest:
                raise ValueError("contains labels with other settings")
            self._open[recording] = archive
            while len(self._open) > _MAX_OPEN_FILES:
                self._open.popitem(last=False)
        with suppress(KeyError):
            self._open.move_to_end(recording)
        return archive


@dataclass(frozen=True, slots=True)
class _LabelWriter:
    """Writer of a folder's label files; it is sent to workers, so it is cheap to pickle."""

    dataset: Dataset
    root: Path
    config: MotionLabelConfig
    names: BatchNames | None

    def write(self, task: tuple[str, tuple[int, ...]]) -> list[bool]:
        """Write the files of one scenario and agent.

        Args:
            task: Scenario and agent, and the frame numbers to write.

        Returns:
            Whether each file was written by this call; the others already had the same content.
        """
        recording, frames = task
        source = self._compute_source(recording, frames)
        frames_by_path = {}
        if self.names is None:
            frames_by_path[label_path(self.root, recording)] = frames
        else:
            for frame in frames:
                frames_by_path[batch_path(self.root, recording, frame)] = (frame,)
        stale_files = {}
        tokens = []
        for path, file_frames in frames_by_path.items():
            if _read_source(path, self.names) != source:
                stale_files[path] = file_frames
                tokens += [f"{recording}/{frame:03d}" for frame in file_frames]
        labels = motion_labels_of(self.dataset, tokens, self.config)
        for path, file_frames in stale_files.items():
            self._write_file(path, file_frames, source, labels)
        return [path in stale_files for path in frames_by_path]

    def _write_file(
        self,
        path: Path,
        frames: tuple[int, ...],
        source: str,
        upcoming_labels: Iterator[MotionLabels],
    ) -> None:
        """Write one file from the next labels.

        A batch contains only its code base's arrays; its source digest is the comment of the zip
        file.
        """
        target = place_in(self.root, path.relative_to(self.root))
        with replacing(target) as temporary, zipfile.ZipFile(temporary, "w") as archive:
            if self.names is None:
                write_array(archive, "config", np.array(self.config.digest))
                write_array(archive, "source", np.array(source))
            else:
                archive.comment = source.encode()
            # Not strict: the labels after these frames belong to the next files.
            for frame, labels in zip(frames, upcoming_labels, strict=False):
                if self.names is None:
                    StoredLabels.of(labels).write(archive, f"{frame:03d}")
                else:
                    for name, array in labels.as_batch(self.names).items():
                        write_array(archive, name, array)

    def _compute_source(self, recording: str, frames: tuple[int, ...]) -> str:
        """Return a digest of everything that the files of a recording depend on.

        These are the configuration, the frames, the names and the scenario's table rows.
        """
        digest = hashlib.blake2b(digest_size=16)
        # A batch does not depend on the other samples of its recording.
        content = frames if self.names is None else self.names
        settings = f"{LABEL_FORMAT_VERSION} {self.config.digest} {recording} {content}"
        digest.update(settings.encode())
        scenario, _ = recording.rsplit("/", 1)
        for array in _read_scenario_arrays(self.dataset, scenario):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


def _read_scenario_arrays(dataset: Dataset, scenario: str) -> Iterator[AnyArray]:
    """Yield the parts of the table columns that a scenario's labels depend on, for all agents."""
    dataset = dataset.with_ignored
    row = dataset.getind("scenario", scenario)
    samples = dataset.columns("sample")
    first, last = samples["scenario_row"].searchsorted((row, row + 1))
    yield dataset.columns("ego_pose")["matrix"][first:last]
    num_channels = len(CHANNELS)
    first_lidar = first * num_channels + CHANNELS.index(LIDAR)
    lidars = slice(first_lidar, last * num_channels, num_channels)
    yield dataset.columns("sample_data")["matrix"][lidars]
    yield samples["agent"][first:last]
    counts = samples["num_annotations"][first:last]
    yield counts
    if counts.any():
        annotation_rows = samples["first_annotation_row"][first:last]
        start = int(annotation_rows[counts > 0].min())
        end = start + int(counts.sum())
        annotations = dataset.columns("annotation")
        for name in _SOURCE_COLUMNS:
            yield annotations[name][start:end]


def _read_source(path: Path, names: BatchNames | None) -> str | None:
    """Return the source digest stored in a file; None if there is no complete file."""
    try:
        with open_zip(path) as archive:
            if names is not None:
                return archive.comment.decode("ascii", "replace")
            return str(read_array(archive, "source", "motion_labels"))
    except DAMAGED_ARCHIVE:
        return None


def _group_by_recording(dataset: Dataset, tokens: Iterable[RowArgument]) -> dict[str, list[int]]:
    """Return the samples as scenario and agent → frame numbers, unique and ascending."""
    if isinstance(tokens, str | Mapping):
        raise ChoiceError(
            f"tokens: expected samples' tokens or records, found {tokens!r}; put it into a list"
        )
    frames: dict[str, set[int]] = {}
    labelled = dataset.columns("sample")["labelled"]
    for sample in tokens:
        row = dataset.getind("sample", sample)
        token = sample if isinstance(sample, str) else sample["token"]
        if not labelled[row]:
            raise NotAvailableError(f"{token} has no label (the test split has none)")
        recording, frame = _split_token(token)
        frames.setdefault(recording, set()).add(frame)
    if not frames:
        raise ChoiceError("tokens: expected at least one sample, found none")
    return {recording: sorted(frames[recording]) for recording in sorted(frames, key=_table_order)}


def _check_agents(
    dataset: Dataset, requested: Mapping[str, list[int]], config: MotionLabelConfig
) -> None:
    """Check the cooperating agents of all samples before any work starts.

    Raise NotAvailableError if the release lacks one, and ChoiceError if there is no such agent.
    """
    if config.filter_invisible and config.agents is not None:
        for recording, frames in requested.items():
            cooperating_agents(dataset, f"{recording}/{frames[0]:03d}", config.agents)


def _add_stored_frames(
    dataset: Dataset, root: Path, recording: str, frames: list[int], manifest: LabelManifest
) -> tuple[int, ...]:
    """Return the frames that a file should contain: the requested and the stored ones.

    Raise LabelFilesError if the release no longer has a stored frame.
    """
    stored_frames = manifest.samples.get(recording, [])
    try:
        for frame in stored_frames:
            dataset.getind("sample", f"{recording}/{frame:03d}")
    except TokenError as error:
        raise LabelFilesError(
            f"{root}: {recording} has frames that are not in {dataset.dataroot} any more "
            f"({error}); choose another folder"
        ) from error
    return tuple(sorted({*frames, *stored_frames}))


def _table_order(recording: str) -> tuple[str, int]:
    """Return the sort key of a scenario and agent, for the order of the tables."""
    scenario, agent = recording.rsplit("/", 1)
    return scenario, AGENTS.index(agent)


def _split_token(token: object) -> tuple[str, int]:
    """Split a sample token into scenario and agent, and frame number; other text gives frame 0."""
    recording, _, number = str(token).rpartition("/")
    return recording, parse_number(number, 3) or 0
