"""Motion labels of many samples in a folder: one npz file for each scenario and agent.

Labels are read sample by sample; schema/motion_labels.md describes the files. Maps that follow from
instance maps are not stored: segmentation, centerness and offset are derived from the instances'
centres, flow from one vector for each instance. Training loops without the devkit can use another
form: a plain npz file for each sample, with all maps as another code's loader returns them.
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
from typing import TYPE_CHECKING, Any, Final, get_args

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
from deepaccident_devkit.support.text import choice, counted
from deepaccident_devkit.tables.tokens import parse_number
from deepaccident_devkit.taxonomy import AGENTS, CHANNELS, LIDAR
from deepaccident_devkit.v2x import cooperating_agents

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.dataset import Dataset, RowArgument
    from deepaccident_devkit.support.parallel import Engine

_MAX_OPEN_FILES: Final = 8


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
    folder: str | os.PathLike[str],
    tokens: Iterable[RowArgument],
    config: MotionLabelConfig | str | None = None,
    *,
    names: BatchNames | None = None,
    **engine: Unpack[Engine],
) -> LabelsWritten:
    """Write the motion labels of samples into a folder, one file for each scenario and agent.

    Files are complete or absent. If a call is interrupted, the same call continues it; several
    processes that make the same call share the scenarios. Samples can be added later; files are
    written again if the release has changed in the meantime.

    Args:
        dataset: The release.
        folder: Output folder, created if it does not exist; it may hold labels of the same
            configuration.
        tokens: Tokens or records of labelled samples.
        config: Configuration of the labels, or the name of a preset; None for the released labels
            in the devkit's orientation.
        names: Code to write batches for. `fiery`, `beverse` or `deepaccident` writes
            `MotionLabels.as_batch(names)` of each sample into a file of its own, about 0.1 MB, for
            loops that use only numpy; None writes files for `LabelFiles`, which are 25 times
            smaller.
        **engine: `workers`, `executor` and `progress`, see `parallel.Engine`.

    Raises:
        ConfigError: The folder holds labels of another configuration, or with other names; it is
            not changed.
        LabelFilesError: The folder holds something else, its manifest cannot be read, or it cannot
            be written to.
        OutputFolderError: A link in the folder leads out of it; nothing is written there.
        TokenError: No such sample.
        ChoiceError: No sample at all, or no such agent, configuration of agents, or code.
        NotAvailableError: A sample has no label, or an agent with a view that counts is not in this
            (partial) release.
        SomeFailedError: Labels of some samples cannot be made; the others are written, and the same
            call continues.
    """
    root = folder_path(folder)
    label_config = resolved_label_config(config)
    names = choice("names", names, (*get_args(BatchNames), None))
    requested = _by_recording(dataset, tokens)
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
            all_frames = _with_stored_frames(dataset, root, recording, frames, manifest)
            tasks[recording] = (recording, all_frames)
        results = store.run(
            _LabelWriter(dataset, root, manifest.config, names).write,
            tasks,
            label="motion labels",
            places=Places(reads=dataset.places, writes=(root,)),
            **engine,
        )
        if turn.alone():
            manifest = LabelManifest.of(root, label_config, names)
            for recording, all_frames in tasks.values():
                manifest.samples[recording] = list(all_frames)
            manifest.write(root)
            store.remove()
    is_new = [new for recording_files in results.values() for new in recording_files]
    num_samples = sum(map(len, requested.values()))
    num_written = sum(is_new)
    return LabelsWritten(samples=num_samples, written=num_written, kept=len(is_new) - num_written)


class LabelFiles(Mapping[str, MotionLabels]):
    """Motion labels in a folder, by sample token; a read takes a few milliseconds.

    Cheap to pickle, and safe in threads and in forked workers: each process opens its own files, a
    few at a time. Labels that are added to the folder later appear when it is opened again.
    """

    def __init__(
        self, folder: str | os.PathLike[str], config: MotionLabelConfig | str | None = None
    ) -> None:
        """Open a folder that `write_label_files` or `deepaccident labels` has written.

        Args:
            folder: Path of the folder.
            config: Configuration that the labels must have, or the name of a preset; None for any.

        Raises:
            LabelFilesError: There is no such folder, its labels are not complete or are another
                code's batches, or its manifest cannot be read.
            ConfigError: The labels have another configuration.
        """
        self.folder = folder_path(folder)
        manifest = LabelManifest.read(self.folder)
        if manifest.names is not None:
            raise LabelFilesError(
                f"{self.folder}: holds batches of {manifest.names}, which np.load opens "
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

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without open files."""
        return {**self.__dict__, "_open": OrderedDict()}

    # The comparison of mappings would read all files.
    __eq__, __hash__ = object.__eq__, object.__hash__

    def __repr__(self) -> str:
        return f"<motion labels: {counted(len(self), 'sample')} in {self.folder}>"

    def __len__(self) -> int:
        """Return the number of samples."""
        return sum(map(len, self._frames.values()))

    def __iter__(self) -> Iterator[str]:
        """Yield sample tokens by scenario, agent and time."""
        for recording, frames in self._frames.items():
            yield from (f"{recording}/{frame:03d}" for frame in sorted(frames))

    def __contains__(self, token: object) -> bool:
        """Return whether the folder holds a sample's labels."""
        recording, number = _token_parts(token)
        return number in self._frames.get(recording, ())

    def __getitem__(self, token: str) -> MotionLabels:
        """Return the labels of a sample, each frame in its own ego frame.

        Raises:
            TokenError: The folder does not hold the sample.
            LabelFilesError: The file is missing, damaged or of another configuration.
        """
        if token not in self:
            raise TokenError(
                f"{self.folder}: has no labels of {token!r}; `deepaccident labels` can add them"
            )
        recording, number = _token_parts(token)
        try:
            stored = StoredLabels.read(self._archive(recording), f"{number:03d}")
            return stored.labels(self.config)
        except DAMAGED_ARCHIVE as error:
            self._open.pop(recording, None)
            path = label_path(self.folder, recording)
            raise LabelFilesError(
                f"{path}: {error}; remove it and run `deepaccident labels` again"
            ) from error

    def _archive(self, recording: str) -> zipfile.ZipFile:
        """Return the open file of a scenario and agent.

        Threads may share it, so that the garbage collector closes files that are no longer used.
        """
        if self._process != os.getpid():  # a fork shares positions in open files with its parent
            self._open, self._process = OrderedDict(), os.getpid()
        archive = self._open.get(recording)
        if archive is None:
            archive = open_zip(label_path(self.folder, recording))
            if read_array(archive, "config", "motion_labels").item() != self._digest:
                raise ValueError("holds labels of another configuration")
            self._open[recording] = archive
            while len(self._open) > _MAX_OPEN_FILES:
                self._open.popitem(last=False)
        with suppress(KeyError):
            self._open.move_to_end(recording)
        return archive


@dataclass(frozen=True, slots=True)
class _LabelWriter:
    """The work of a worker; cheap to pickle."""

    dataset: Dataset
    root: Path
    config: MotionLabelConfig
    names: BatchNames | None

    def write(self, task: tuple[str, tuple[int, ...]]) -> list[bool]:
        """Write the files of one scenario and agent.

        Args:
            task: Scenario and agent, and the numbers of the frames to write.

        Returns:
            Whether each file was written now; the others already had the same content.
        """
        recording, frames = task
        source = self._source(recording, frames)
        if self.names is None:
            frames_by_path = {label_path(self.root, recording): frames}
        else:
            frames_by_path = {batch_path(self.root, recording, frame): (frame,) for frame in frames}
        stale = {}
        for path, file_frames in frames_by_path.items():
            if _source_of(path, self.names) != source:
                stale[path] = file_frames
        tokens = []
        for file_frames in stale.values():
            tokens += [f"{recording}/{frame:03d}" for frame in file_frames]
        labels = motion_labels_of(self.dataset, tokens, self.config)
        for path, file_frames in stale.items():
            self._write_file(path, file_frames, source, labels)
        return [path in stale for path in frames_by_path]

    def _write_file(
        self,
        path: Path,
        frames: tuple[int, ...],
        source: str,
        upcoming_labels: Iterator[MotionLabels],
    ) -> None:
        """Write one file from the next labels.

        A batch has only its code's arrays; its source is the comment of the zip file.
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

    def _source(self, recording: str, frames: tuple[int, ...]) -> str:
        """Return a digest of everything that files depend on.

        This is the configuration, the samples or names, and the scenario's rows.
        """
        digest = hashlib.blake2b(digest_size=16)
        # A batch does not depend on the other samples of its recording.
        content = frames if self.names is None else self.names
        digest.update(f"{LABEL_FORMAT_VERSION} {self.config.digest} {recording} {content}".encode())
        for array in _scenario_arrays(self.dataset, recording.rsplit("/", 1)[0]):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


def _scenario_arrays(dataset: Dataset, scenario: str) -> Iterator[AnyArray]:
    """Yield the columns of the tables that a scenario's labels depend on, of all agents."""
    dataset = dataset.with_ignored
    row = dataset.getind("scenario", scenario)
    samples = dataset.columns("sample")
    first, last = samples["scenario_row"].searchsorted((row, row + 1))
    yield dataset.columns("ego_pose")["matrix"][first:last]
    lidars = slice(
        first * len(CHANNELS) + CHANNELS.index(LIDAR), last * len(CHANNELS), len(CHANNELS)
    )
    yield dataset.columns("sample_data")["matrix"][lidars]
    yield samples["agent"][first:last]
    counts = samples["num_annotations"][first:last]
    yield counts
    if counts.any():
        start = int(samples["first_annotation_row"][first:last][counts > 0].min())
        for name in (
            "translation",
            "size",
            "yaw",
            "actor_id",
            "category",
            "num_lidar_pts",
            "camera_visible",
        ):
            yield dataset.columns("annotation")[name][start : start + int(counts.sum())]


def _source_of(path: Path, names: BatchNames | None) -> str | None:
    """Return the digest that a file was made with; None if there is no complete file."""
    try:
        with open_zip(path) as archive:
            if names is not None:
                return archive.comment.decode("ascii", "replace")
            return str(read_array(archive, "source", "motion_labels"))
    except DAMAGED_ARCHIVE:
        return None


def _by_recording(dataset: Dataset, tokens: Iterable[RowArgument]) -> dict[str, list[int]]:
    """Return scenario and agent → frame numbers, unique and ascending."""
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
        recording, number = _token_parts(token)
        frames.setdefault(recording, set()).add(number)
    if not frames:
        raise ChoiceError("tokens: expected at least one sample, found none")
    return {recording: sorted(frames[recording]) for recording in sorted(frames, key=_table_order)}


def _check_agents(
    dataset: Dataset, requested: Mapping[str, list[int]], config: MotionLabelConfig
) -> None:
    """Raise NotAvailableError or ChoiceError now, and not later in a worker."""
    if config.filter_invisible and config.agents is not None:
        for recording, frames in requested.items():
            cooperating_agents(dataset, f"{recording}/{frames[0]:03d}", config.agents)


def _with_stored_frames(
    dataset: Dataset, root: Path, recording: str, frames: list[int], manifest: LabelManifest
) -> tuple[int, ...]:
    """Return the frames that a file should have: the requested and the stored ones.

    Raises LabelFilesError if the release no longer has a stored frame.
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


def _token_parts(token: object) -> tuple[str, int]:
    """Return a sample token's scenario and agent, and its frame number; 0 for other texts."""
    recording, _, number = str(token).rpartition("/")
    return recording, parse_number(number, 3) or 0
