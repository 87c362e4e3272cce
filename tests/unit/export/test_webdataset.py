"""Read samples in tar files back with Python's own tarfile."""

import io
import json
import tarfile
from pathlib import Path

import numpy as np
import pytest
from support.command_calls import invoke_command

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.format import SPLIT_NAMES
from deepaccident_devkit.export.webdataset import WebDataset
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.taxonomy import CAMERAS

pytestmark = pytest.mark.slow

Samples = dict[str, dict[str, bytes]]
"""Content by file name, by key of the sample."""
FILE_NAMES = [
    "camera_front.jpg",
    "camera_front_left.jpg",
    "camera_front_right.jpg",
    "camera_back.jpg",
    "camera_back_left.jpg",
    "camera_back_right.jpg",
    "lidar.npy",
    "json",
]


def read_shard(path: Path) -> Samples:
    """Read the samples of a shard, in which the files of a sample must lie together."""
    samples: Samples = {}
    previous_key = None
    with tarfile.open(path) as archive:
        for entry in archive:
            key, _, name = entry.name.partition(".")
            assert key == previous_key or key not in samples
            previous_key = key
            file = archive.extractfile(entry)
            if file is not None:
                samples.setdefault(key, {})[name] = file.read()
    return samples


def read_samples(folder: Path) -> Samples:
    samples: Samples = {}
    for path in sorted(folder.glob("*.tar")):
        shard = read_shard(path)
        assert not shard.keys() & samples.keys()
        samples |= shard
    return samples


def export(dataset: DeepAccident, folder: Path, form: WebDataset = WebDataset()) -> Exported:  # noqa: B008 - frozen
    return export_release(dataset, folder, form, workers=1)


@pytest.fixture(scope="module")
def exported(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return export(da, tmp_path_factory.mktemp("webdataset") / "out")


@pytest.fixture(scope="module")
def samples(exported: Exported) -> Samples:
    return read_samples(exported.folder)


def test_every_sample_has_the_bytes_of_its_files(da: DeepAccident, samples: Samples) -> None:
    assert set(samples) == {record["token"] for record in da.sample}

    for token, files in samples.items():
        assert list(files) == FILE_NAMES
        for camera, name in zip(CAMERAS, FILE_NAMES, strict=False):
            assert files[name] == da.get_sample_data_path(token, camera).read_bytes()
        points = np.lib.format.read_array(io.BytesIO(files["lidar.npy"]), allow_pickle=False)
        assert points.dtype == np.float32
        assert (points == da.load_point_cloud(token, "lidar").points.astype(np.float32)).all()


def test_the_json_places_points_boxes_and_cameras(da: DeepAccident, samples: Samples) -> None:
    for token, files in samples.items():
        facts = parsed_json(files["json"])  # which refuses NaN
        record = da.sample.get(token)
        assert (facts["token"], facts["scenario"]) == (token, record["scenario_token"])
        assert f"{facts['scenario']}/{facts['agent']}/{facts['frame']:03d}" == token
        for name in ("timestamp", "time_to_end", "time_to_impact", "velocity", "labelled"):
            assert facts[name] == record[name]

        world_from_lidar = np.array(facts["world_from_ego"]) @ facts["ego_from_lidar"]
        assert np.allclose(world_from_lidar, da.world_from(token, "lidar").matrix)

        boxes = da.boxes(token, "lidar")
        columns = facts["boxes"]
        for name in ("center", "size", "actor_id", "num_lidar_pts", "camera_visible"):
            assert np.array_equal(columns[name], getattr(boxes, name))

        velocity = np.array(columns["velocity"], dtype=float)
        assert np.array_equal(velocity, boxes.velocity, equal_nan=True)

        records = da.annotation[da.annotation_rows(token)]
        for name in ("category", "yaw", "is_collider"):
            assert columns[name] == [record[name] for record in records]

        camera = facts["cameras"]["camera_front_left"]
        expected = da.camera(token, "Camera_FrontLeft")
        assert camera["intrinsic"] == expected.intrinsic.tolist()
        assert (camera["width"], camera["height"]) == (64, 36)

        ego_from_camera = da.ego_from(token, "Camera_FrontLeft").matrix
        assert np.allclose(camera["ego_from_camera"], ego_from_camera)


def test_shards_keep_moments_together_and_splits_apart(
    da: DeepAccident, exported: Exported
) -> None:
    for path in exported.folder.glob("*.tar"):
        expected = []
        for record in da.scenario:
            if SPLIT_NAMES[record["split"]] != path.name.split("-")[0]:
                continue
            for number in range(1, record["num_frames"] + 1):
                samples = da.samples_of(f"{record['token']}/{number:03d}")
                expected += [sample["token"] for sample in samples]
        assert list(read_shard(path)) == expected


@pytest.mark.slow
@pytest.mark.parametrize("shard_size", [1])
def test_shards_of_any_size_hold_the_same_samples(
    da: DeepAccident, samples: Samples, tmp_path: Path, shard_size: int
) -> None:
    folder = export(da, tmp_path / "out", WebDataset(shard_size=shard_size)).folder
    assert read_samples(folder) == samples
    shards = list(folder.glob("*.tar"))
    assert len(shards) == len(da.scenario)
    for path in shards:  # two scenarios do not fit into one shard
        assert len({key.rsplit("/", maxsplit=2)[0] for key in read_shard(path)}) == 1


def test_a_dry_run_estimates_what_is_written(da: DeepAccident, exported: Exported) -> None:
    out = exported.folder.with_name("none")
    plan = export_release(da, out, WebDataset(), dry_run=True).tally
    assert plan.samples == exported.tally.samples == len(da.sample)
    assert plan.files == exported.written  # shards, of several scenarios each
    assert plan.bytes == pytest.approx(exported.tally.bytes, rel=0.05)
    assert exported.tally.left_out == {"files of the BEV camera": len(da.sample)}


def test_keyframes_end_at_the_last_frame(da: DeepAccident, tmp_path: Path) -> None:
    done = export(da, tmp_path / "out", WebDataset(frames="keyframes", agents=("infrastructure",)))
    expected = set()
    for record in da.scenario:
        prefix = f"{record['token']}/infrastructure"
        expected |= {f"{prefix}/001", f"{prefix}/006"}

    assert read_samples(done.folder).keys() == expected
    assert done.tally.left_out == {
        "samples of other agents": 2 * 4 * len(da.scenario),
        "samples between keyframes": 4 * len(da.scenario),
        "files of the BEV camera": 2 * len(da.scenario),
    }


def test_a_partial_release_lacks_and_counts_what_is_missing(
    da_partial: DeepAccident, tmp_path: Path
) -> None:
    done = export(da_partial, tmp_path / "out")
    missing_files = {"ego_vehicle": {"camera_front.jpg"}, "infrastructure": {"lidar.npy"}}
    for token, files in read_samples(done.folder).items():
        agent = token.split("/")[2]
        assert set(FILE_NAMES) - set(files) == missing_files.get(agent, set())
    for kind, count in {"agents of scenarios": 1, "images": 6, "point clouds": 6}.items():
        num_missing = done.tally.left_out[f"{kind} that are not in this release"]
        assert num_missing == count * len(da_partial.scenario)


def test_without_labels_there_are_poses_and_no_boxes(
    unlabelled_dataset: DeepAccident, tmp_path: Path
) -> None:
    samples = read_samples(export(unlabelled_dataset, tmp_path / "out").folder)
    assert len(samples) == len(unlabelled_dataset.sample)

    for files in samples.values():
        facts = json.loads(files["json"])
        assert facts["labelled"] is False
        assert {len(column) for column in facts["boxes"].values()} == {0}
        assert np.shape(facts["world_from_ego"]) == (4, 4)


def test_a_dot_in_a_name_does_not_cut_the_key(own_release: Path, tmp_path: Path) -> None:
    name = DeepAccident("v1", own_release, verbose=False).scenario[0]["name"]
    for path in sorted(own_release.rglob(f"{name}*"), reverse=True):
        path.rename(path.with_name(path.name.replace(name, f"{name}.5")))
    for path in own_release.rglob("*.txt"):
        if path.parent in (own_release, *own_release.glob("split_txt_files")):
            path.write_text(path.read_text().replace(name, f"{name}.5"))
    dataset = DeepAccident("v1", own_release, verbose=False)
    samples = read_samples(export(dataset, tmp_path / "out").folder)

    assert len(samples) == len(dataset.sample)

    renamed = [files["json"] for key, files in samples.items() if f"{name}%2E5/" in key]
    scenarios = {json.loads(content)["scenario"] for content in renamed}
    assert {scenario.partition("/")[2] for scenario in scenarios} == {f"{name}.5"}


def test_a_second_export_has_the_same_bytes(
    da: DeepAccident, exported: Exported, tmp_path: Path
) -> None:
    second = export(da, tmp_path / "again")
    for path in exported.folder.iterdir():
        if path.is_file():
            assert (second.folder / path.name).read_bytes() == path.read_bytes()


def test_the_command_exports_keyframes_in_small_shards(da: DeepAccident, tmp_path: Path) -> None:
    out = tmp_path / "out"
    invoke_command(
        *("export", "webdataset", da.dataroot, "--out", out),
        *("--frames", "keyframes", "--shard-size", 1, "--workers", 1),
    )
    assert len(read_samples(out)) == 2 * 5 * len(da.scenario)
    assert len(list(out.glob("*.tar"))) == len(da.scenario)
