"""The healthy files that cases change: small releases, an index, results, a bundle, labels,
exports, nuScenes.

With PyTorch also files of weights and a run of training.
"""

import json
import shutil
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import yaml
from nuscenes_dataroots import write_dataroot
from packing import packed

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import (
    Accident,
    DetectedBoxes,
    Forecast,
    Plan,
    Resampling,
    accident_context,
    instances_of,
)
from deepaccident_devkit.evaluation.results import ResultsWriter
from deepaccident_devkit.evaluation.runs import SampleSelection, evaluate_results, save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.export.questions import Questions, WindowRules
from deepaccident_devkit.motion import MotionLabelConfig, write_label_files
from deepaccident_devkit.plugins.study.recipe import SHIPPED_RECIPES
from deepaccident_devkit.plugins.synth.spec import design_text
from deepaccident_devkit.taxonomy import CAMERAS, AgentName
from deepaccident_devkit.testing import SmallRelease, write_small_release
from deepaccident_devkit.training.image_cache import CachedImages

AGENTS: tuple[AgentName, ...] = ("ego_vehicle", "infrastructure")
CHANNELS = ("Camera_Front", "lidar01", "BEV_instance_camera")
HORIZON = 0.5
LABELS = MotionLabelConfig(future_frames=1)
EXPORT = OpenCood(without_clouds=True)
SCHEDULER = "tcp://127.0.0.1:9"
"""Where nobody listens."""
SETUPS = {
    "motion": EvaluationSetup(task="motion", horizon=HORIZON),
    "accident": EvaluationSetup(task="accident", protocol="boxes", horizon=HORIZON),
    "detection": EvaluationSetup(task="detection"),
    "planning": EvaluationSetup(task="planning", protocol="clean", horizon=HORIZON),
    "forecasting": EvaluationSetup(task="forecasting", protocol="clean", horizon=HORIZON),
}


RECIPE = {
    "title": "Every key",
    "question": "Is each of them read?",
    "releases": {
        "there": {"dataroot": "/data/DeepAccident", "version": "v1"},
        "made": {
            "seed": 3,
            "scenarios": 4,
            "frames": 20,
            "spec": "scenes/mine.yaml",
            "nuscenes": True,
        },
    },
    "weights": {
        "first": {
            "release": "there",
            "split": "train",
            "preset": "tiny",
            "steps": 10,
            "learning_rate": 0.001,
        },
        "second": {
            "release": "made",
            "also": "there",
            "also_split": "val",
            "mix": 0.25,
            "from": "first",
        },
        "given": {"file": "tiny"},
    },
    "test": {
        "release": "made",
        "split": "all",
        "samples": "evaluate",
        "scope": "all",
        "agents": ["ego_vehicle"],
        "horizon": 1.5,
        "where": ["town=Town03"],
        "labels": "clean",
        "includes_training": True,
    },
    "seeds": [1, 2],
    "rows": [
        {
            "name": "{agents}, {latency} s",
            "weights": "first",
            "agents": ["single", "all"],
            "latency": [0.0, 0.2],
        },
        {
            "name": "boxes",
            "weights": "second",
            "baseline": "constant_velocity",
            "budget": 1000,
            "packet_loss": 0.1,
        },
        {"name": "black", "weights": "given", "control": "blank"},
        {
            "name": "off {pose_noise} m",
            "baseline": "standing",
            "pose_noise": [0.0, 0.5],
            "horizon": 2.0,
        },
        {"name": "nothing", "trivial": "nothing"},
    ],
    "groups": {"hidden": ["hidden_collider=true"]},
    "by": ["impact_step"],
    "compare": [["boxes", "black"]],
    "headline": {"row": "boxes", "less": "nothing", "number": "map", "where": "hidden"},
    "smoke": {"seeds": [1], "releases": {"made": {"scenarios": 2}}},
}
"""A recipe of a study."""
HAS_TORCH = find_spec("torch") is not None


class _Killed(OpenCood):
    """Stopped when all scenarios are written."""

    def finish(self, *_: object) -> None:
        raise KeyboardInterrupt


def make_healthy(folder: Path) -> Path:
    """Make one of everything in a new folder; a few seconds. Those in `kept` stay as they are."""
    for name, frames, agents, channels in (
        ("small", 2, AGENTS, ()),
        ("sensors", 1, AGENTS[:1], CHANNELS),
        ("release", 6, AGENTS, ()),
        *((("cameras", 4, AGENTS, CAMERAS),) if HAS_TORCH else ()),
    ):
        wanted = SmallRelease(splits=("train",), frames=frames, agents=agents, channels=channels)
        write_small_release(folder / name, wanted)
    dataset = opened(folder / "release", folder / "index")
    sensors = opened(folder / "sensors", folder / "index_of_sensors")
    for task in SETUPS:
        _write_results(dataset, folder / "results" / task, task)
    for task, setup in SETUPS.items():
        run = evaluate_results(
            dataset, folder / "results" / task, setup, selection(task), workers=1
        )
        run = run.broken_down(("all", "agent"), Resampling(resamples=20))
        save_run(run, folder / "bundles" / task, include_results=True)
    write_label_files(dataset, folder / "labels", tokens(dataset), LABELS, workers=1)
    (folder / "specs").mkdir()
    (folder / "specs" / "crossing.yaml").write_text(design_text(1), encoding="utf-8")
    (folder / "recipes").mkdir()
    for name in ("agents", "road"):
        shutil.copy(SHIPPED_RECIPES / f"{name}.yaml", folder / "recipes")
    (folder / "recipes" / "every_key.yaml").write_text(
        yaml.safe_dump(RECIPE, sort_keys=False), encoding="utf-8"
    )
    _write_exports(dataset, sensors, folder)
    for method in ("stored", "deflated"):
        packed(folder / "small", folder / "zips" / f"{method}.zip", method)
    write_dataroot(folder / "road", keyframes=3, boxes=8)
    (folder / "schedulers").mkdir()
    told = {
        "type": "Scheduler",
        "id": "Scheduler-1",
        "address": SCHEDULER,
        "services": {"dashboard": 8787},
        "workers": {},
    }
    (folder / "schedulers" / "scheduler.json").write_text(json.dumps(told), encoding="utf-8")
    if HAS_TORCH:
        from campaign.healthy_weights import write_run, write_weight_files

        write_weight_files(folder / "weights")
        write_run(opened(folder / "cameras", folder / "index_of_cameras"), folder / "run")
    for name in ("bundles", "index"):
        copied(folder / name, folder / "kept" / name)
    return folder


def opened(root: Path, index_dir: Path) -> DeepAccident:
    """A release by its index, which is made if it is not there."""
    return DeepAccident("v1", root, index_dir=index_dir, workers=1, verbose=False)


def copied(healthy: Path, home: Path) -> Path:
    """A copy made of hard links, with the folders' times, by which an index knows its release."""
    return Path(shutil.copytree(healthy, home, copy_function=_link, dirs_exist_ok=True))


def selection(task: str) -> SampleSelection:
    """The samples of the results of a task."""
    agents = (
        AGENTS[:1] if task in ("planning", "forecasting") else None
    )  # the infrastructure does not drive
    return SampleSelection(
        split="train", samples="all", agents=agents, horizon=SETUPS[task].horizon
    )


def tokens(dataset: DeepAccident, task: str = "motion") -> list[str]:
    """The samples that have a prediction."""
    return list(selection(task).tokens(dataset))


def _write_exports(dataset: DeepAccident, sensors: DeepAccident, folder: Path) -> None:
    """A complete export and one that was killed, questions with answers, and a cache of images."""
    export_release(dataset, folder / "exports" / "whole", EXPORT, workers=1)
    begun = folder / "exports" / "begun"
    with suppress(KeyboardInterrupt):
        export_release(dataset, begun, _Killed(without_clouds=True), workers=1)
    unfinished = begun / ".deepaccident-parts" / "kept" / "opencood"
    max(unfinished.glob("*/done")).unlink()  # a unit of which some was written
    (unfinished / "a_unit_of_before.paths").write_bytes(b"before/one.yaml\0before/two.yaml\0")
    (begun / "before").mkdir()
    for name in ("one", "two"):
        (begun / "before" / f"{name}.yaml").write_bytes(b"written by the killed one\n")
    windows = WindowRules(observe=0, ahead=1, stride=0.5)
    export_release(dataset, folder / "questions", Questions(window=windows), workers=1)
    truth = [
        json.loads(line)
        for line in (folder / "questions" / "truth.jsonl").read_bytes().splitlines()
    ]
    answers = [
        {
            "id": each["id"],
            "accident": [0.9] * len(each["accident"]),
            "who": list(each["actors"])[:2],
            "where": [[1, 2], [3, 4]],
        }
        for each in truth
    ]
    lines = "".join(f"{json.dumps(answer)}\n" for answer in answers)
    (folder / "questions" / "answers.jsonl").write_text(lines, encoding="utf-8")
    images = ImageConfig(resize=(18, 30), cameras=CHANNELS[:1])
    cached = CachedImages(images=images, agents=AGENTS[:1], where=("length>=1",))
    export_release(sensors, folder / "cache", cached, workers=1)


def _link(source: str, target: str) -> None:
    Path(target).hardlink_to(source)


def _write_results(dataset: DeepAccident, path: Path, task: str) -> None:
    grid = LABELS.grid if task == "motion" else None
    path.parent.mkdir(exist_ok=True)
    with ResultsWriter(
        path, task, meta={"method": "a healthy one"}, grid=grid, step=HORIZON
    ) as writer:  # type: ignore[arg-type]
        for token in tokens(dataset, task):
            writer.add(token, _prediction(dataset, token, task))


def _prediction(dataset: DeepAccident, token: str, task: str) -> object:
    if task == "motion":
        label = dataset.motion_labels(token, LABELS).to_present("bilinear")
        return instances_of(label.instance, label.config.grid)
    if task == "detection":
        boxes = dataset.boxes(token)
        return DetectedBoxes(boxes=boxes, scores=np.linspace(0.1, 1.0, len(boxes)))
    times = [0.1, HORIZON]
    if task == "planning":
        plans = ([[1.0, 0.0], [5.0, 0.5]], [[0.5, 0.0], [2.0, 0.0]])
        return [
            Plan(times=times, path=path, score=1.0 - place, yaw=[0.0, 0.1])
            for place, path in enumerate(plans)
        ]
    if task == "forecasting":
        paths = [[[1.0, 2.0], [3.0, 4.0]], [[1.0, 2.0], [1.0, 2.5]]]
        actors = dataset.boxes(token).actor_id.tolist()
        return [
            Forecast(actor_id=actor, times=times, paths=paths, probabilities=[0.75, 0.25])
            for actor in actors
            if actor >= 0
        ]
    truth = accident_context(dataset, token, HORIZON).truth
    true = None if truth is None else truth.accident
    return [] if true is None else [Accident(positions=true.positions, time=true.time, score=0.5)]
