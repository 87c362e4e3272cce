"""The released infos, read by a reader that knows the released code's conventions and not the
devkit.
"""

import logging
import pickle
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli.export import export
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.released_infos import ReleasedInfos
from deepaccident_devkit.taxonomy import AGENTS

pytestmark = pytest.mark.slow

Info = dict[str, Any]
FOLDER = "./data/DeepAccident_data"


@pytest.fixture(scope="module")
def exported(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return export_release(
        da, tmp_path_factory.mktemp("released") / "out", ReleasedInfos(), workers=2
    )


def infos(folder: Path, name: str = "val") -> list[Info]:
    found: list[Info] = pickle.loads((folder / f"carla_infos_{name}.pkl").read_bytes())["infos"]
    return found


def points_in(box: np.ndarray, points: np.ndarray) -> int:
    """As the released code has boxes: y to the right, a heading of (cos yaw, −sin yaw), full
    lengths, centres.
    """
    x, y, z = (points - box[:3]).T
    cos, sin = np.cos(box[6]), -np.sin(box[6])
    length, width, height = box[3:6] / 2 + 1e-6
    along, across = x * cos + y * sin, y * cos - x * sin
    return int(
        ((np.abs(along) <= length) & (np.abs(across) <= width) & (np.abs(z) <= height)).sum()
    )


def disagreement(da: DeepAccident, found: list[Info]) -> float:
    """The share of seen boxes whose points in the release's own clouds are not as many as the
    labels say.
    """
    wrong = total = 0
    for info in found:
        with np.load(
            da.dataroot / Path(info["lidar_path"]).relative_to("data/DeepAccident_data")
        ) as archive:
            points = next(iter(archive.values()))[:, :3]
        boxes = info["gt_boxes"]
        seen = info["num_lidar_pts"] > 0
        counts = np.array([points_in(box, points) for box in boxes[seen]])
        wrong += int(
            (
                np.abs(counts - info["num_lidar_pts"][seen])
                > 1 + 0.02 * info["num_lidar_pts"][seen]
            ).sum()
        )
        total += int(seen.sum())
    assert total > 100
    return wrong / total


def test_boxes_hold_the_points_that_their_labels_count(
    da: DeepAccident, exported: Exported
) -> None:
    assert disagreement(da, infos(exported.folder)) == 0


def test_every_agents_keyframes_are_there_in_order(da: DeepAccident, exported: Exported) -> None:
    for split in ("train", "val"):
        found = infos(exported.folder, split)
        here = [record for record in da.scenario if record["split"] == split]
        assert sorted(
            (f"{each['scenario_type']}/{each['vehicle_name']}", each["timestamp"]) for each in found
        ) == sorted(
            (f"{record['scenario_type']}/{agent}", number)
            for record in here
            for agent in AGENTS
            for number in (1, 6)
        )
    assert exported.tally.samples == 2 * len(AGENTS) * len(da.scenario)


@pytest.mark.parametrize("split", ["train_mini", "val_mini"])
def test_mini_splits_have_files_of_their_own(
    da: DeepAccident, exported: Exported, split: str
) -> None:
    content = pickle.loads((exported.folder / f"carla_infos_{split}.pkl").read_bytes())
    assert content["metadata"] == {"version": "v1.0-mini"}
    expected = {token.split("/")[0] for token in da.split_scenarios(split)}
    assert {info["scenario_type"] for info in content["infos"]} == expected


def test_scenarios_of_no_split_or_without_labels_are_left_out_and_counted(
    own_release: Path, tmp_path: Path
) -> None:
    shutil.rmtree(next(own_release.glob("train/*_normal")) / "infrastructure" / "label")
    dataset = DeepAccident("v1", own_release, verbose=False)
    made = export_release(dataset, tmp_path / "out", ReleasedInfos(root_prefix="./DeepAccident"))
    assert made.tally.left_out == {
        "scenarios that are neither in train nor in val": 2,
        "scenarios without labels": 1,
    }
    assert {info["scenario_type"] for info in infos(made.folder, "train")} == {
        "type1_subtype1_accident"
    }


def test_paths_lead_to_the_files_in_either_layout(
    da: DeepAccident, exported: Exported, da_b: DeepAccident, tmp_path: Path
) -> None:
    made = export_release(da_b, tmp_path / "out", ReleasedInfos(root_prefix="./DeepAccident/"))
    for dataset, folder, prefix in (
        (da, exported.folder, FOLDER),
        (da_b, made.folder, "./DeepAccident"),
    ):
        info = infos(folder)[0]
        path = info["lidar_path"]
        assert path.startswith(prefix)
        assert path.split("/")[3] == info["scenario_type"]  # where the released code looks for it
        calib = dataset.dataroot / f"{Path(path).relative_to(prefix)}".replace(
            "lidar01", "calib"
        ).replace(".npz", ".pkl")
        assert calib.is_file()


@pytest.mark.parametrize("drop", [False, True])
def test_infos_without_boxes(
    own_release: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, *, drop: bool
) -> None:
    path = next(own_release.glob("val/*_accident/other_vehicle/label/*/*_004.txt"))
    path.write_text(path.read_text().splitlines()[0])
    dataset, listed = (
        DeepAccident("v1", own_release, verbose=False),
        tmp_path / "out/carla_infos_without_boxes.txt",
    )
    form = ReleasedInfos(root_prefix="./DeepAccident", split="val", drop_empty=drop)
    with caplog.at_level(logging.WARNING):
        made = export_release(dataset, tmp_path / "out", form)
    boxless = [info["lidar_prefix"] for info in infos(made.folder) if not len(info["gt_boxes"])]
    if drop:
        assert (made.tally.left_out, boxless, listed.exists()) == (
            {"infos without boxes": 1},
            [],
            False,
        )
    else:
        assert (
            listed.read_text().splitlines()
            == boxless
            == [f"type1_subtype2_accident_other_vehicle_{path.stem}"]
        )
        assert ("1 infos have no boxes" in caplog.text, made.tally.left_out) == (True, {})


def test_the_command_of_mmdet3d_has_the_style(da: DeepAccident, tmp_path: Path) -> None:
    words = (
        "--out",
        str(tmp_path / "out"),
        "--split",
        "val",
        "--style",
        "released",
        "--root-prefix",
        "./a/b",
    )
    run = CliRunner().invoke(export, ["mmdet3d", str(da.dataroot), *words, "--workers", "1"])
    assert (run.exit_code, "20 samples: a few files to write" in run.output) == (0, True)
    assert infos(tmp_path / "out")[0]["lidar_path"].startswith("./a/b/type1_")
    assert not (tmp_path / "out" / "v1.0-deepaccident").exists()


@pytest.mark.parametrize(
    ("opened", "prefix", "fitting"),
    [("da", "data/DeepAccident_data/", FOLDER), ("da_b", FOLDER, "./DeepAccident")],
)
def test_a_prefix_of_other_length_is_refused(
    request: pytest.FixtureRequest, tmp_path: Path, opened: str, prefix: str, fitting: str
) -> None:
    out, form = tmp_path / "out", ReleasedInfos(root_prefix=prefix)
    export = partial(export_release, request.getfixturevalue(opened), out, form)
    assert_refused(
        (
            export,
            ChoiceError,
            ("three parts before the scenario type", f"give {fitting}, or another"),
        )
    )
    assert not out.exists()
