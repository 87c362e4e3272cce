"""Samples in tar files, read back by Python's own tarfile."""

import io
import itertools
import json
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.format import SPLIT_NAMES
from deepaccident_devkit.export.webdataset import WebDataset
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.taxonomy import CAMERAS

pytestmark = pytest.mark.slow

FILES = [
    f"camera_{side}.jpg"
    for side in ("front", "front_left", "front_right", "back", "back_left", "back_right")
]
FILES += ["lidar.npy", "json"]


def samples_in(path: Path) -> dict[str, dict[str, bytes]]:
    """Key → files of a shard. A key begins a sample only once: its files lie together."""
    found: dict[str, dict[str, bytes]] = {}
    with tarfile.open(path) as archive:
        for key, entries in itertools.groupby(
            archive, lambda entry: entry.name[: entry.name.index(".")]
        ):
            assert key not in found
            members = [
                (entry.name[len(key) + 1 :], archive.extractfile(entry)) for entry in entries
            ]
            found[key] = {name: file.read() for name, file in members if file is not None}
    return found


def samples_of(folder: Path) -> dict[str, dict[str, bytes]]:
    shards = [samples_in(path) for path in sorted(folder.glob("*.tar"))]
    found = {key: files for shard in shards for key, files in shard.items()}
    assert len(found) == sum(map(len, shards))
    return found


def points_of(files: Mapping[str, bytes]) -> Any:
    return np.lib.format.read_array(io.BytesIO(files["lidar.npy"]), allow_pickle=False)


def export(dataset: DeepAccident, folder: Path, form: WebDataset = WebDataset()) -> Exported:  # noqa: B008 - frozen
    return export_release(dataset, folder, form, workers=1)


@pytest.fixture(scope="module")
def exported(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return export(da, tmp_path_factory.mktemp("webdataset") / "out")


@pytest.fixture(scope="module")
def samples(exported: Exported) -> dict[str, dict[str, bytes]]:
    return samples_of(exported.folder)


def test_every_sample_has_the_bytes_of_its_files(
    da: DeepAccident, samples: dict[str, dict[str, bytes]]
) -> None:
    assert set(samples) == {record["token"] for record in da.sample}
    for token, files in samples.items():
        assert list(files) == FILES
        for camera, name in zip(CAMERAS, FILES, strict=False):
            assert files[name] == da.get_sample_data_path(token, camera).read_bytes()
        points = points_of(files)
        assert points.dtype == np.float32
        assert (points == da.load_point_cloud(token, "lidar").points.astype(np.float32)).all()


def test_the_json_places_points_boxes_and_cameras(
    da: DeepAccident, samples: dict[str, dict[str, bytes]]
) -> None:
    for token, files in samples.items():
        facts, record = parsed_json(files["json"]), da.sample.get(token)  # which refuses NaN
        assert (facts["token"], facts["scenario"]) == (token, record["scenario_token"])
        assert f"{facts['scenario']}/{facts['agent']}/{facts['frame']:03d}" == token
        same = ("timestamp", "time_to_end", "time_to_impact", "velocity", "labelled")
        assert {name: facts[name] for name in same} == {name: record[name] for name in same}
        assert np.allclose(
            np.array(facts["world_from_ego"]) @ facts["ego_from_lidar"],
            da.world_from(token, "lidar").matrix,
        )
        boxes, columns = da.boxes(token, "lidar"), facts["boxes"]
        for name in ("center", "size", "actor_id", "num_lidar_pts", "camera_visible"):
            assert np.array_equal(columns[name], getattr(boxes, name))
        assert np.array_equal(
            np.array(columns["velocity"], dtype=float), boxes.velocity, equal_nan=True
        )
        records = da.annotation[da.annotation_rows(token)]
        expected = {
            name: [record[name] for record in records]
            for name in ("category", "yaw", "is_collider")
        }
        assert {name: columns[name] for name in expected} == expected
        camera, told = da.camera(token, "Camera_FrontLeft"), facts["cameras"]["camera_front_left"]
        assert (told["intrinsic"], told["width"], told["height"]) == (
            camera.intrinsic.tolist(),
            64,
            36,
        )
        assert np.allclose(told["ego_from_camera"], da.ego_from(token, "Camera_FrontLeft").matrix)


def test_a_moment_is_together_and_a_split_in_its_files(
    da: DeepAccident, exported: Exported
) -> None:
    for path in exported.folder.glob("*.tar"):
        wanted = [
            sample["token"]
            for record in da.scenario
            if SPLIT_NAMES[record["split"]] == path.name.split("-")[0]
            for number in range(1, record["num_frames"] + 1)
            for sample in da.samples_of(f"{record['token']}/{number:03d}")
        ]
        assert list(samples_in(path)) == wanted


@pytest.mark.slow
@pytest.mark.parametrize("shard_size", [1])
def test_shards_of_any_size_hold_the_same_samples(
    da: DeepAccident, samples: dict[str, dict[str, bytes]], tmp_path: Path, shard_size: int
) -> None:
    folder = export(da, tmp_path / "out", WebDataset(shard_size=shard_size)).folder
    assert samples_of(folder) == samples
    held = [
        {key.rsplit("/", maxsplit=2)[0] for key in samples_in(path)}
        for path in folder.glob("*.tar")
    ]
    assert list(map(len, held)) == [1] * len(
        da.scenario
    )  # two of these do not fit into either size


def test_the_plan_is_about_what_is_written(da: DeepAccident, exported: Exported) -> None:
    told = export_release(da, exported.folder.with_name("none"), WebDataset(), dry_run=True).tally
    assert told.samples == exported.tally.samples == len(da.sample)
    assert told.files == exported.written  # shards, of several scenarios each
    assert told.bytes == pytest.approx(exported.tally.bytes, rel=0.05)
    assert exported.tally.left_out == {"files of the BEV camera": len(da.sample)}


def test_keyframes_end_at_the_last_frame(da: DeepAccident, tmp_path: Path) -> None:
    made = export(da, tmp_path / "out", WebDataset(frames="keyframes", agents=("infrastructure",)))
    wanted = {
        f"{record['token']}/infrastructure/{number:03d}"
        for record in da.scenario
        for number in (1, 6)
    }
    assert set(samples_of(made.folder)) == wanted
    assert made.tally.left_out == {
        "samples of other agents": 2 * 4 * len(da.scenario),
        "samples between keyframes": 4 * len(da.scenario),
        "files of the BEV camera": 2 * len(da.scenario),
    }


def test_a_partial_release_lacks_and_counts_what_is_missing(
    da_partial: DeepAccident, tmp_path: Path
) -> None:
    made = export(da_partial, tmp_path / "out")
    absent = {"ego_vehicle": {"camera_front.jpg"}, "infrastructure": {"lidar.npy"}}
    for token, files in samples_of(made.folder).items():
        assert set(FILES) - set(files) == absent.get(token.split("/")[2], set())
    scenarios, kinds = (
        len(da_partial.scenario),
        {"agents of scenarios": 1, "images": 6, "point clouds": 6},
    )
    expected = {
        f"{kind} that are not in this release": count * scenarios for kind, count in kinds.items()
    }
    assert made.tally.left_out.items() >= expected.items()


def test_without_labels_there_are_poses_and_no_boxes(
    unlabelled: DeepAccident, tmp_path: Path
) -> None:
    found = [
        json.loads(files["json"])
        for files in samples_of(export(unlabelled, tmp_path / "out").folder).values()
    ]
    assert len(found) == len(unlabelled.sample)
    for facts in found:
        boxes = set(map(len, facts["boxes"].values()))
        assert (facts["labelled"], boxes, np.shape(facts["world_from_ego"])) == (False, {0}, (4, 4))


def test_a_dot_in_a_name_does_not_cut_the_key(own_release: Path, tmp_path: Path) -> None:
    name = DeepAccident("v1", own_release, verbose=False).scenario[0]["name"]
    for path in sorted(own_release.rglob(f"{name}*"), reverse=True):
        path.rename(path.with_name(path.name.replace(name, f"{name}.5")))
    for path in own_release.rglob("*.txt"):
        if path.parent in (own_release, *own_release.glob("split_txt_files")):
            path.write_text(path.read_text().replace(name, f"{name}.5"))
    dataset = DeepAccident("v1", own_release, verbose=False)
    found = samples_of(export(dataset, tmp_path / "out").folder)
    assert len(found) == len(dataset.sample)
    renamed = {
        json.loads(files["json"])["scenario"]
        for key, files in found.items()
        if f"{name}%2E5/" in key
    }
    assert {scenario.partition("/")[2] for scenario in renamed} == {f"{name}.5"}


def test_the_same_bytes_again(da: DeepAccident, exported: Exported, tmp_path: Path) -> None:
    again = export(da, tmp_path / "again")
    for path in (each for each in exported.folder.iterdir() if each.is_file()):
        assert (again.folder / path.name).read_bytes() == path.read_bytes()


def test_on_the_command_line(da: DeepAccident, tmp_path: Path) -> None:
    words = [
        "export",
        "webdataset",
        str(da.dataroot),
        "--out",
        str(tmp_path / "out"),
        "--frames",
        "keyframes",
    ]
    CliRunner().invoke(
        deepaccident, [*words, "--shard-size", "1", "--workers", "1"], catch_exceptions=False
    )
    assert len(samples_of(tmp_path / "out")) == 2 * 5 * len(da.scenario)
    assert len(list((tmp_path / "out").glob("*.tar"))) == len(da.scenario)
