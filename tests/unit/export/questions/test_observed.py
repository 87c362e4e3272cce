"""A question holds nothing of the future, of actors that nobody of its set sees, and no word that
tells its ending.
"""

import errno
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from question_files import Asked, accident_of, ask

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
def before(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Asked:
    """The questions of the release as it is."""
    return ask(da_motion, tmp_path_factory.mktemp("before"), FORM)


def edited(dataset: DeepAccident, folder: Path, edit: Edit) -> Asked:
    """The questions of a copy of a release whose accident was edited."""
    root, token = folder / "edited", accident_of(dataset)
    shutil.copytree(dataset.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident"))
    edit(
        ScenarioEditor(
            root, next(each for each in find_release(root, "v1").scenarios if each.token == token)
        )
    )
    return ask(DeepAccident(dataroot=root, verbose=False, workers=1), folder, FORM)


def of_all_rows(change: Callable[[list[str]], None], **which: Any) -> Edit:
    """Changes rows of the labels of all agents, at all frames."""

    def edit(editor: ScenarioEditor) -> None:
        for agent in editor.agents:
            editor.edit_rows(agent, editor.frames, change, **which)

    return edit


def without_collision(editor: ScenarioEditor) -> None:
    path = editor.root / editor.scenario.scenario_type / "meta" / f"{editor.scenario.name}.txt"
    write_meta(path, replace(read_meta(path), collision=None, planned_agents=None))


def test_what_comes_after_the_present_changes_nothing(
    da_motion: DeepAccident, before: Asked, tmp_path: Path
) -> None:
    scenario, present = accident_of(da_motion), 20

    def shift(row: list[str]) -> None:
        row[FIELD["x"]], row[FIELD["id"]] = (
            str(float(row[FIELD["x"]]) - 7),
            str(int(row[FIELD["id"]]) + 3000),
        )
        row[FIELD["vx"]], row[FIELD["num_lidar_pts"]], row[FIELD["camera_visible"]] = (
            "55.5",
            "900",
            "True",
        )
        row[FIELD["class"]], row[FIELD["l"]] = "truck", "9.5"

    def edit(editor: ScenarioEditor) -> None:
        for agent in editor.agents:
            editor.edit_rows(agent, range(present + 1, editor.frames[-1] + 1), shift)
            editor.edit_calib(
                agent, range(present + 1, editor.frames[-1] + 1), "ego_to_world", _moved
            )
        without_collision(editor)

    after = edited(da_motion, tmp_path, edit)
    earlier = [
        sample
        for sample in before.lines
        if sample.startswith(scenario) and int(sample[-3:]) <= present
    ]
    later = [
        sample
        for sample in before.lines
        if sample.startswith(scenario) and int(sample[-3:]) > present
    ]
    assert len(earlier) == len(later) == 2
    assert all(before.lines[sample] == after.lines[sample] for sample in earlier)
    assert all(before.lines[sample] != after.lines[sample] for sample in later)
    assert all(
        before.truth[sample]["accident"] != after.truth[sample]["accident"] for sample in earlier
    )


def _moved(pose: AnyArray) -> AnyArray:
    moved = np.array(pose)
    moved[:2, 3] += 2.5
    return moved


def test_an_unknown_speed_is_not_taken_from_the_moment_after(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    found = edited(da_motion, tmp_path, of_all_rows(_without_speed))
    sample = next(sample for sample in found.lines if sample.startswith(accident_of(da_motion)))
    assert {speed for actor in found.question(sample)["actors"] for speed in actor["speed"]} == {
        None
    }


def _without_speed(row: list[str]) -> None:
    row[FIELD["vx"]] = row[FIELD["vy"]] = "nan"


def unseen_actor(dataset: DeepAccident, asked: Asked) -> int:
    """An actor of the accident that has rows in labels of the set, but stands in no question."""
    scenario = accident_of(dataset)
    shown = {actor for truth in asked.truth.values() for actor in truth["actors"].values()}
    rows = [
        dataset.boxes(f"{scenario}/{agent}/020", "lidar")
        for agent in ("ego_vehicle", "ego_vehicle_behind")
    ]
    far = {
        int(actor)
        for boxes in rows
        for actor, center in zip(boxes.actor_id, boxes.center, strict=True)
        if actor > 0 and np.hypot(*center[:2]) > 25
    }
    return min(far - shown)


@pytest.mark.parametrize("change", ["gone", "moved"])
def test_an_actor_that_nobody_of_the_set_sees_changes_nothing(
    da_motion: DeepAccident, before: Asked, tmp_path: Path, change: str
) -> None:
    actor = unseen_actor(da_motion, before)

    def leave_out(editor: ScenarioEditor) -> None:
        for agent, frame in product(editor.agents, editor.frames):
            first, *rows = editor.rows(agent, frame)
            editor.write_rows(
                agent, frame, [first, *(row for row in rows if int(row[FIELD["id"]]) != actor)]
            )

    edit = leave_out if change == "gone" else of_all_rows(_pushed, actor=actor)
    assert edited(da_motion, tmp_path, edit).lines == before.lines


def _pushed(row: list[str]) -> None:
    for name in ("x", "y"):
        row[FIELD[name]] = str(float(row[FIELD[name]]) * 1.1)


def test_an_actor_that_is_seen_changes_something(
    da_motion: DeepAccident, before: Asked, tmp_path: Path
) -> None:
    sample = next(sample for sample in before.truth if sample.startswith(accident_of(da_motion)))
    push = of_all_rows(_pushed, actor=before.truth[sample]["actors"]["a1"])
    assert edited(da_motion, tmp_path, push).lines[sample] != before.lines[sample]


@pytest.mark.parametrize(
    "form", [FORM, replace(FORM, observers="all", seen="annotated", agents=AGENTS)]
)
def test_no_word_of_the_release_or_of_the_ending_is_in_a_question(
    da_motion: DeepAccident, tmp_path: Path, form: Questions
) -> None:
    found = ask(da_motion, tmp_path, form)
    text = b"\n".join(found.lines.values()).decode().lower()
    words = set(re.findall(r"[a-z0-9_]+", text))
    told = [
        word
        for scenario in da_motion.scenario
        for word in re.split(r"[/_]", scenario["token"].lower())
    ]
    agents = {word for agent in AGENTS for word in (agent, *agent.split("_"))} - {
        "ego",
        "vehicle",
        "infrastructure",
    }
    for word in {
        "accident",
        "normal",
        "collision",
        "impact",
        "split",
        "train",
        "val",
        "direction",
        *told,
        *agents,
    }:
        assert word not in text or word.isdigit(), word
    ids = {str(actor) for truth in found.truth.values() for actor in truth["actors"].values()}
    assert (len(ids) > 10, ids & words) == (True, set())
    keys = {key for sample in found.lines for key in found.question(sample)}
    assert keys == {"id", "seconds", "moments", "conditions", "observers", "actors"}


def test_ids_and_order_are_drawn_by_the_seed(
    da_motion: DeepAccident, before: Asked, tmp_path: Path
) -> None:
    again, other = (
        ask(da_motion, tmp_path, form) for form in (FORM, replace(FORM, seed="a secret"))
    )
    assert list(before.lines.items()) == list(again.lines.items())
    assert not {each["id"] for each in before.truth.values()} & {
        each["id"] for each in other.truth.values()
    }
    assert list(before.lines) not in (list(other.lines), sorted(before.lines))


@pytest.mark.parametrize("way", ["hard", "copy"])
def test_pictures_have_neutral_names_and_show_no_path(
    da: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    """Copies where hard links cannot be."""
    if way == "copy":
        monkeypatch.setattr("deepaccident_devkit.export.format.os.link", _refusing)
    form = Questions(
        observers="+infrastructure",
        cameras=("Camera_Front", "Camera_Back"),
        window=WindowRules(observe=0, stride=0.5),
    )
    found = ask(da, tmp_path, form)
    folder = found.done.folder / "questions"
    for sample in found.lines:
        question = found.question(sample)
        listed, observers = question["images"], found.truth[sample]["observers"]
        assert len(listed) == len(question["moments"]) * 2 * 2
        for each in listed:
            frame = int(sample[-3:]) + round(each["time"] * 10)
            scenario = sample.rsplit("/", 2)[0]
            path = da.get_sample_data_path(
                f"{scenario}/{observers[each['observer']]}/{frame:03d}/{each['camera']}"
            )
            assert (folder / each["path"]).read_bytes() == path.read_bytes()
            assert each["path"].startswith(f"images/{question['id']}/")
    paths = [path for path in folder.rglob("*") if path.is_file()]
    assert not any(path.is_symlink() for path in paths)
    assert not any(
        re.search(r"accident|normal|scenario|town", str(path.relative_to(folder)).lower())
        for path in paths
    )
    assert (
        found.done.tally.linked == {way: sum(path.suffix == ".jpg" for path in paths)} != {way: 0}
    )


def _refusing(*_: object) -> None:
    raise OSError(errno.EXDEV, "Invalid cross-device link")
