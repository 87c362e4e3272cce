"""Folders of motion labels: what is read back, what stops and damage leave, and whom a folder
refuses.
"""

import json
import operator
import os
import pickle
import random
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import tiny
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    LabelFilesError,
    NotAvailableError,
    SomeFailedError,
    TokenError,
)
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import (
    LABEL_PROTOCOLS,
    PRESETS,
    Augmentation,
    FrameBoxes,
    LabelFiles,
    LabelsWritten,
    MotionLabelConfig,
    MotionLabels,
    label_files,
    motion_labels,
    motion_labels_from_boxes,
    write_label_files,
)
from deepaccident_devkit.motion.batch_names import BatchNames
from deepaccident_devkit.motion.label_folder import (
    LABEL_FORMAT_VERSION,
    MANIFEST,
    LabelManifest,
    StoredLabels,
    label_store,
)
from deepaccident_devkit.support.files import replacing, temporary_path
from deepaccident_devkit.taxonomy import AGENTS

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[3] / "schema" / "motion_labels.md"
MAPS = ("segmentation", "instance", "centerness", "offset", "flow", "future_egomotion", "valid")
OBLONG = BevGrid((-20.0, 60.0, 0.5), (-30.0, 10.0, 0.25))
CONFIGS = {
    **PRESETS,
    "clean": MotionLabelConfig(protocol="clean"),
    "clean, everybody, untracked too": MotionLabelConfig(protocol="clean", filter_invisible=False),
    "everybody": MotionLabelConfig(filter_invisible=False),
    "released orientation": MotionLabelConfig(orientation="released"),
    "clean, as fiery": MotionLabelConfig(protocol="clean", orientation="fiery", draw_ego=False),
    "fiery, as released": MotionLabelConfig.preset(
        "fiery", orientation="released", ignore_index=201
    ),
    "oblong": MotionLabelConfig(grid=OBLONG, receptive_field=1, future_frames=2, step=2),
    "oblong, as fiery": MotionLabelConfig(grid=OBLONG, orientation="fiery", protocol="clean"),
    "large": MotionLabelConfig(
        grid=BevGrid((-100.0, 100.0, 0.5), (-100.0, 100.0, 0.5)), future_frames=1
    ),
    "augmented": MotionLabelConfig(augmentation=Augmentation(rotation=0.3, scale=1.04, flip=True)),
    "quirks of one's own": MotionLabelConfig(
        protocol=replace(LABEL_PROTOCOLS["clean"], untracked_share_an_id=True)
    ),
    "one agent's sight": MotionLabelConfig(agents=("ego_vehicle",)),
}


def assert_same(one: MotionLabels, other: MotionLabels) -> None:
    """Equal to the bit, the type and the zero's sign."""
    for name in MAPS:
        mine, theirs = getattr(one, name), getattr(other, name)
        assert (mine.dtype, mine.shape) == (theirs.dtype, theirs.shape), name
        differing = int((mine != theirs).sum())
        assert mine.tobytes() == theirs.tobytes(), f"{name}: {differing} cells differ"
    assert dict(one.id_map) == dict(other.id_map)
    assert (one.config.digest, one.at_present) == (other.config.digest, other.at_present)


def contents(folder: Path) -> dict[str, bytes]:
    """All files but the lock."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def two_people(agent: str, frame: int) -> list[str]:
    """tiny's boxes, and two untracked people, seen."""
    people = [
        f"pedestrian {x} {4 + frame / 5} -0.9 0.6 0.6 1.86 0 0.0 0.0 -1 9 True" for x in (8.0, 11.0)
    ]
    return [*tiny.label_lines(agent, frame), *people]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tiny.write_tiny_release(tmp_path / "release", frames=12, lines_of=two_people)


@pytest.fixture
def small(root: Path) -> DeepAccident:
    return opened(root)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "labels"


def opened(root: Path) -> DeepAccident:
    return DeepAccident(dataroot=root, verbose=False, workers=1)


def tokens_of(release: DeepAccident, *frames: int, agents: tuple[str, ...] = AGENTS) -> list[str]:
    """By scenario, agent and time."""
    ends = tuple(f"/{agent}/{frame:03d}" for agent in agents for frame in frames)
    return [record["token"] for record in release.sample if record["token"].endswith(ends)]


def write(
    release: DeepAccident,
    folder: Path,
    tokens: list[str],
    config: MotionLabelConfig | None = None,
    **more: Any,
):
    return write_label_files(release, folder, tokens, config, **{"workers": 1, **more})


def restate(folder: Path, **changes: object) -> None:
    """Other values in a folder's manifest."""
    path = folder / MANIFEST
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def change_label(release: Path, agent: str, name: str = tiny.NAME, frame: int = 6) -> None:
    """Take a label's last row away."""
    label = release / tiny.TYPE / agent / "label" / name / f"{name}_{frame:03d}.txt"
    label.write_text("\n".join(label.read_text().splitlines()[:-1]) + "\n")
    os.utime(label.parent)


def lift(release: Path, agent: str, name: str = tiny.NAME, frame: int = 6) -> None:
    """Put an agent's LiDAR at a height of 1.5 m in a frame."""
    calib = release / tiny.TYPE / agent / "calib" / name / f"{name}_{frame:03d}.pkl"
    calib.write_bytes(tiny.old_pickle(tiny.calib(tiny.ego_to_world(agent, frame), height=1.5)))
    os.utime(calib.parent)


@pytest.mark.parametrize("name", CONFIGS)
def test_labels_of_every_configuration_come_back(
    da_motion: DeepAccident, tmp_path: Path, name: str
) -> None:
    tokens = tokens_of(da_motion, 1, 27, agents=("ego_vehicle", "infrastructure"))
    write(da_motion, tmp_path, tokens, CONFIGS[name])
    files = LabelFiles(tmp_path)
    for token in random.Random(0).sample(tokens, len(tokens)):  # noqa: S311 - any order
        assert_same(files[token], motion_labels(da_motion, token, CONFIGS[name]))


@pytest.mark.parametrize(
    "name", ["clean, everybody, untracked too", "everybody", "quirks of one's own"]
)
def test_untracked_actors(small: DeepAccident, tmp_path: Path, name: str) -> None:
    """Each row is an instance without an actor, or all are actor −1."""
    config, tokens = replace(CONFIGS[name], filter_invisible=False), tokens_of(small, 1, 9, 12)
    write(small, tmp_path / "labels", tokens, config)
    files, shared = LabelFiles(tmp_path / "labels", config), config.rules.untracked_share_an_id
    for token in tokens:
        assert_same(files[token], motion_labels(small, token, config))
        assert (-1 in files[token].id_map) == shared


@pytest.mark.parametrize("count", [255, 256, 300])
def test_more_instances_than_a_byte_counts(tmp_path: Path, count: int) -> None:
    x, y = np.meshgrid(np.arange(20) * 4.5 - 45, np.arange(15) * 4.5 - 30)
    center = np.column_stack([x.ravel(), y.ravel(), np.zeros(300)])[:count]
    frame = FrameBoxes(
        center=center,
        size=np.tile([3.0, 3.0, 1.5], (count, 1)),
        yaw=np.zeros(count),
        actor_id=1000 + np.arange(count),
        category=np.zeros(count),
        visible=np.ones(count),
        ego_from_lidar=np.eye(4),
    )
    config = MotionLabelConfig(draw_ego=False)
    labels = motion_labels_from_boxes([frame] * 5, np.zeros((7, 6)), config)
    assert labels.instance.max() == count
    with zipfile.ZipFile(tmp_path / "one.npz", "w") as archive:
        StoredLabels.of(labels).write(archive, "007")
    with zipfile.ZipFile(tmp_path / "one.npz") as archive:
        stored = StoredLabels.read(archive, "007")
    assert stored.instance.dtype == (np.uint8 if count < 256 else np.uint16)
    assert_same(stored.labels(config), labels)


def test_bytes_do_not_depend_on_time_workers_or_order(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    tokens = tokens_of(da_motion, 5, 30)
    write(da_motion, tmp_path / "one", tokens)
    write(da_motion, tmp_path / "two", tokens[::-1], workers=2)
    records = [da_motion.get("sample", token) for token in tokens]
    with ThreadPoolExecutor(2) as executor:
        write_label_files(da_motion, tmp_path / "three", [*records, *records], executor=executor)
    assert contents(tmp_path / "one") == contents(tmp_path / "two") == contents(tmp_path / "three")


@pytest.mark.parametrize("name", ["deepaccident", "oblong, as fiery"])
def test_the_lines_of_the_page_rebuild_the_maps(
    da_motion: DeepAccident, tmp_path: Path, name: str
) -> None:
    """With numpy alone, to the bit; a sample in the midst and one whose future is beyond the
    recording.
    """
    _, _, rest = PAGE.read_text(encoding="utf-8").partition("```python\n")
    lines, fence, _ = rest.partition("```")
    assert fence
    tokens = tokens_of(da_motion, 15, 27, agents=("other_vehicle",))
    write(da_motion, tmp_path, tokens, CONFIGS[name])
    for token in tokens:
        rebuilt = {"folder": str(tmp_path), "token": token}
        exec(compile(lines, PAGE, "exec"), rebuilt)  # noqa: S102 - our own page
        labels = LabelFiles(tmp_path)[token]
        for one in ("segmentation", "instance", "centerness", "offset", "flow"):
            ours, theirs = getattr(labels, one), rebuilt[one]
            assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape)
            assert ours.tobytes() == theirs.tobytes(), (
                f"{one}: {int((ours != theirs).sum())} cells differ"
            )


@pytest.mark.parametrize("name", get_args(BatchNames))
def test_the_loop_of_the_page_reads_batches(
    small: DeepAccident, out: Path, name: BatchNames
) -> None:
    _, _, rest = PAGE.read_text(encoding="utf-8").partition("A training loop")
    lines = rest.partition("```python\n")[2].partition("```")[0]
    tokens = tokens_of(small, 3, 12)
    write_label_files(small, out, tokens, names=name, workers=1)
    run = {"folder": str(out)}
    exec(compile(lines, PAGE, "exec"), run)  # noqa: S102 - our own page
    assert sorted(
        path.relative_to(out).with_suffix("").as_posix() for path in run["paths"]
    ) == sorted(tokens)
    expected = motion_labels(small, tokens[0]).as_batch(name)
    assert {key: (array.dtype, array.shape[1:]) for key, array in run["batch"].items()} == {
        key: (array.dtype, array.shape) for key, array in expected.items()
    }


@pytest.mark.parametrize("name", get_args(BatchNames))
@pytest.mark.parametrize("config", ["deepaccident", "fiery", "clean", "oblong"])
def test_batches_of_every_code_and_sample(
    small: DeepAccident, out: Path, name: BatchNames, config: str
) -> None:
    tokens = tokens_of(small, 1, 12, agents=("ego_vehicle", "infrastructure"))
    done = write_label_files(small, out, tokens, CONFIGS[config], names=name, workers=1)
    assert done == LabelsWritten(samples=4, written=4, kept=0)
    for token in tokens:
        expected = motion_labels(small, token, CONFIGS[config]).as_batch(name)
        with np.load(out / f"{token}.npz", allow_pickle=False) as file:
            assert file.files == list(expected)
            for key, array in expected.items():
                assert (file[key].dtype, file[key].shape) == (array.dtype, array.shape)
                assert file[key].tobytes() == array.tobytes(), key


def test_stopped_after_any_file_it_goes_on_there(
    small: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tokens = tokens_of(small, 3, 7, agents=("ego_vehicle", "infrastructure"))
    write_label_files(small, tmp_path / "fresh", tokens, names="fiery", workers=1)
    for stop in range(4):
        begun = iter(range(stop))

        @contextmanager
        def stopping(path: Path, begun: Iterator[int] = begun) -> Iterator[Path]:
            with replacing(path) as temporary:
                yield temporary
                if next(begun, None) is None:
                    raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(label_files, "replacing", stopping)
            with pytest.raises(KeyboardInterrupt):
                write_label_files(small, tmp_path / f"{stop}", tokens, names="fiery", workers=1)
        done = write_label_files(small, tmp_path / f"{stop}", tokens, names="fiery", workers=1)
        assert done == LabelsWritten(samples=4, written=4 - stop, kept=stop)
        assert contents(tmp_path / f"{stop}") == contents(tmp_path / "fresh")


def test_samples_can_be_added_and_damaged_files_are_made_again(
    small: DeepAccident, out: Path
) -> None:
    some, more = (tokens_of(small, frame, agents=("ego_vehicle",)) for frame in (2, 7))
    done = [write(small, out, tokens, names="beverse") for tokens in (some, more)]
    assert [(each.written, each.kept) for each in done] == [(1, 0), (1, 1)]
    before, file = contents(out), out / f"{some[0]}.npz"
    file.write_bytes(file.read_bytes()[:-40])
    temporary_path(file).touch()  # of a killed process
    assert (write(small, out, more, names="beverse").written, contents(out)) == (1, before)


def test_folders_of_other_names_are_refused_and_left(small: DeepAccident, tmp_path: Path) -> None:
    tokens = tokens_of(small, 3)
    for own, other in ((None, "fiery"), ("fiery", "beverse"), ("beverse", None)):
        folder = tmp_path / str(own)
        write(small, folder, tokens, names=own)
        before = contents(folder)
        assert_refused(
            (
                partial(write_label_files, small, folder, tokens, names=other, workers=1),
                ConfigError,
                f"configuration .names: {own!r}, asked for {other!r}.; choose another",
            ),
        )
        assert contents(folder) == before
    assert_refused(
        (
            lambda: LabelFiles(tmp_path / "fiery"),
            LabelFilesError,
            r"holds batches of fiery, which np\.load opens .* without --names on",
        ),
        (
            lambda: write_label_files(small, tmp_path / "lss", tokens, names="lss"),
            ChoiceError,
            "expected one of fiery, beverse, deepaccident, or None, found 'lss'",
        ),
    )


def test_what_is_whole_is_kept_and_fewer_samples_remove_nothing(
    small: DeepAccident, out: Path
) -> None:
    some, others = tokens_of(small, 2, 7), tokens_of(small, 7, 12, agents=("ego_vehicle",))
    assert write(small, out, some) == LabelsWritten(samples=10, written=5, kept=0)
    assert write(small, out, others) == LabelsWritten(samples=2, written=1, kept=0)
    before = contents(out)
    assert write(small, out, some[:1]) == LabelsWritten(samples=1, written=0, kept=1)
    assert (write(small, out, some), contents(out)) == (
        LabelsWritten(samples=10, written=0, kept=5),
        before,
    )
    files = LabelFiles(out)
    assert set(files) == {*some, *others}
    for token in files:
        assert_same(files[token], motion_labels(small, token))


@pytest.mark.parametrize("names", [None, "fiery"])
def test_what_the_release_changed_is_made_again(
    root: Path, out: Path, names: BatchNames | None
) -> None:
    """A label row of an agent that is not asked for, a LiDAR's pose; then nothing."""
    tokens = tokens_of(opened(root), 1, agents=("ego_vehicle", "infrastructure"))
    write(opened(root), out, tokens, names=names)
    change_label(root, "other_vehicle")
    assert write(opened(root), out, tokens, names=names) == LabelsWritten(
        samples=2, written=2, kept=0
    )
    lift(root, "ego_vehicle")
    assert [write(opened(root), out, tokens, names=names).written for _ in range(2)] == [2, 0]


def test_a_file_depends_on_the_rows_of_its_own_scenario_alone(tmp_path: Path, out: Path) -> None:
    """Of a frame, and of two whose first one has no boxes: each change makes its own file again."""
    names = {tiny.NAME: 1, tiny.NAME.replace("24", "25"): 2}
    for name, frames in names.items():
        boxes = lambda agent, at, last=frames: (  # noqa: E731
            tiny.label_lines(agent, at) if at == last else ["0 0"]
        )
        tiny.write_tiny_release(
            tmp_path, frames=frames, name=name, agents=("infrastructure",), lines_of=boxes
        )
    tokens = [f"{tiny.TYPE}/{name}/infrastructure/001" for name in names]
    write(opened(tmp_path), out, tokens)
    for name, change in ((name, change) for name in names for change in (change_label, lift)):
        before, _ = contents(out), change(tmp_path, "infrastructure", name, names[name])
        assert write(opened(tmp_path), out, tokens) == LabelsWritten(samples=2, written=1, kept=1)
        changed = {path for path, content in contents(out).items() if content != before[path]}
        assert changed == {f"{tiny.TYPE}/{name}/infrastructure.npz"}


def test_another_configuration_leaves_the_folder_as_it_is(small: DeepAccident, out: Path) -> None:
    tokens = tokens_of(small, 3)
    write(small, out, tokens)
    before = contents(out)
    others = {
        "draw_ego: True, asked for False": MotionLabelConfig(draw_ego=False),
        "half_cell_shift: True, asked for False": MotionLabelConfig(
            protocol=replace(LABEL_PROTOCOLS["released"], half_cell_shift=False)
        ),
        "agents: None, asked for 'single'": MotionLabelConfig(agents="single"),
        "orientation: 'devkit', asked for 'released'": MotionLabelConfig(orientation="released"),
    }
    assert_refused(
        *[
            (
                partial(write, small, out, tokens, config),
                ConfigError,
                f"another configuration .*{told}.*choose another folder",
            )
            for told, config in others.items()
        ],
        *[(partial(LabelFiles, out, config), ConfigError, told) for told, config in others.items()],
    )
    assert contents(out) == before


def test_folders_that_are_something_else(small: DeepAccident, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_text("mine")
    (tmp_path / "odd" / MANIFEST).mkdir(parents=True)
    (tmp_path / "empty").mkdir()
    assert_refused(
        *[
            (partial(write_label_files, small, folder, tokens_of(small, 3)), LabelFilesError, told)
            for folder, told in {
                "": "found an empty path; give '.' for the current one",
                tmp_path / "file": "file: is a file; give a folder",
                tmp_path
                / "photos": "photos: is not empty and holds no motion labels; choose a new folder",
                tmp_path / "odd": r"manifest.json: not a regular file \(a folder\)",
                tmp_path
                / "file"
                / "below": "below: cannot be written .*; make room there, or choose another folder",
                "/proc/nowhere": "nowhere: cannot be written .*; make room there, or "
                "choose another folder",
            }.items()
        ],
    )
    assert contents(tmp_path / "photos") == {"cat.jpg": b"mine"}
    assert_refused(
        *[
            (
                partial(LabelFiles, tmp_path / folder),
                LabelFilesError,
                r"holds no motion labels .*make them with `deepaccident labels`",
            )
            for folder in ("nowhere", "empty", "photos", "file")
        ],
    )
    assert write(small, tmp_path / "empty", tokens_of(small, 3)).written == 5


def test_what_cannot_be_drawn_is_said_before_anything_is_written(
    root: Path, tmp_path: Path
) -> None:
    small, out = opened(root), tmp_path / "labels"
    unlabelled = opened(tiny.write_tiny_release(tmp_path / "test", labelled=False))
    two = opened(
        tiny.write_tiny_release(tmp_path / "two", agents=("ego_vehicle", "infrastructure"))
    )
    assert_refused(
        (
            lambda: write(two, out, tokens_of(two, 3), MotionLabelConfig(agents="+other")),
            NotAvailableError,
            "other_vehicle is not in this release",
        ),
        (
            lambda: write(unlabelled, out, tokens_of(unlabelled, 3)),
            NotAvailableError,
            "ego_vehicle/003 has no label",
        ),
        (
            lambda: write(small, out, [*tokens_of(small, 3), "nothing"]),
            TokenError,
            "no token 'nothing'",
        ),
        (lambda: write(small, out, []), ChoiceError, "expected at least one sample, found none"),
        *[
            (partial(write_label_files, small, out, one), ChoiceError, "put it into a list")
            for one in (tokens_of(small, 3)[0], small.sample[3])
        ],
    )
    assert not out.exists()


class TestReading:
    @pytest.fixture
    def files(self, da_motion: DeepAccident, tmp_path: Path) -> LabelFiles:
        write(da_motion, tmp_path / "labels", tokens_of(da_motion, 4, 19))
        return LabelFiles(tmp_path / "labels")

    def test_it_is_a_mapping_by_token(self, files: LabelFiles, da_motion: DeepAccident) -> None:
        tokens = tokens_of(da_motion, 4, 19)
        assert list(files) == tokens
        assert all(token in files for token in tokens)
        recording = tokens[0].removesuffix("/004")
        for other in (
            *(
                f"{recording}/{number}"
                for number in ("4", "0004", "005", "٠٠٤", "-04", "+04", " 04", "", "004/")
            ),
            recording,
            f"/{tokens[0]}",
            "",
            4,
            None,
            da_motion.get("sample", tokens[0]),
        ):
            assert other not in files
            with pytest.raises(
                TokenError, match=r"has no labels of .*; `deepaccident labels` can add them"
            ):
                files[other]

    def test_threads_and_spawned_processes_read_the_same(self, files: LabelFiles) -> None:
        tokens = random.Random(1).choices(list(files), k=60)  # noqa: S311
        expected = {token: files[token] for token in files}
        with ThreadPoolExecutor(8) as threads:
            for token, labels in zip(tokens, threads.map(files.__getitem__, tokens), strict=True):
                assert_same(labels, expected[token])
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as processes:
            assert_same(
                processes.submit(operator.getitem, files, tokens[0]).result(), expected[tokens[0]]
            )
        assert_same(pickle.loads(pickle.dumps(files))[tokens[1]], expected[tokens[1]])


class TestDamage:
    @pytest.fixture
    def folder(self, small: DeepAccident, tmp_path: Path) -> Path:
        write(small, tmp_path / "labels", tokens_of(small, 3, 7, agents=("ego_vehicle",)))
        return tmp_path / "labels"

    @pytest.fixture
    def path(self, folder: Path) -> Path:
        return folder / f"{tiny.TOKEN}" / "ego_vehicle.npz"

    def test_any_byte_of_a_file(self, small: DeepAccident, folder: Path, path: Path) -> None:
        """The labels or our error, whatever byte is another."""
        whole, token = path.read_bytes(), tokens_of(small, 3)[0]
        expected, source, told, refused = LabelFiles(folder)[token], random.Random(2), "", 0  # noqa: S311
        for _ in range(150):
            place = source.choice([source.randrange(len(whole)), -source.randrange(1, 700)])
            content = bytearray(whole)
            content[place] ^= source.randrange(1, 256)
            path.write_bytes(content)
            try:
                assert_same(LabelFiles(folder)[token], expected)
            except LabelFilesError as error:
                told, refused = str(error), refused + 1
        assert told.startswith(f"{path}: ")
        assert told.endswith("; remove it and run `deepaccident labels` again")
        assert refused > 20

    @pytest.mark.parametrize("keep", [0, 1, 500, -1, None])
    def test_a_file_cut_short_or_gone_is_made_again(
        self, small: DeepAccident, folder: Path, path: Path, keep: int | None
    ) -> None:
        before, tokens = contents(folder), list(LabelFiles(folder))
        if keep is None:
            path.unlink()
        else:
            path.write_bytes(path.read_bytes()[:keep])
        files = LabelFiles(folder)
        for token in tokens:
            with pytest.raises(LabelFilesError, match=r"ego_vehicle\.npz.*; remove it and run"):
                files[token]
        assert write(small, folder, tokens[:1]) == LabelsWritten(samples=1, written=1, kept=0)
        assert contents(folder) == before
        assert_same(files[tokens[1]], motion_labels(small, tokens[1]))

    def test_a_file_of_another_folder(
        self, small: DeepAccident, folder: Path, path: Path, tmp_path: Path
    ) -> None:
        token = tokens_of(small, 3)[0]
        write(small, tmp_path / "clean", [token], MotionLabelConfig(protocol="clean"))
        shutil.copy(tmp_path / "clean" / path.relative_to(folder), path)
        assert_refused(
            (
                lambda: LabelFiles(folder)[token],
                LabelFilesError,
                "holds labels of another configuration; remove it",
            ),
        )
        assert write(small, folder, [token]).written == 1
        assert_same(LabelFiles(folder)[token], motion_labels(small, token))

    @pytest.mark.parametrize(
        "member", ["instance", "center", "flow", "actor", "future_egomotion", "valid"]
    )
    def test_arrays_that_cannot_be_the_samples(
        self, small: DeepAccident, path: Path, folder: Path, member: str
    ) -> None:
        with zipfile.ZipFile(path) as archive:
            others = {
                name: archive.read(name)
                for name in archive.namelist()
                if name != f"003/{member}.npy"
            }
            with archive.open(f"003/{member}.npy") as file:
                array = np.lib.format.read_array(file)
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in others.items():
                archive.writestr(name, content)
            with archive.open(f"003/{member}.npy", "w") as file:
                np.lib.format.write_array(file, array[:-1])
        assert_refused(
            (
                lambda: LabelFiles(folder)[tokens_of(small, 3)[0]],
                LabelFilesError,
                r"ego_vehicle\.npz: .*expected .*found",
            ),
        )

    @pytest.mark.parametrize(
        "text",
        [
            "",
            "{",
            "[]",
            "null",
            "3",
            "\0",
            "[" * 100_000,
            "\xff",
            '{"format": "DeepAccident motion labels"}',
        ],
    )
    def test_a_manifest_that_is_none(self, small: DeepAccident, folder: Path, text: str) -> None:
        (folder / MANIFEST).write_text(text, encoding="latin-1")
        before = contents(folder)
        assert_refused(
            *[
                (
                    use,
                    LabelFilesError,
                    r"manifest\.json: cannot be read .*; make the labels again in an",
                )
                for use in (
                    lambda: LabelFiles(folder),
                    lambda: write(small, folder, tokens_of(small, 3)),
                )
            ],
        )
        assert contents(folder) == before

    @pytest.mark.parametrize(
        "change",
        [
            {"format": "something"},
            {"version": "1"},
            {"version": None},
            {"config": {}},
            {"config": None},
            {"config_digest": "0" * 16},
            {"names": "lss"},
            {"names": []},
            {"samples": []},
            {"samples": {"a/b/ego_vehicle": 3}},
            {"samples": {"a/b/ego_vehicle": [0]}},
            {"samples": {"a/b/ego_vehicle": [True]}},
            {"samples": {"a/b/ego_vehicle": ["3"]}},
            {"samples": {"a/b/nobody": [3]}},
            {"samples": {"../../ego_vehicle": [3]}},
            {"samples": {"/etc/ego_vehicle": [3]}},
        ],
    )
    def test_a_manifest_with_a_wrong_value(self, folder: Path, change: dict[str, object]) -> None:
        restate(folder, **change)
        assert_refused(
            (lambda: LabelFiles(folder), LabelFilesError, r"manifest\.json: cannot be read")
        )

    def test_a_manifest_that_is_a_pipe_or_a_giant(self, folder: Path) -> None:
        path = folder / MANIFEST
        content = path.read_bytes()
        path.unlink()
        os.mkfifo(path)
        assert_refused(
            (lambda: LabelFiles(folder), LabelFilesError, r"not a regular file \(a named pipe\)"),
        )
        path.unlink()
        with path.open("wb") as file:
            file.truncate(3 << 30)
        assert_refused(
            (lambda: LabelFiles(folder), LabelFilesError, "has 3,221,225,472 bytes"),
        )
        told = json.loads(content)
        config = MotionLabelConfig(grid=BevGrid((-1000.0, 1000.0, 0.1), (-1000.0, 1000.0, 0.1)))
        path.write_text(
            json.dumps({**told, "config": config.as_dict(), "config_digest": config.digest})
        )
        assert_refused(
            (lambda: LabelFiles(folder), LabelFilesError, "a sample takes 32,000,000,000 bytes"),
        )

    @pytest.mark.parametrize(
        ("version", "kind"), [(LABEL_FORMAT_VERSION + 1, "newer"), (0, "older")]
    )
    def test_another_devkits_labels_are_refused_and_kept(
        self, small: DeepAccident, folder: Path, version: int, kind: str
    ) -> None:
        path = folder / MANIFEST
        path.write_text(json.dumps({**json.loads(path.read_text()), "version": version, "new": 1}))
        before = contents(folder)
        sentence = (
            rf"{kind} devkit's labels \(format version {version}, this devkit's is "
            rf"{LABEL_FORMAT_VERSION}\); .* or make"
        )
        assert_refused(
            *[
                (use, LabelFilesError, sentence)
                for use in (
                    lambda: LabelFiles(folder),
                    lambda: write(small, folder, tokens_of(small, 3)),
                )
            ],
        )
        assert contents(folder) == before


FULL = """
import resource, sys
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import LabelFilesError
from deepaccident_devkit.motion import write_label_files

release = DeepAccident(dataroot=sys.argv[1], verbose=False, workers=1)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]),) * 2)
try:
    write_label_files(release, sys.argv[2], [record["token"] for record in release.sample], workers=1)
except LabelFilesError as error:
    print(error)
"""  # noqa: E501


def python(script: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", script, *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(
        command, capture_output=True, text=True, timeout=300, check=False, env=environment
    )


def test_a_full_disk(root: Path, tmp_path: Path) -> None:
    small, out = opened(root), tmp_path / "labels"
    for limit, there in ((100, 0), (12_000, 1)):
        said = python(FULL, root, out, limit)
        assert "labels: cannot be written ([Errno 27]" in said.stdout, said.stderr
        assert "make room there, or choose another folder, and run it again" in said.stdout
        assert len(contents(out)) == there, contents(out).keys()
    write(small, out, tokens_of(small, 3))
    assert len(LabelFiles(out)) == 5


def two_agents(release: DeepAccident, *frames: int) -> list[str]:
    return tokens_of(release, *(frames or (2, 4)), agents=("ego_vehicle", "infrastructure"))


@pytest.fixture(scope="module")
def whole(da_b: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What one call writes for the frames 2 and 4 of six scenarios."""
    folder = tmp_path_factory.mktemp("labels")
    write(da_b, folder, two_agents(da_b))
    return contents(folder)


def test_several_calls_share_the_scenarios(
    da_b: DeepAccident, out: Path, whole: dict[str, bytes]
) -> None:
    with ThreadPoolExecutor(3) as threads:
        done = list(threads.map(lambda _: write(da_b, out, two_agents(da_b)), range(3)))
    assert sum(each.written for each in done) == 12
    assert ({(each.samples, each.written + each.kept) for each in done}, contents(out)) == (
        {(24, 12)},
        whole,
    )


def test_nothing_is_listed_before_all_is_there(
    da_b: DeepAccident, out: Path, whole: dict[str, bytes]
) -> None:
    """And what a killed process has begun is removed, unless others are at work."""
    store = label_store(out, "")
    with store.shared():
        LabelManifest(MotionLabelConfig(), {}).write(out)
        assert_refused(
            (lambda: LabelFiles(out), LabelFilesError, "its labels are not complete"),
        )
    begun = temporary_path(out / "manifest.json")
    begun.touch()
    assert write(da_b, out, two_agents(da_b)).written == 12
    assert not begun.exists()
    assert contents(out) == whole


def test_what_fails_is_listed_and_the_rest_is_done(
    da_b: DeepAccident, out: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, broken = label_files.motion_labels_of, two_agents(da_b, 4)[3]

    def fail_once(
        dataset: DeepAccident, tokens: list[str], *more: object
    ) -> Iterator[MotionLabels]:
        if broken in tokens:
            raise NotAvailableError("nothing to see")
        return made(dataset, tokens, *more)

    with monkeypatch.context() as patch:
        patch.setattr(label_files, "motion_labels_of", fail_once)
        assert_refused(
            (
                lambda: write(da_b, out, two_agents(da_b)),
                SomeFailedError,
                rf"1 of 12 failed:\n  {broken[:-4]}: nothing to see\n",
            ),
        )
    assert (len(list(out.rglob("*.npz"))), write(da_b, out, two_agents(da_b))) == (
        11,
        LabelsWritten(samples=24, written=1, kept=11),
    )
    assert contents(out) == whole
