"""`deepaccident render`: a verb a view, and what it draws when nobody says what."""

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot as plt
from PIL import Image
from refusals import assert_refused
from verbs import called

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli.render import render
from deepaccident_devkit.cli.render_targets import rows_to_draw
from deepaccident_devkit.errors import ChoiceError, NotAvailableError, TokenError
from deepaccident_devkit.plugins.baselines import predict_results
from deepaccident_devkit.render import detached_figure, render_bev, render_sample_data
from deepaccident_devkit.render.figures import figure_of_pixels, save_picture
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, LIDAR, OWN_ACTOR_ID

pytestmark = pytest.mark.slow

SIZE = (480, 480)
VIEWS = sorted(set(render.commands) - {"evaluation", "video", "replay"})


def run(*words: object) -> str:
    return called("render", *words).output


def pixels(path: Path) -> Any:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


@pytest.fixture(scope="module")
def accident(da: DeepAccident) -> str:
    return next(record["token"] for record in da.scenario if record["collision"])


@pytest.mark.parametrize(
    "verb",
    [*VIEWS, "sample-data --color-by depth", "visibility --style table", "bev --color-by class"],
)
def test_every_view_draws_the_first_accident_when_no_token_is_given(
    da: DeepAccident, accident: str, tmp_path: Path, verb: str
) -> None:
    out = tmp_path / "picture.png"
    options = [
        "--size",
        "{}x{}".format(*SIZE),
        "--dpi",
        40,
        *(["--latency", 0] if verb == "link" else []),
    ]
    text = run(*verb.split(), da.dataroot, "--out", out, *options)
    assert re.fullmatch(rf"rendered: {re.escape(accident)}\S* in {re.escape(str(out))}\n", text)
    drawn = pixels(out)
    colors = np.unique(drawn.reshape(-1, 3), axis=0)
    assert (drawn.shape[:2], len(colors) > 20, plt.get_fignums()) == (SIZE, True, [])


def test_the_picture_is_what_the_function_draws(
    da: DeepAccident, accident: str, tmp_path: Path
) -> None:
    sample = f"{accident}/other_vehicle/003"
    options = [
        "--agents",
        "+infrastructure",
        "--layers",
        "boxes,ids",
        "--layers",
        "grid",
        "--view-range",
        30,
    ]
    run(
        "bev",
        da.dataroot,
        sample,
        *options,
        "--out",
        tmp_path / "a.png",
        "--size",
        "400x400",
        "--dpi",
        80,
    )
    fig = figure_of_pixels(400, 400, dpi=80)
    render_bev(
        da,
        sample,
        agents="+infrastructure",
        layers=["boxes", "ids", "grid"],
        view_range=30,
        ax=fig.add_subplot(),
    )
    save_picture(fig, tmp_path / "b.png", dpi=80)
    np.testing.assert_array_equal(pixels(tmp_path / "a.png"), pixels(tmp_path / "b.png"))


def test_a_link_moves_what_partners_share(da: DeepAccident, accident: str, tmp_path: Path) -> None:
    for name, link in {
        "ideal": [],
        "late": ["--latency", 0.2, "--pose-noise", 2.0, "--seed", 4],
    }.items():
        arguments = [
            "--agents",
            "+other",
            "--out",
            tmp_path / f"{name}.png",
            "--size",
            "400x400",
            "--layers",
            "boxes",
        ]
        run("bev", da.dataroot, f"{accident}/ego_vehicle/005", *arguments, *link)
    assert (pixels(tmp_path / "ideal.png") != pixels(tmp_path / "late.png")).any()


def test_several_rows_go_into_a_folder(da: DeepAccident, accident: str, tmp_path: Path) -> None:
    tokens = [f"{accident}/{agent}/002/Camera_Back" for agent in ("ego_vehicle", "infrastructure")]
    run(
        "sample-data",
        da.dataroot,
        *tokens,
        "--out",
        tmp_path / "drawn",
        "--size",
        "160x90",
        "--dpi",
        40,
    )
    assert {path.name for path in (tmp_path / "drawn").iterdir()} == {
        f"sample-data_{token.replace('/', '_')}.png" for token in tokens
    }


def test_a_range_of_frames_of_a_scenario(da: DeepAccident, accident: str, tmp_path: Path) -> None:
    run(
        "sample",
        da.dataroot,
        accident,
        "--frame-range",
        "2..3",
        "--out",
        tmp_path,
        "--size",
        "640x240",
        "--dpi",
        40,
    )
    assert [path.name[-15:] for path in sorted(tmp_path.iterdir())] == [
        "vehicle_002.png",
        "vehicle_003.png",
    ]


def test_what_is_drawn_without_a_token(da_motion: DeepAccident) -> None:
    scenario = next(record for record in da_motion.scenario if record["collision"])
    token = scenario["token"]
    kinds = ("frame", "sample", "sample_data", "scenario", "annotation", "instance")
    rows = {kind: rows_to_draw(da_motion, kind, [], None) for kind in kinds}
    box = da_motion.get("annotation", rows["annotation"][0])
    actor = da_motion.get("instance", rows["instance"][0])["actor_id"]
    assert (scenario["num_frames"], box["is_collider"], box["actor_id"]) == (35, True, actor)
    assert actor in set(scenario["collision"]["ids"]) - {OWN_ACTOR_ID}
    assert [rows[kind] for kind in kinds[:4]] == [
        [f"{token}/025"],  # one second before the impact
        [f"{token}/ego_vehicle/025"],
        [f"{token}/ego_vehicle/025/Camera_Front"],
        [token],
    ]


def test_a_partial_download_stands_for_the_moment_agent_and_camera_with_most_files(
    motion_root: Path, tmp_path: Path
) -> None:
    root = shutil.copytree(motion_root, tmp_path / "release")
    da = DeepAccident(dataroot=root, verbose=False)
    token = next(record["token"] for record in da.scenario if record["collision"])
    files = {
        ("infrastructure", "Camera_Back"): (5, 20),
        ("infrastructure", "Camera_BackRight"): (5, 20),
    }
    for (agent, channel), frames in (
        files | {(agent, LIDAR): (8, 12, 14) for agent in AGENTS}
    ).items():
        for frame in frames:
            path = da.get_sample_data_path(f"{token}/{agent}/{frame:03d}/{channel}")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
    front, points, later = (CAMERAS[0], LIDAR), (LIDAR,), range(6, 8)
    rows = (
        (rows_to_draw(da, "sample", [], None), "infrastructure/020"),
        (rows_to_draw(da, "sample_data", [token], None), "infrastructure/020/Camera_Back"),
        (rows_to_draw(da, "frame", [], None, front), "014"),
        (rows_to_draw(da, "sample", [], None, points), "ego_vehicle/014"),
        (rows_to_draw(da, "sample", [], None, points, latency=0.4), "ego_vehicle/012"),
        (rows_to_draw(da, "sample", [], None, ()), "ego_vehicle/025"),
        (
            rows_to_draw(da, "sample_data", [], later),
            "ego_vehicle/006/Camera_Front",
        ),  # as it is named
    )
    assert [found[0] for found, _ in rows] == [f"{token}/{expected}" for _, expected in rows]


def test_a_scenario_without_a_collision_has_rows_too(da_motion: DeepAccident) -> None:
    normal = next(record["token"] for record in da_motion.scenario if not record["collision"])
    boxes = da_motion.boxes(f"{normal}/ego_vehicle/025")
    box = da_motion.get("annotation", rows_to_draw(da_motion, "annotation", [normal], None)[0])
    assert box["num_lidar_pts"] == boxes.num_lidar_pts[boxes.actor_id != OWN_ACTOR_ID].max()
    assert rows_to_draw(da_motion, "instance", [normal], None)[0].startswith(f"{normal}/actor/")


def test_evaluation_draws_a_sample_of_the_results(da_motion: DeepAccident, tmp_path: Path) -> None:
    tokens = da_motion.samples("train", "evaluate")[:2]
    results = predict_results(da_motion, "accident", tokens, tmp_path / "results.json", workers=1)
    asked = ["evaluation", da_motion.dataroot, "--results", results, "--out", tmp_path / "a.png"]
    assert tokens[0] in run(*asked, "--size", "600x300")
    assert_refused(
        (
            lambda: run(*asked, "no/such/ego_vehicle/001"),
            TokenError,
            "has no prediction of 'no/such/ego_vehicle/001'",
        )
    )


def test_video_writes_what_is_asked_for(da: DeepAccident, accident: str, tmp_path: Path) -> None:
    out = tmp_path / "v.gif"
    options = [
        "--what",
        "Camera_Front,bev",
        "--agents",
        "infrastructure",
        "--layers",
        "boxes",
        "--frame-range",
        "2..4",
    ]
    assert f"written: {out}, 0." in run(
        "video",
        da.dataroot,
        accident,
        "--out",
        out,
        *options,
        "--size",
        "160x90",
        "--fps",
        5,
        "--workers",
        1,
    )
    with Image.open(out) as image:
        assert (image.size, image.n_frames, image.info["duration"]) == ((160, 90), 3, 200)


def test_video_takes_the_first_accident(da: DeepAccident, tmp_path: Path) -> None:
    run(
        "video",
        da.dataroot,
        "--out",
        tmp_path / "v.webp",
        "--what",
        "accident",
        "--frame-range",
        "6",
        "--size",
        "160x90",
    )
    assert (tmp_path / "v.webp").is_file()


def test_a_release_without_an_accident_shows_its_first_scenario(
    da: DeepAccident, tmp_path: Path
) -> None:
    root = tmp_path / "normal"
    shutil.copytree(da.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident", "*_accident"))
    first = DeepAccident(dataroot=root, verbose=False).scenario[0]["token"]
    for verb in ("frame", "sample", "bev", "sample-data", "instance"):
        assert f"rendered: {first}" in run(
            verb, root, "--out", tmp_path / "a.png", "--size", "480x480"
        )
    run(
        "video",
        root,
        "--out",
        tmp_path / "a.gif",
        "--frame-range",
        "1",
        "--size",
        "320x180",
        "--workers",
        1,
    )
    assert_refused(
        (
            lambda: run("accident", root, "--out", tmp_path / "a.png"),
            NotAvailableError,
            f"no scenario ends in an accident .*, such as {first}$",
        )
    )


def test_what_a_picture_lacks_is_logged(
    da_partial: DeepAccident, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run("bev", da_partial.dataroot, "--agents", "available", "--out", tmp_path / "a.png")
    assert [record.getMessage() for record in caplog.records] == [
        f"{tmp_path / 'a.png'}: no LiDAR file of infrastructure"
    ]


@pytest.mark.parametrize(
    ("suffix", "start"),
    [(".pdf", b"%PDF"), (".svg", b"<?xml"), (".jpg", b"\xff\xd8"), (".webp", b"RIFF")],
)
def test_pictures_of_all_kinds_have_the_same_bytes_each_time(
    da: DeepAccident, accident: str, tmp_path: Path, suffix: str, start: bytes
) -> None:
    contents = []
    for name in ("a", "b"):
        fig = detached_figure((3, 2))
        ax = render_sample_data(
            da, f"{accident}/ego_vehicle/001/Camera_Front", ax=fig.add_subplot()
        )
        contents.append(save_picture(ax, tmp_path / f"{name}{suffix}", dpi=50).read_bytes())
    assert contents[0].startswith(start)
    if suffix != ".svg":  # its ids are drawn by chance
        assert contents[0] == contents[1]
    assert_refused(
        (
            lambda: save_picture(ax, tmp_path / "a.bmp"),
            ChoiceError,
            r"path: expected a file that ends in \.png",
        )
    )
