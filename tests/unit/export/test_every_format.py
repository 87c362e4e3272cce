"""All formats of `deepaccident export`: each is opened here, and has the K of the very images that
it holds.
"""

import json
import pickle
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from mcap_reading import read_mcap
from nuscenes_reader import tables_of
from opencood_reader import facts_of
from verbs import called

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli.export import export
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.mmdet3d import Mmdet3d
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.export.webdataset import WebDataset
from deepaccident_devkit.release.images import write_image
from deepaccident_devkit.testing import SmallRelease, write_small_release

pytestmark = pytest.mark.slow

SIZE = (20, 30)
Found = dict[str, tuple[Any, tuple[int, int] | None]]
"""Camera → K and, where the format has it, the size."""


@pytest.fixture(scope="module")
def resized(tmp_path_factory: pytest.TempPathFactory) -> tuple[DeepAccident, str]:
    """A release in which one image of the last moment, here the token of its sample, has another
    size and shape.
    """
    root = tmp_path_factory.mktemp("resized") / "release"
    channels = ("Camera_Front", "Camera_Back", "lidar01")
    write_small_release(
        root, SmallRelease(splits=("val",), agents=("ego_vehicle",), channels=channels)
    )
    dataset = DeepAccident("v1", root, verbose=False)
    token = f"{dataset.scenario[0]['token']}/ego_vehicle/003"
    write_image(
        dataset.get_sample_data_path(token, "Camera_Front"),
        np.zeros((SIZE[1], SIZE[0], 3), np.uint8),
    )
    return dataset, token


def opencood(out: Path, token: str) -> Found:
    (scenario,) = out.glob(f"*/{token.split('/ego', maxsplit=1)[0].replace('/', '__')}")
    facts = facts_of(scenario, "1", "000003")
    return {
        name: (facts[theirs]["intrinsic"], None)
        for name, theirs in (("Front", "camera0"), ("Back", "camera3"))
    }


def webdataset(out: Path, token: str) -> Found:
    (shard,) = out.glob("*.tar")
    with tarfile.open(shard) as archive:
        content = archive.extractfile(f"{token}.json")
        assert content is not None
        cameras = json.load(content)["cameras"]
    found = {name: cameras[f"camera_{name.lower()}"] for name in ("Front", "Back")}
    return {
        name: (each["intrinsic"], (each["width"], each["height"])) for name, each in found.items()
    }


def nuscenes(out: Path, token: str) -> Found:
    tables, found = tables_of(out / "v1.0-deepaccident"), {}
    for row in tables["sample_data"].values():
        key = tables["sample"][row["sample_token"]]
        if key["deepaccident_token"] == token and row["is_key_frame"]:
            k = tables["calibrated_sensor"][row["calibrated_sensor_token"]]["camera_intrinsic"]
            found[row["filename"].split("/")[1].removeprefix("CAM_").title()] = (
                k,
                (row["width"], row["height"]),
            )
    return found


def mmdet3d(out: Path, token: str) -> Found:
    infos = pickle.loads((out / "deepaccident_infos_val.pkl").read_bytes())["data_list"]
    frame = {"scenario": token.rsplit("/", 2)[0], "agent": "ego_vehicle", "frame": 3}
    (info,) = (each for each in infos if each["deepaccident"] == frame)
    return {
        name: (info["images"][f"CAM_{name.upper()}"]["cam2img"], None) for name in ("Front", "Back")
    }


@pytest.mark.parametrize(
    ("forms", "read"),
    [
        ((OpenCood(),), opencood),
        ((WebDataset(),), webdataset),
        ((NuScenes(),), nuscenes),
        ((NuScenes(), Mmdet3d()), mmdet3d),
    ],
)
def test_k_is_of_the_file_that_is_there(
    resized: tuple[DeepAccident, str],
    tmp_path: Path,
    forms: tuple[Any, ...],
    read: Callable[[Path, str], Found],
) -> None:
    dataset, token = resized
    for form in forms:
        export_release(dataset, tmp_path / "out", form, workers=1)
    found = read(tmp_path / "out", token)
    for name, size in (("Front", SIZE), ("Back", None)):
        lens = dataset.camera(token, f"Camera_{name}")
        width, height = size or (lens.width, lens.height)
        k, told = found[name]
        np.testing.assert_allclose(
            k, np.diag([width / lens.width, height / lens.height, 1]) @ lens.intrinsic
        )
        assert told in (None, (width, height))
        assert (lens.width, lens.height) != SIZE


def first_line(out: Path) -> Any:
    return json.loads(next(out.rglob("truth.jsonl")).read_text(encoding="utf-8").splitlines()[0])


def tar_names(out: Path) -> list[str]:
    with tarfile.open(next(out.glob("*.tar"))) as archive:
        return archive.getnames()


def parquet_tokens(out: Path) -> list[str]:
    from pyarrow.parquet import read_table

    return read_table(next(out.glob("sample/*.parquet")))["token"].to_pylist()


OPENERS: dict[str, Callable[[Path], Any]] = {
    "mcap": lambda out: read_mcap(next(out.glob("*.mcap"))),
    "mmdet3d": lambda out: pickle.loads(next(out.glob("*_val.pkl")).read_bytes())["data_list"],
    "nuscenes": lambda out: tables_of(out / "v1.0-deepaccident")["sample"],
    "opencood": lambda out: sorted(out.rglob("*.yaml")),
    "parquet": parquet_tokens,
    "questions": first_line,
    "town-maps": lambda out: json.loads(next(out.glob("*.geojson")).read_text(encoding="utf-8"))[
        "features"
    ],
    "webdataset": tar_names,
}
"""Format → function that opens what `deepaccident export FORMAT` wrote and returns some of it."""


@pytest.mark.parametrize("name", export.list_commands(click.Context(export)))
def test_every_format_of_the_command_line_can_be_opened(
    name: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    assert name in OPENERS, f"add a function that opens the format {name} to OPENERS"
    out = tmp_path / ("scene.mcap" if name == "mcap" else "out")
    dataset = request.getfixturevalue(
        "da_motion" if name == "questions" else "da"
    )  # questions need longer recordings
    options = ("--observe", "1", "--ahead", "1") if name == "questions" else ()
    called("export", name, dataset.dataroot, "--out", out, *options)
    assert OPENERS[name](tmp_path if name == "mcap" else out)
