"""A question shows neither the future, nor actors that no observer sees, nor words that reveal the
ending.
"""

import errno
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from support.question_files import QuestionFiles, accident_scenario, export_and_read

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.questions import Questions, WindowRules
from deepaccident_devkit.release import read_meta
from deepaccident_devkit.release.layout import find_release
from deepaccident_devkit.release.meta import write_meta
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.testing.breakages.breakage import FIELD, ScenarioEditor

pytestmark = pytest.mark.slow

FORM = Questions(observers="+behind", window=WindowRules(observe=1.0, stride=0.5))
Edit = Callable[[ScenarioEditor], None]


@pytest.fixture(scope="module")
def before(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> QuestionFiles:
    """The questions of the release as it is."""
    return export_and_read(da_motion, tmp_path_factory.mktemp("before"), FORM)


def ask_after_edit(dataset: DeepAccident, folder: Path, edit: Edit) -> QuestionFiles:
    """Ask about a copy of a release after an edit of the accident."""
    root = folder / "edited"
    shutil.copytree(dataset.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident"))
    accident = accident_scenario(dataset)
    (scenario,) = [
        scenario for scenario in find_release(root, "v1").scenarios if scenario.token == accident
    ]
    edit(ScenarioEditor(root, scenario))
    edited = DeepAccident(dataroot=root, verbose=False, workers=1)
    return export_and_read(edited, folder, FORM)


def edit_all_rows(change: Callable[[list[str]], None], **selection: Any) -> Edit:
    """Return an edit that changes label rows of all agents at all frames."""

    def edit(editor: ScenarioEditor) -> None:
        for agent in editor.agents:
            editor.edit_rows(agent, editor.frames, change, **selection)

    return edit


def remove_collision(editor: ScenarioEditor) -> None:
    path = editor.root / editor.scenario.scenario_type / "meta" / f"{editor.scenario.name}.txt"
    write_meta(path, replace(read_meta(path), collision=None, planned_agents=None))


def push_away(row: list[str]) -> None:
    for name in ("x", "y"):
        row[FIELD[name]] = str(float(row[FIELD[name]]) * 1.1)


def test_what_comes_after_the_present_changes_nothing(
    da_motion: DeepAccident, before: QuestionFiles, tmp_path: Path
) -> None:
    scenario = accident_scenario(da_motion)
    present = 20

    def change_row(row: list[str]) -> None:
        changes = {
            "x": float(row[FIELD["x"]]) - 7,
            "id": int(row[FIELD["id"]]) + 3000,
            "vx": 55.5,
            "num_lidar_pts": 900,
            "camera_visible": True,
            "class": "truck",
            "l": 9.5,
        }
        for name, value in changes.items():
            row[FIELD[name]] = str(value)

    def move_pose(pose: AnyArray) -> AnyArray:
        moved = np.array(pose)
        moved[:2, 3] += 2.5
        return moved

    def edit(editor: ScenarioEditor) -> None:
        future = range(present + 1, editor.frames[-1] + 1)
        for agent in editor.agents:
            editor.edit_rows(agent, future, change_row)
            editor.edit_calib(agent, future, "ego_to_world", move_pose)
        remove_collision(editor)

    after = ask_after_edit(da_motion, tmp_path, edit)
    num_earlier = num_later = 0
    for sample in before.lines:
        if not sample.startswith(scenario):
            continue
        if int(sample[-3:]) <= present:
            num_earlier += 1
            assert before.lines[sample] == after.lines[sample]
            assert before.truth[sample]["accident"] != after.truth[sample]["accident"]
        else:
            num_later += 1
            assert before.lines[sample] != after.lines[sample]

    assert num_earlier == num_later == 2


def test_an_unknown_speed_is_not_taken_from_the_moment_after(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    def remove_speed(row: list[str]) -> None:
        row[FIELD["vx"]] = row[FIELD["vy"]] = "nan"

    after = ask_after_edit(da_motion, tmp_path, edit_all_rows(remove_speed))
    scenario = accident_scenario(da_motion)
    sample = next(sample for sample in after.lines if sample.startswith(scenario))
    actors = after.question(sample)["actors"]

    assert {speed for actor in actors for speed in actor["speed"]} == {None}


def find_unseen_actor(dataset: DeepAccident, questions: QuestionFiles) -> int:
    """Find an actor of the accident that the observers' labels list but no question shows."""
    scenario = accident_scenario(dataset)
    candidates = set()
    for agent in ("ego_vehicle", "ego_vehicle_behind"):
        boxes = dataset.boxes(f"{scenario}/{agent}/020", "lidar")
        is_far = np.hypot(boxes.center[:, 0], boxes.center[:, 1]) > 25
        candidates |= set(boxes.actor_id[is_far & (boxes.actor_id > 0)].tolist())
    for truth in questions.truth.values():
        candidates -= set(truth["actors"].values())
    return min(candidates)


@pytest.mark.parametrize("change", ["gone", "moved"])
def test_an_actor_that_no_observer_sees_changes_nothing(
    da_motion: DeepAccident, before: QuestionFiles, tmp_path: Path, change: str
) -> None:
    actor = find_unseen_actor(da_motion, before)

    def remove_actor(editor: ScenarioEditor) -> None:
        for agent, frame in product(editor.agents, editor.frames):
            own_row, *rows = editor.rows(agent, frame)
            other_rows = [row for row in rows if int(row[FIELD["id"]]) != actor]
            editor.write_rows(agent, frame, [own_row, *other_rows])

    edit = remove_actor if change == "gone" else edit_all_rows(push_away, actor=actor)

    assert ask_after_edit(da_motion, tmp_path, edit).lines == before.lines


def test_an_actor_that_is_seen_changes_the_question(
    da_motion: DeepAccident, before: QuestionFiles, tmp_path: Path
) -> None:
    scenario = accident_scenario(da_motion)
    sample = next(sample for sample in before.truth if sample.startswith(scenario))
    push_first_actor = edit_all_rows(push_away, actor=before.truth[sample]["actors"]["a1"])
    after = ask_after_edit(da_motion, tmp_path, push_first_actor)
    assert after.lines[sample] != before.lines[sample]


@pytest.mark.parametrize(
    "form", [FORM, replace(FORM, observers="all", seen="annotated", agents=AGENTS)]
)
def test_no_word_of_the_release_or_of_the_ending_is_in_a_question(
    da_motion: DeepAccident, tmp_path: Path, form: Questions
) -> None:
    questions = export_and_read(da_motion, tmp_path, form)
    text = b"\n".join(questions.lines.values()).decode().lower()
    forbidden_words = {
        *("accident", "normal", "collision", "impact"),
        *("split", "train", "val", "direction"),
    }
    for agent in AGENTS:
        forbidden_words |= {agent, *agent.split("_")} - {"ego", "vehicle", "infrastructure"}
    for scenario in da_motion.scenario:
        forbidden_words |= set(re.split(r"[/_]", scenario["token"].lower()))

    for word in forbidden_words:
        assert word not in text or word.isdigit(), word

    actor_ids = set()
    for truth in questions.truth.values():
        actor_ids |= {str(actor) for actor in truth["actors"].values()}
    assert len(actor_ids) > 10
    assert not actor_ids & set(re.findall(r"[a-z0-9_]+", text))

    keys = {key for sample in questions.lines for key in questions.question(sample)}
    assert keys == {"id", "seconds", "moments", "conditions", "observers", "actors"}


def test_ids_and_order_are_drawn_by_the_seed(
    da_motion: DeepAccident, before: QuestionFiles, tmp_path: Path
) -> None:
    same_seed = export_and_read(da_motion, tmp_path, FORM)
    other_seed = export_and_read(da_motion, tmp_path, replace(FORM, seed="a secret"))
    assert list(before.lines.items()) == list(same_seed.lines.items())

    ids = {truth["id"] for truth in before.truth.values()}
    assert not ids & {truth["id"] for truth in other_seed.truth.values()}
    assert list(before.lines) != list(other_seed.lines)
    assert list(before.lines) != sorted(before.lines)


@pytest.mark.parametrize("link", ["hard", "copy"])
def test_pictures_have_neutral_names_and_show_no_path(
    da: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, link: str
) -> None:
    """Pictures are copied where hard links are impossible."""
    if link == "copy":
        error = OSError(errno.EXDEV, "Invalid cross-device link")
        monkeypatch.setattr("deepaccident_devkit.export.format.os.link", Mock(side_effect=error))
    questions = export_and_read(
        da,
        tmp_path,
        Questions(
            observers="+infrastructure",
            cameras=("Camera_Front", "Camera_Back"),
            window=WindowRules(observe=0, stride=0.5),
        ),
    )
    folder = questions.done.folder / "questions"
    for sample in questions.lines:
        question = questions.question(sample)
        scenario = sample.rsplit("/", 2)[0]
        agents = questions.truth[sample]["observers"]
        assert len(question["images"]) == len(question["moments"]) * 2 * 2

        for image in question["images"]:
            frame = int(sample[-3:]) + round(image["time"] * 10)
            token = f"{scenario}/{agents[image['observer']]}/{frame:03d}"
            path = da.get_sample_data_path(token, image["camera"])
            assert (folder / image["path"]).read_bytes() == path.read_bytes()
            assert image["path"].startswith(f"images/{question['id']}/")

    num_pictures = 0
    for path in folder.rglob("*"):
        if path.is_file():
            assert not path.is_symlink()
            name = str(path.relative_to(folder)).lower()
            assert not re.search(r"accident|normal|scenario|town", name)
            num_pictures += path.suffix == ".jpg"

    assert questions.done.tally.linked == {link: num_pictures}
    assert num_pictures > 0
