"""`deepaccident render`: one verb for each view, and what it draws without a token."""

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot as plt
from PIL import Image
from support.command_calls import invoke_command
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli.render import render
from deepaccident_devkit.cli.render_targets import rows_to_draw
from deepaccident_devkit.errors import ChoiceError, NotAvailableError, TokenError
from deepaccident_devkit.plugins.baselines import predict_results
from deepaccident_devkit.render import detached_figure, render_bev, render_sample_data
from deepaccident_devkit.render.figures import figure_of_pixels, save_picture
from deepaccident_devkit.support.text import size_text
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, LIDAR, OWN_ACTOR_ID

pytestmark = pytest.mark.slow

PICTURE_SIZE = (480, 480)
VIEWS = sorted(set(render.commands) - {"evaluation", "video", "replay"})


def run(*words: object) -> str:
    return invoke_command("render", *words).output


def read_pixels(path: Path) -> Any:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


@pytest.fixture(scope="module")
def accident(da: DeepAccident) -> str:
    """The token of the first accident."""
    return first_token(da, collision=True)


def first_token(dataset: DeepAccident, *, collision: bool) -> str:
    return str(dataset.find(collision=collision)[0]["token"])


@pytest.mark.parametrize(
    "verb",
    [*VIEWS, "sample-data --color-by depth", "visibility --style table", "bev --color-by class"],
)
def test_every_view_draws_the_first_accident_when_no_token_is_given(
    da: DeepAccident, accident: str, tmp_path: Path, verb: str
) -> None:
    out = tmp_path / "picture.png"
    options = ["--size", "{}x{}".format(*PICTURE_SIZE), "--dpi", 40]
    if verb == "link":
        options += ["--latency", 0]

    output = run(*verb.split(), da.dataroot, "--out", out, *options)

    assert re.fullmatch(rf"wrote {re.escape(str(out))} \({re.escape(accident)}\S*\)\n", output)
    pixels = read_pixels(out)
    colors = np.unique(pixels.reshape(-1, 3), axis=0)
    assert pixels.shape[:2] == PICTURE_SIZE
    assert len(colors) > 20
    assert plt.get_fignums() == []


def test_the_picture_is_what_the_function_draws(
    da: DeepAccident, accident: str, tmp_path: Path
) -> None:
    sample = f"{accident}/other_vehicle/003"
    layers = ("--layers", "boxes,ids", "--layers", "grid")
    options = ("--agents", "+infrastructure", *layers, "--view-range", 30)
    size = ("--size", "400x400", "--dpi", 80)
    run("bev", da.dataroot, sample, *options, "--out", tmp_path / "verb.png", *size)

    fig = figure_of_pixels(400, 400, dpi=80)
    render_bev(
        da,
        sample,
        agents="+infrastructure",
        layers=["boxes", "ids", "grid"],
        view_range=30,
        ax=fig.add_subplot(),
    )
    save_picture(fig, tmp_path / "function.png", dpi=80)

    np.testing.assert_array_equal(
        read_pixels(tmp_path / "verb.png"), read_pixels(tmp_path / "function.png")
    )


def test_a_link_moves_shared_boxes(da: DeepAccident, accident: str, tmp_path: Path) -> None:
    options = ("--agents", "+other", "--size", "400x400", "--layers", "boxes")
    words = ("bev", da.dataroot, f"{accident}/ego_vehicle/005", *options)
    link = ("--latency", 0.2, "--pose-noise", 2.0, "--seed", 4)
    run(*words, "--out", tmp_path / "ideal.png")
    run(*words, "--out", tmp_path / "late.png", *link)
    assert (read_pixels(tmp_path / "ideal.png") != read_pixels(tmp_path / "late.png")).any()


def test_several_rows_go_into_a_folder(da: DeepAccident, accident: str, tmp_path: Path) -> None:
    tokens = [f"{accident}/{agent}/002/Camera_Back" for agent in ("ego_vehicle", "infrastructure")]
    size = ("--size", "160x90", "--dpi", 40)
    run("sample-data", da.dataroot, *tokens, "--out", tmp_path / "pictures", *size)

    names = {f"sample-data_{token.replace('/', '_')}.png" for token in tokens}
    assert {path.name for path in (tmp_path / "pictures").iterdir()} == names


def test_a_range_of_frames_of_a_scenario(da: DeepAccident, accident: str, tmp_path: Path) -> None:
    options = ("--frame-range", "2..3", "--size", "640x240", "--dpi", 40)
    run("sample", da.dataroot, accident, *options, "--out", tmp_path)
    name_ends = [path.name[-15:] for path in sorted(tmp_path.iterdir())]
    assert name_ends == ["vehicle_002.png", "vehicle_003.png"]


def test_without_a_token_the_collider_is_drawn_two_seconds_before_impact(
    da_motion: DeepAccident,
) -> None:
    scenario = da_motion.find(collision=True)[0]
    token = scenario["token"]
    assert scenario["num_frames"] == 35
    for table, row in (
        ("frame", f"{token}/015"),
        ("sample", f"{token}/ego_vehicle/015"),
        ("sample_data", f"{token}/ego_vehicle/015/Camera_Front"),
        ("scenario", token),
    ):
        assert rows_to_draw(da_motion, table, [], None) == [row]

    box_token = rows_to_draw(da_motion, "annotation", [], None)[0]
    box = da_motion.get("annotation", box_token)
    instance = da_motion.get("instance", rows_to_draw(da_motion, "instance", [], None)[0])
    assert box["is_collider"] is True
    assert box["actor_id"] == instance["actor_id"]
    assert box["actor_id"] in set(scenario["collision"]["ids"]) - {OWN_ACTOR_ID}


def test_all_commands_show_a_partial_download_at_the_moment_with_most_files(
    motion_root: Path, tmp_path: Path
) -> None:
    root = shutil.copytree(motion_root, tmp_path / "release")
    da = DeepAccident(dataroot=root, verbose=False)
    token = first_token(da, collision=True)
    frames_with_file = {
        ("infrastructure", "Camera_Back"): (5, 12, 20),
        ("infrastructure", "Camera_BackRight"): (5, 12, 20),
        **{(agent, LIDAR): (8, 12, 14, 20) for agent in AGENTS},
    }
    for (agent, channel), frames in frames_with_file.items():
        for frame in frames:
            path = da.get_sample_data_path(f"{token}/{agent}/{frame:03d}/{channel}")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()

    # frame 20 is less than two seconds before the end, at 35
    front, points, later = (CAMERAS[0], LIDAR), (LIDAR,), range(6, 8)
    for rows, expected in (
        (rows_to_draw(da, "sample", [], None), "infrastructure/012"),
        (rows_to_draw(da, "sample_data", [token], None), "infrastructure/012/Camera_Back"),
        (rows_to_draw(da, "frame", [], None, front), "012"),
        (rows_to_draw(da, "sample", [], None, points), "ego_vehicle/012"),
        (rows_to_draw(da, "sample", [], None, ()), "ego_vehicle/012"),
        # a range of frames is drawn as it is named
        (rows_to_draw(da, "sample_data", [], later), "ego_vehicle/006/Camera_Front"),
    ):
        assert rows[0] == f"{token}/{expected}"


def test_a_scenario_without_a_collision_has_rows_too(da_motion: DeepAccident) -> None:
    token = first_token(da_motion, collision=False)
    boxes = da_motion.boxes(f"{token}/ego_vehicle/015")
    is_other = boxes.actor_id != OWN_ACTOR_ID

    box_token = rows_to_draw(da_motion, "annotation", [token], None)[0]
    instance_token = rows_to_draw(da_motion, "instance", [token], None)[0]

    box = da_motion.get("annotation", box_token)
    assert box["num_lidar_pts"] == boxes.num_lidar_pts[is_other].max()
    assert instance_token.startswith(f"{token}/actor/")


def test_evaluation_and_video_draw_the_results(da_motion: DeepAccident, tmp_path: Path) -> None:
    tokens = da_motion.samples("train", "evaluate")[:2]
    results = predict_results(da_motion, "accident", tokens, tmp_path / "results.json", workers=1)
    command = ["evaluation", da_motion.dataroot, "--results", results, "--out", tmp_path / "a.png"]
    assert tokens[0] in run(*command, "--size", "600x300")
    message = "has no prediction for 'no/such/ego_vehicle/001'"
    assert_raises((lambda: run(*command, "no/such/ego_vehicle/001"), TokenError, message))

    out = tmp_path / "video.gif"
    video = ["video", da_motion.dataroot, "--out", out, "--size", "320x180", "--workers", 1]
    run(*video, "--beside", f"baseline={results}", "--task", "warning", "--frame-range", "20")
    with Image.open(out) as image:
        assert image.size == (320, 180)
    refusal = invoke_command("render", *video, "--task", "warning", status=2).output
    assert "--task has no effect without a results file" in refusal


def test_video_writes_the_chosen_views(da: DeepAccident, accident: str, tmp_path: Path) -> None:
    out = tmp_path / "video.gif"
    views = ("--what", "Camera_Front,bev", "--agents", "infrastructure", "--layers", "boxes")
    timing = ("--frame-range", "2..4", "--fps", 5)
    words = ("video", da.dataroot, accident, *views, *timing, "--size", "160x90", "--workers", 1)
    output = run(*words, "--out", out)
    assert f"wrote {out} ({size_text(out.stat().st_size)})\n" in output
    with Image.open(out) as image:
        assert image.size == (160, 90)
        assert image.n_frames == 3
        assert image.info["duration"] == 200


def test_a_video_without_titles_differs_from_one_with_titles(
    da: DeepAccident, accident: str, tmp_path: Path
) -> None:
    options = ("--what", "bev", "--frame-range", "3", "--size", "320x180", "--workers", 1)
    run("video", da.dataroot, accident, "--out", tmp_path / "titled.gif", *options)
    run("video", da.dataroot, accident, "--out", tmp_path / "bare.gif", *options, "--no-title")
    assert (tmp_path / "titled.gif").read_bytes() != (tmp_path / "bare.gif").read_bytes()


def test_a_turntable_is_a_view_and_the_twin_is_shown_beside(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    out = tmp_path / "video.gif"
    options = ("--turntable", "--beside", "twin", "--frame-range", "3", "--size", "320x180")
    run("video", da_motion.dataroot, "--out", out, *options, "--workers", 1)
    with Image.open(out) as image:
        assert image.size == (320, 180)


def test_video_takes_the_first_accident(da: DeepAccident, tmp_path: Path) -> None:
    out = tmp_path / "video.webp"
    options = ("--what", "accident", "--frame-range", "6", "--size", "160x90")
    run("video", da.dataroot, "--out", out, *options)
    assert out.is_file()


def test_a_release_without_an_accident_shows_its_first_scenario(
    da: DeepAccident, tmp_path: Path
) -> None:
    root = tmp_path / "normal"
    shutil.copytree(da.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident", "*_accident"))
    first = DeepAccident(dataroot=root, verbose=False).scenario[0]["token"]
    out = tmp_path / "picture.png"
    for verb in ("frame", "sample", "bev", "sample-data", "instance"):
        assert f"wrote {out} ({first}" in run(verb, root, "--out", out, "--size", "480x480")

    options = ("--frame-range", "1", "--size", "320x180", "--workers", 1)
    run("video", root, "--out", tmp_path / "video.gif", *options)

    message = f"no scenario ends in an accident .*, such as {first}$"
    assert_raises((lambda: run("accident", root, "--out", out), NotAvailableError, message))


def test_missing_parts_of_a_picture_are_logged(
    da_partial: DeepAccident, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    out = tmp_path / "picture.png"
    run("bev", da_partial.dataroot, "--agents", "available", "--out", out)
    messages = [record.getMessage() for record in caplog.records]
    assert messages == [f"{out}: no LiDAR file of infrastructure"]


@pytest.mark.parametrize(
    ("suffix", "start"),
    [(".pdf", b"%PDF"), (".svg", b"<?xml"), (".jpg", b"\xff\xd8"), (".webp", b"RIFF")],
)
def test_pictures_of_all_kinds_have_the_same_bytes_each_time(
    da: DeepAccident, accident: str, tmp_path: Path, suffix: str, start: bytes
) -> None:
    image = f"{accident}/ego_vehicle/001/Camera_Front"
    contents = []
    for name in ("a", "b"):
        ax = render_sample_data(da, image, ax=detached_figure((3, 2)).add_subplot())
        path = save_picture(ax, tmp_path / f"{name}{suffix}", dpi=50)
        contents.append(path.read_bytes())
    assert contents[0].startswith(start)
    if suffix != ".svg":  # the ids of an SVG are random
        assert contents[0] == contents[1]
    message = r"path: expected a file that ends in \.png"
    assert_raises((lambda: save_picture(ax, tmp_path / "a.bmp"), ChoiceError, message))
