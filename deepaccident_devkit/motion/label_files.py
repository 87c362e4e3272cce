"""Motion labels of many samples in one folder: one npz file for each scenario and agent, read sample by sample.

schema/motion_labels.md describes the files. Maps that follow from instance maps are not stored: segmentation,
centerness and offset are made from the instances' centres, flow from one vector for each instance. For loops without
the devkit there is another form: all maps of a sample as another code's loader gives them, one plain npz file each.
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

_OPEN_FILES: Final = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelsWritten:
    """What `write_label_files` did.

    Attributes:
        samples: how many of the requested samples the folder now holds.
        written: files made.
        kept: files that were there already and hold the same.
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
    **how: Unpack[Engine],
) -> LabelsWritten:
    """Write the motion labels of samples into a folder, one file for each scenario and agent.

    Files are complete or absent. If a call is interrupted, the same call continues it; several processes that make the
    same call share the scenarios. Samples can be added later; files are written again if the release has changed in the
    meantime.

    Args:
        dataset: the release.
        folder: made where needed; or one with labels of the same configuration.
        tokens: tokens or records of labelled samples.
        config: what labels show, or the name of a preset; None for the released ones in the devkit's orientation.
        names: `fiery`, `beverse` or `deepaccident` writes `MotionLabels.as_batch(names)` of each sample into a file of
            its own, some 0.1 MB, for loops with numpy alone; None writes files for `LabelFiles`, 25 times smaller.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        ConfigError: the folder holds labels of another configuration, or with other names; it is left as it is.
        LabelFilesError: the folder holds something else, its manifest cannot be read, or it cannot be written to.
        OutputFolderError: a link in the folder leads out of it; nothing is written there.
        TokenError: no such sample.
        ChoiceError: no sample at all, or no such agent, configuration of agents, or code.
        NotAvailableError: a sample has no label, or an agent whose sight counts is not in this (partial) release.
        SomeFailedError: labels of some samples cannot be made; the others are written, and the same call continues.
    """
    root, chosen = folder_path(folder), resolved_label_config(config)
    names = choice("names", names, (*get_args(BatchNames), None))
    wanted = _by_recording(dataset, tokens)
    _check_agents(dataset, wanted, chosen)
    LabelManifest.of(root, chosen, names)
    store = label_store(
        root, digest_of({"config": chosen.digest, "names": names, "samples": wanted})
    )
    with store.shared(tidy=partial(remove_half_written, root)) as turn:
        manifest = LabelManifest.of(root, chosen, names)
        if not (root / MANIFEST).exists():
            manifest.write(root)
        files = {
            recording: _with_kept(dataset, root, recording, frames, manifest)
            for recording, frames in wanted.items()
        }
        made = store.run(
            _Work(dataset, root, manifest.config, names).write,
            {recording: (recording, frames) for recording, frames in files.items()},
            label="motion labels",
            places=Places(reads=dataset.places, writes=(root,)),
            **how,
        )
        if turn.alone():
            manifest = LabelManifest.of(root, chosen, names)
            manifest.samples.update(
                {recording: list(frames) for recording, frames in files.items()}
            )
            manifest.write(root)
            store.remove()
    each = [new for files_made in made.values() for new in files_made]
    return LabelsWritten(
        samples=sum(map(len, wanted.values())), written=sum(each), kept=len(each) - sum(each)
    )


class LabelFiles(Mapping[str, MotionLabels]):
    """Motion labels in a folder, by sample token; a read takes some milliseconds.

    Cheap to pickle, and safe in threads and in forked workers: each process opens its own files, a few at a time. What
    is added to the folder later is seen when it is opened again.
    """

    def __init__(
        self, folder: str | os.PathLike[str], config: MotionLabelConfig | str | None = None
    ) -> None:
        """Open a folder that `write_label_files` or `deepaccident labels` made.

        Args:
            folder: its path.
            config: what the labels must show, or the name of a preset; None for any.

        Raises:
            LabelFilesError: there is no such folder, its labels are not complete or are another code's batches, or its
                manifest cannot be read.
            ConfigError: the labels are of another configuration.
        """
        self.folder = folder_path(folder)
        manifest = LabelManifest.read(self.folder)
        if manifest.names is not None:
            raise LabelFilesError(
                f"{self.folder}: holds batches of {manifest.names}, which np.load opens (schema/motion_labels.md); for "
                "LabelFiles run `deepaccident labels` without --names on another folder"
            )
        if config is not None:
            manifest.check(self.folder, resolved_label_config(config))
        if not manifest.samples:
            raise LabelFilesError(
                f"{self.folder}: its labels are not complete; run `deepaccident labels` on it again"
            )
        self.config = manifest.config
        self._digest = manifest.config.digest
        self._frames = {
            recording: frozenset(manifest.samples[recording])
            for recording in sorted(manifest.samples, key=_order)
        }
        self._open: OrderedDict[str, zipfile.ZipFile] = OrderedDict()
        self._process = os.getpid()

    def __getstate__(self) -> dict[str, Any]:
        """Everything except open files."""
        return {**self.__dict__, "_open": OrderedDict()}

    __eq__, __hash__ = object.__eq__, object.__hash__  # those of a mapping would read all files

    def __repr__(self) -> str:
        return f"<motion labels: {counted(len(self), 'sample')} in {self.folder}>"

    def __len__(self) -> int:
        """Number of samples."""
        return sum(map(len, self._frames.values()))

    def __iter__(self) -> Iterator[str]:
        """Sample tokens by scenario, agent and time."""
        for recording, frames in self._frames.items():
            yield from (f"{recording}/{frame:03d}" for frame in sorted(frames))

    def __contains__(self, token: object) -> bool:
        """Whether a sample's labels are here."""
        recording, number = _parts(token)
        return number in self._frames.get(recording, ())

    def __getitem__(self, token: str) -> MotionLabels:
        """The labels of a sample, each frame in its own ego frame.

        Raises:
            TokenError: the sample is not here.
            LabelFilesError: its file is missing, damaged or of another configuration.
        """
        if token not in self:
            raise TokenError(
                f"{self.folder}: has no labels of {token!r}; `deepaccident labels` can add them"
            )
        recording, number = _parts(token)
        try:
            return StoredLabels.read(self._archive(recording), f"{number:03d}").labels(self.config)
        except DAMAGED_ARCHIVE as error:
            self._open.pop(recording, None)
            path = label_path(self.folder, recording)
            raise LabelFilesError(
                f"{path}: {error}; remove it and run `deepaccident labels` again"
            ) from error

    def _archive(self, recording: str) -> zipfile.ZipFile:
        """The open file of a scenario and agent; threads may share it, so the garbage collector closes dropped ones."""
        if self._process != os.getpid():  # a fork shares positions in open files with its parent
            self._open, self._process = OrderedDict(), os.getpid()
        archive = self._open.get(recording)
        if archive is None:
            archive = open_zip(label_path(self.folder, recording))
            if read_array(archive, "config", "motion_labels").item() != self._digest:
                raise ValueError("holds labels of another configuration")
            self._open[recording] = archive
            while len(self._open) > _OPEN_FILES:
                self._open.popitem(last=False)
        with suppress(KeyError):
            self._open.move_to_end(recording)
        return archive


@dataclass(frozen=True, slots=True)
class _Work:
    """What workers do; cheap to pickle."""

    dataset: Dataset
    root: Path
    config: MotionLabelConfig
    names: BatchNames | None

    def write(self, task: tuple[str, tuple[int, ...]]) -> list[bool]:
        """Write the files of one scenario and agent, with labels of these frames; whether each was written now."""
        recording, frames = task
        source = self._source(recording, frames)
        paths = (
            {label_path(self.root, recording): frames}
            if self.names is None
            else {batch_path(self.root, recording, frame): (frame,) for frame in frames}
        )
        new = {path: each for path, each in paths.items() if _source_of(path, self.names) != source}
        tokens = [f"{recording}/{frame:03d}" for each in new.values() for frame in each]
        labels = motion_labels_of(self.dataset, tokens, self.config)
        for path, each in new.items():
            self._write_file(path, each, source, labels)
        return [path in new for path in paths]

    def _write_file(
        self, path: Path, frames: tuple[int, ...], source: str, of_frames: Iterator[MotionLabels]
    ) -> None:
        """Write one file of the next labels; a batch has its code's arrays alone, its source is the zip's comment."""
        place = place_in(self.root, path.relative_to(self.root))
        with replacing(place) as temporary, zipfile.ZipFile(temporary, "w") as archive:
            if self.names is None:
                write_array(archive, "config", np.array(self.config.digest))
                write_array(archive, "source", np.array(source))
            else:
                archive.comment = source.encode()
            for frame, labels in zip(
                frames, of_frames, strict=False
            ):  # the others are of the files after it
                if self.names is None:
                    StoredLabels.of(labels).write(archive, f"{frame:03d}")
                else:
                    for name, array in labels.as_batch(self.names).items():
                        write_array(archive, name, array)

    def _source(self, recording: str, frames: tuple[int, ...]) -> str:
        """A digest of all that files are made from: configuration, samples or names, and the scenario's rows."""
        digest = hashlib.blake2b(digest_size=16)
        what = (
            frames if self.names is None else self.names
        )  # a batch does not depend on the samples beside it
        digest.update(f"{LABEL_FORMAT_VERSION} {self.config.digest} {recording} {what}".encode())
        for array in _scenario_arrays(self.dataset, recording.rsplit("/", 1)[0]):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


def _scenario_arrays(dataset: Dataset, scenario: str) -> Iterator[AnyArray]:
    """The columns of the tables that a scenario's labels are made from, of all agents."""
    dataset = dataset.with_ignored
    row, samples = dataset.getind("scenario", scenario), dataset.columns("sample")
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
    """The digest that a file was made with; None if there is no whole file."""
    try:
        with open_zip(path) as archive:
            if names is not None:
                return archive.comment.decode("ascii", "replace")
            return str(read_array(archive, "source", "motion_labels"))
    except DAMAGED_ARCHIVE:
        return None


def _by_recording(dataset: Dataset, tokens: Iterable[RowArgument]) -> dict[str, list[int]]:
    """Scenario and agent → frame numbers, each once, ascending."""
    if isinstance(tokens, str | Mapping):
        raise ChoiceError(
            f"tokens: expected samples' tokens or records, found {tokens!r}; put it into a list"
        )
    found: dict[str, set[int]] = {}
    labelled = dataset.columns("sample")["labelled"]
    for given in tokens:
        row = dataset.getind("sample", given)
        token = given if isinstance(given, str) else given["token"]
        if not labelled[row]:
            raise NotAvailableError(f"{token} has no label (the test split has none)")
        recording, number = _parts(token)
        found.setdefault(recording, set()).add(number)
    if not found:
        raise ChoiceError("tokens: expected at least one sample, found none")
    return {recording: sorted(found[recording]) for recording in sorted(found, key=_order)}


def _check_agents(
    dataset: Dataset, wanted: Mapping[str, list[int]], config: MotionLabelConfig
) -> None:
    """Raise NotAvailableError or ChoiceError now, and not later in a worker."""
    if config.filter_invisible and config.agents is not None:
        for recording, frames in wanted.items():
            cooperating_agents(dataset, f"{recording}/{frames[0]:03d}", config.agents)


def _with_kept(
    dataset: Dataset, root: Path, recording: str, frames: list[int], manifest: LabelManifest
) -> tuple[int, ...]:
    """The frames that a file should have: the requested ones and those that it has; raises LabelFilesError."""
    kept = manifest.samples.get(recording, [])
    try:
        for frame in kept:
            dataset.getind("sample", f"{recording}/{frame:03d}")
    except TokenError as error:
        raise LabelFilesError(
            f"{root}: {recording} has frames that are not in {dataset.dataroot} any more ({error}); choose another "
            "folder"
        ) from error
    return tuple(sorted({*frames, *kept}))


def _order(recording: str) -> tuple[str, int]:
    """By scenario, then agent as the tables have them."""
    scenario, agent = recording.rsplit("/", 1)
    return scenario, AGENTS.index(agent)


def _parts(token: object) -> tuple[str, int]:
    """A sample token's scenario and agent, and its frame number; 0 for other texts."""
    recording, _, number = str(token).rpartition("/")
    return recording, parse_number(number, 3) or 0
