"""Kinds of files other than releases and results.

They are the files of exports, questions and caches, recipes of studies, the address of a scheduler,
and zipped releases.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from math import prod
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from campaign import other_mutations, plain
from campaign.healthy import AGENTS, CHANNELS, EXPORT, SCHEDULER, open_release
from campaign.kind import (
    Action,
    Kind,
    Output,
    Workspace,
    find_long_sentence,
    open_dataset,
    read_findings,
)
from campaign.tables_of_releases import judge_tables, read_tables
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import WorkerError
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.questions import read_answers, results_of_answers
from deepaccident_devkit.plugins.study import Recipe, read_recipe
from deepaccident_devkit.support.parallel import cluster_executor, executors
from deepaccident_devkit.training.image_cache import ImageCache

assert other_mutations  # importing it registers the mutations for these kinds

_JOURNALS = ".deepaccident-parts/kept/opencood/*.paths"
_DONE_RECORDS = ".deepaccident-parts/kept/opencood/*/done"
_SWEPT_KEYS = ("agents", "latency", "pose_noise", "packet_loss", "budget", "horizon")
"""Keys of a recipe's row whose lists stand for one row for each value."""

# ---- exports


def _resume_export(workspace: Workspace) -> dict[str, bytes]:
    """Run the export again, which resumes a killed one and compares a complete one."""
    folder = _export_folder(workspace)
    export_release(open_dataset(workspace.home), folder, EXPORT, workers=1)
    return _read_yaml_files(folder)


def _export_folder(workspace: Workspace) -> Path:
    path = workspace.changed_file.relative_to(workspace.folder)
    return workspace.folder / path.parts[0]


def _read_yaml_files(folder: Path) -> dict[str, bytes]:
    """Return the contents of a folder's YAML files by their paths, without links."""
    paths = [path for path in folder.rglob("*.yaml") if path.is_file() and not path.is_symlink()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def _judge_export(workspace: Workspace, files: Mapping[str, bytes]) -> str | None:
    """Compare the manifest's settings and scenarios, and the bytes of files, with a whole export.

    Files may be missing: the export trusts records that say that a unit is done.
    """
    whole = workspace.home / "exports" / "whole"
    manifest = plain.read_json(_export_folder(workspace) / "opencood.manifest.json")
    expected = plain.read_json(whole / "opencood.manifest.json")
    if manifest["settings"] != expected["settings"]:
        return "other settings"
    if manifest["release"]["scenarios"] != expected["release"]["scenarios"]:
        return "other scenarios"
    whole_files = _read_yaml_files(whole)
    for name in files.keys() & whole_files.keys():
        if files[name] != whole_files[name]:
            return f"{name} differs from that of a whole export"
    return None


# ---- questions


def _read_answers(workspace: Workspace) -> Any:
    answers = workspace.folder / "answers.jsonl"
    truth = workspace.changed_file
    results_of_answers(answers, truth, workspace.scratch / "results.json")
    return read_answers(answers, truth)


def _judge_answers(workspace: Workspace, output: Any) -> str | None:
    """Compare the actors of all answers, by the sample of their question."""
    lines = workspace.changed_file.read_bytes().split(b"\n")
    question_list = [json.loads(line) for line in lines if line.strip()]
    questions = {question["id"]: question for question in question_list}
    expected: dict[str, list[tuple[int, int]]] = {}
    for question in questions.values():
        recording = question["sample"].rpartition("/")[0]
        expected[question["sample"]] = []
        expected[f"{recording}/{question['last_frame']:03d}"] = []
    for line in (workspace.folder / "answers.jsonl").read_bytes().splitlines():
        answer = json.loads(line)
        question = questions[answer["id"]]
        ids = tuple(question["actors"][name] for name in answer["who"])
        expected[question["sample"]].append(ids)
    ids_by_sample = {}
    for token, accidents in output.accidents.items():
        ids_by_sample[token] = [accident.ids for accident in accidents]
    if ids_by_sample == expected:
        return None
    return "other samples or actors"


# ---- a cache of images


@cache
def _open_sensors(home: Path) -> DeepAccident:
    return open_release(home / "sensors", home / "index_of_sensors")


def _load_cached_images(workspace: Workspace) -> Output:
    """Return the first image of each scenario from the cache."""
    dataset = _open_sensors(workspace.home)
    image_cache = ImageCache(workspace.folder)
    agents = [f"{scenario['token']}/{AGENTS[0]}" for scenario in dataset.scenario]
    image_cache.check_release(dataset, agents)
    images = {}
    for agent in agents:
        token = f"{agent}/001/{CHANNELS[0]}"
        image, *_ = image_cache.load(image_cache.images, dataset, token)
        images[agent] = image.copy()
    return images


def _judge_cached_images(workspace: Workspace, images: Output) -> str | None:
    settings = plain.read_json(workspace.folder / "cache.manifest.json")["settings"]
    image_settings = settings["images"]
    shape = image_settings["resize"]
    if image_settings["crop"] is not None:
        shape = image_settings["crop"][2:]
    position = settings["agents"].index(AGENTS[0])
    camera = image_settings["cameras"].index(CHANNELS[0])
    for agent, image in images.items():
        scenario = agent.rpartition("/")[0].replace("/", "__")
        path = workspace.folder / f"{scenario}.images"
        expected = plain.read_cached_image(path, position, camera, *shape)
        if not np.array_equal(image, expected):
            return f"{agent}: other pixels than numpy reads"
    return None


# ---- the file of a scheduler


def _connect(workspace: Workspace) -> str:
    """Connect to a scheduler; return the healthy file's address where none listens, as expected."""
    path = workspace.changed_file
    try:
        with (
            patch.object(executors, "ADDRESS_WAIT", 0.2),
            cluster_executor(scheduler_file=path),
        ):
            return "a scheduler"
    except WorkerError:
        healthy_content = workspace.healthy_file.read_bytes()
        is_same_size = path.is_file() and path.stat().st_size == len(healthy_content)
        if is_same_size and path.read_bytes() == healthy_content:
            return SCHEDULER
        raise


def _judge_address(workspace: Workspace, address: str) -> str | None:
    expected = plain.read_json(workspace.changed_file)["address"]
    if address == expected:
        return None
    return f"a connection: {address}"


# ---- a release in an archive


def _read_zip(workspace: Workspace) -> Output:
    return read_tables(open_release(workspace.changed_file, workspace.scratch / "index"))


def _judge_zip(workspace: Workspace, output: Output) -> str | None:
    """Compare the tables with the unpacked files, whatever their checksums are."""
    folder = plain.unpack(workspace.changed_file, workspace.scratch / "unpacked")
    return judge_tables(replace(workspace, folder=folder), output)


def _validate_zip(workspace: Workspace) -> list[str]:
    return read_findings(workspace.changed_file, deep=True)


def _judge_findings(workspace: Workspace, sentences: list[str]) -> str | None:
    """Check that the findings name an unreadable archive, or all members with a wrong checksum."""
    fault = find_long_sentence(sentences)
    text = "\n".join(sentences)
    if fault or workspace.changed_file.name in text:
        return fault
    for name, (_, is_right) in plain.read_members(workspace.changed_file).items():
        if not is_right and name.rpartition("/")[2] not in text:
            return f"no word of {name}, which is damaged"
    return None


# ---- recipes of studies


def _judge_recipe(workspace: Workspace, recipe: Recipe) -> str | None:
    """Check names and their order, and that there is a row for each value of the lists."""
    content = plain.read_yaml(workspace.changed_file)
    for name in ("title", "question"):
        if getattr(recipe, name) != content[name]:
            return f"another {name}"
    for name in ("releases", "weights", "groups"):
        if list(getattr(recipe, name)) != list(content.get(name, {})):
            return f"other {name}"
    row_count = 0
    for row in content["rows"]:
        values = [row.get(key) for key in _SWEPT_KEYS]
        row_count += prod(len(value) for value in values if isinstance(value, list))
    if len(recipe.rows) == row_count:
        return None
    return "another number of rows"


_EXPORT_ACTION = Action(_resume_export, _judge_export)
_CACHE_ACTION = Action(_load_cached_images, _judge_cached_images)
KINDS = (
    Kind(
        "export's manifest",
        "manifest",
        "exports",
        "*/opencood.manifest.json",
        (_EXPORT_ACTION,),
        writes=True,
    ),
    Kind(
        "export's journals",
        "journal",
        "exports",
        f"begun/{_JOURNALS}",
        (_EXPORT_ACTION,),
        writes=True,
    ),
    Kind(
        "export's done records",
        "record",
        "exports",
        f"begun/{_DONE_RECORDS}",
        (_EXPORT_ACTION,),
        writes=True,
    ),
    Kind(
        "questions' truth",
        "lines",
        "questions",
        "truth.jsonl",
        (Action(_read_answers, _judge_answers),),
    ),
    Kind("images cache's list", "manifest", "cache", "cache.manifest.json", (_CACHE_ACTION,)),
    Kind("images cache", "images", "cache", "*.images", (_CACHE_ACTION,)),
    Kind(
        "study recipes",
        "recipe",
        "recipes",
        "*.yaml",
        (
            Action(lambda workspace: read_recipe(str(workspace.changed_file)), _judge_recipe),
            Action(lambda workspace: read_recipe(str(workspace.changed_file), smoke=True)),
        ),
    ),
    Kind(
        "scheduler file",
        "address",
        "schedulers",
        "scheduler.json",
        (Action(_connect, _judge_address),),
    ),
    Kind(
        "zip of a release",
        "zip",
        "zips",
        "*.zip",
        (Action(_read_zip, _judge_zip), Action(_validate_zip, _judge_findings)),
    ),
)
