"""Open every format of `deepaccident export`; its intrinsics must fit the images that it holds."""

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from support.command_calls import invoke_command
from support.mcap_reader import read_mcap
from support.nuscenes_reader import read_tables
from support.opencood_reader import read_facts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli.export import export
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.mmdet3d import Mmdet3d
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.release.images import write_image
from deepaccident_devkit.testing import SmallRelease, write_small_release

pytestmark = pytest.mark.slow

SIZE = (20, 30)
Intrinsics = dict[str, tuple[Any, tuple[int, int] | None]]
"""Intrinsic matrix by camera and, where the format has it, width and height of the image."""


@pytest.fixture(scope="module")
def resized(tmp_path_factory: pytest.TempPathFactory) -> tuple[DeepAccident, str]:
    """A release in which one image of the last moment has another size and shape, and the token of
    that sample.
    """
    root = tmp_path_factory.mktemp("resized") / "release"
    channels = ("Camera_Front", "Camera_Back", "lidar01")
    write_small_release(
        root, SmallRelease(splits=("val",), agents=("ego_vehicle",), channels=channels)
    )
    dataset = DeepAccident("v1", root, verbose=False)
    token = f"{dataset.scenario[0]['token']}/ego_vehicle/003"
    path = dataset.get_sample_data_path(token, "Camera_Front")
    write_image(path, np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
    return dataset, token


def read_opencood(out: Path, token: str) -> Intrinsics:
    scenario_token, _, _ = token.partition("/ego")
    (scenario,) = out.glob(f"*/{scenario_token.replace('/', '__')}")
    facts = read_facts(scenario, "1", "000003")
    front, back = facts["camera0"], facts["camera3"]
    return {"Front": (front["intrinsic"], None), "Back": (back["intrinsic"], None)}


def read_nuscenes(out: Path, token: str) -> Intrinsics:
    tables = read_tables(out / "v1.0-deepaccident")
    intrinsics = {}
    for row in tables["sample_data"].values():
        sample = tables["sample"][row["sample_token"]]
        if sample["deepaccident_token"] == token and row["is_key_frame"]:
            name = row["filename"].split("/")[1].removeprefix("CAM_").title()
            sensor = tables["calibrated_sensor"][row["calibrated_sensor_token"]]
            intrinsics[name] = (sensor["camera_intrinsic"], (row["width"], row["height"]))
    return intrinsics


def read_mmdet3d(out: Path, token: str) -> Intrinsics:
    infos = pickle.loads((out / "deepaccident_infos_val.pkl").read_bytes())["data_list"]
    source = {"scenario": token.rsplit("/", 2)[0], "agent": "ego_vehicle", "frame": 3}
    (info,) = [info for info in infos if info["deepaccident"] == source]
    front, back = info["images"]["CAM_FRONT"], info["images"]["CAM_BACK"]
    return {"Front": (front["cam2img"], None), "Back": (back["cam2img"], None)}


@pytest.mark.parametrize(
    ("forms", "read"),
    [
        ((OpenCood(),), read_opencood),
        ((NuScenes(),), read_nuscenes),
        ((NuScenes(), Mmdet3d()), read_mmdet3d),
    ],
)
def test_intrinsics_fit_the_size_of_each_image(
    resized: tuple[DeepAccident, str],
    tmp_path: Path,
    forms: tuple[Any, ...],
    read: Callable[[Path, str], Intrinsics],
) -> None:
    dataset, token = resized
    for form in forms:
        export_release(dataset, tmp_path / "out", form, workers=1)
    intrinsics = read(tmp_path / "out", token)
    for name, resized_size in (("Front", SIZE), ("Back", None)):
        camera = dataset.camera(token, f"Camera_{name}")
        assert (camera.width, camera.height) != SIZE
        width, height = resized_size or (camera.width, camera.height)
        scale = np.diag([width / camera.width, height / camera.height, 1])
        intrinsic, size = intrinsics[name]
        np.testing.assert_allclose(intrinsic, scale @ camera.intrinsic)
        assert size in (None, (width, height))


def read_first_truth(out: Path) -> Any:
    path = next(out.rglob("truth.jsonl"))
    return json.loads(path.read_text(encoding="utf-8").splitlines()[0])


def read_town_maps(out: Path) -> Any:
    return json.loads(next(out.glob("*.geojson")).read_text(encoding="utf-8"))["features"]


def read_clip_rows(out: Path) -> list[str]:
    return (out / "frames.csv").read_text(encoding="utf-8").splitlines()[1:]


def read_parquet_tokens(out: Path) -> list[str]:
    from pyarrow.parquet import read_table

    return read_table(next(out.glob("sample/*.parquet")))["token"].to_pylist()


def read_track_ids(out: Path) -> list[str]:
    from pyarrow.parquet import read_table

    return read_table(next(out.rglob("scenario_*.parquet")))["track_id"].to_pylist()


OPENERS: dict[str, Callable[[Path], Any]] = {
    "av2": read_track_ids,
    "clips": read_clip_rows,
    "mcap": lambda out: read_mcap(next(out.glob("*.mcap"))),
    "mmdet3d": lambda out: pickle.loads(next(out.glob("*_val.pkl")).read_bytes())["data_list"],
    "nuscenes": lambda out: read_tables(out / "v1.0-deepaccident")["sample"],
    "opencood": lambda out: sorted(out.rglob("*.yaml")),
    "parquet": read_parquet_tokens,
    "questions": read_first_truth,
    "release": lambda out: DeepAccident("v1", out, verbose=False).sample[:],
    "town-maps": read_town_maps,
}
"""Function that opens the output of `deepaccident export FORMAT` and returns a part of it, by
format.
"""


@pytest.mark.parametrize("name", export.list_commands(click.Context(export)))
def test_every_format_of_the_command_line_can_be_opened(
    name: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    assert name in OPENERS, f"add a function that opens the format {name} to OPENERS"

    out = tmp_path / ("scene.mcap" if name == "mcap" else "out")
    fixture, options = "da", ()
    if name == "questions":  # which need longer recordings
        fixture, options = "da_motion", ("--observe", 1, "--ahead", 1)
    dataset = request.getfixturevalue(fixture)
    invoke_command("export", name, dataset.dataroot, "--out", out, *options)

    assert OPENERS[name](tmp_path if name == "mcap" else out)
