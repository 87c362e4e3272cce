"""The healthy files that cases change: small releases, an index, results, a bundle, labels, exports, weights."""

import importlib.util
import json
import shutil
import zipfile
from contextlib import suppress
from dataclasses import fields
from pathlib import Path

import numpy as np

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Accident, DetectedBoxes, Resampling, accident_context, instances_of
from deepaccident_devkit.evaluation.results import ResultsWriter
from deepaccident_devkit.evaluation.runs import SampleSelection, evaluate_results, save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.image_cache import CachedImages
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.export.questions import Questions, WindowRules
from deepaccident_devkit.motion import MotionLabelConfig, write_label_files
from deepaccident_devkit.synth.spec import design_text
from deepaccident_devkit.taxonomy import AgentName
from deepaccident_devkit.testing import SmallRelease, write_small_release

AGENTS: tuple[AgentName, ...] = ("ego_vehicle", "infrastructure")
CHANNELS = ("Camera_Front", "lidar01", "BEV_instance_camera")
TORCH = importlib.util.find_spec("torch") is not None and importlib.util.find_spec("safetensors") is not None
"""Whether files of weights can be read here."""
OUTSIDE = "outside"
"""The folder of healthy files that no writer may touch, whatever the folders say that it writes into."""
HORIZON = 0.5
LABELS = MotionLabelConfig(future_frames=1)
QUESTIONS = Questions(agents=AGENTS[:1], window=WindowRules(observe=0, stride=0.5, ahead=1))
OPENCOOD = OpenCood(agents=AGENTS, without_clouds=True)
CACHE = CachedImages(split="train", agents=AGENTS[:1], images=ImageConfig(resize=(18, 32), cameras=CHANNELS[:1]))
SETUPS = {
    "motion": EvaluationSetup(task="motion", horizon=HORIZON),
    "accident": EvaluationSetup(task="accident", protocol="boxes", horizon=HORIZON),
    "detection": EvaluationSetup(task="detection"),
}


def make_healthy(folder: Path) -> Path:
    """Make one of everything in a new folder; a few seconds. Those in `kept` stay as they are."""
    for name, frames, agents, channels in (
        ("small", 2, AGENTS, ()),
        ("sensors", 1, AGENTS[:1], CHANNELS),
        ("release", 6, AGENTS, ()),
    ):
        wanted = SmallRelease(splits=("train",), frames=frames, agents=agents, channels=channels)
        write_small_release(folder / name, wanted)
    dataset = opened(folder / "release", folder / "index")
    opened(folder / "sensors", folder / "index_of_sensors")
    for task in SETUPS:
        _write_results(dataset, folder / "results" / task, task)
    for task, setup in SETUPS.items():
        run = evaluate_results(dataset, folder / "results" / task, setup, selection(task), workers=1)
        run = run.broken_down(("all", "agent"), Resampling(resamples=20))
        save_run(run, folder / "bundles" / task, include_results=True)
    write_label_files(dataset, folder / "labels", tokens(dataset), LABELS, workers=1)
    (folder / "specs").mkdir()
    (folder / "specs" / "crossing.yaml").write_text(design_text(1), encoding="utf-8")
    _write_exports(dataset, folder)
    (folder / "archive").mkdir()
    with zipfile.ZipFile(folder / "archive" / "release.zip", "w") as archive:
        for path in sorted((folder / "small").rglob("*")):
            archive.write(path, path.relative_to(folder / "small"))
    (folder / "scheduler").mkdir()
    facts = {"type": "Scheduler", "id": "Scheduler-1", "address": "tcp://127.0.0.1:1", "services": {}, "workers": {}}
    (folder / "scheduler" / "scheduler.json").write_text(json.dumps(facts, indent=2), encoding="utf-8")
    (folder / OUTSIDE / "folder").mkdir(parents=True)
    for name in ("precious.txt", "folder/precious.txt"):
        (folder / OUTSIDE / name).write_text("not ours\n", encoding="utf-8")
    if TORCH:
        from campaign.weights import write_weights_of_all_kinds

        write_weights_of_all_kinds(folder)
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
    return SampleSelection(split="train", samples="all", horizon=SETUPS[task].horizon)


def tokens(dataset: DeepAccident) -> list[str]:
    """The samples that have a prediction."""
    return list(selection("motion").tokens(dataset))


class StoppedBeforeTheEnd(Exception):  # noqa: N818 - no fault
    """Ends an export when all its units are written."""


class _Unfinished(OpenCood):
    def finish(self, *_: object) -> None:
        raise StoppedBeforeTheEnd


def _write_exports(dataset: DeepAccident, folder: Path) -> None:
    """A whole export and one that was stopped, answers to its questions, and an images cache."""
    asked = export_release(dataset, folder / "answers" / "export", QUESTIONS, workers=1).folder
    questions = (asked / "questions" / "questions.jsonl").read_text(encoding="utf-8").splitlines()
    answers = [
        json.dumps({"id": json.loads(line)["id"], "accident": [False], "who": None, "where": None})
        for line in questions
    ]
    (folder / "answers" / "answers.jsonl").write_text("\n".join(answers) + "\n", encoding="utf-8")
    (folder / "answers" / "truth.jsonl").write_bytes((asked / "truth.jsonl").read_bytes())
    shutil.rmtree(asked)
    export_release(dataset, folder / "export", OPENCOOD, workers=1)
    with suppress(StoppedBeforeTheEnd):
        export_release(dataset, folder / "unfinished", _Unfinished(**vars_of(OPENCOOD)), workers=1)
    export_release(opened(folder / "sensors", folder / "index_of_sensors"), folder / "cache", CACHE, workers=1)


def vars_of(form: OpenCood) -> dict[str, object]:
    """The settings of a format, to make another one with."""
    return {each.name: getattr(form, each.name) for each in fields(form)}


def _link(source: str, target: str) -> None:
    Path(target).hardlink_to(source)


def _write_results(dataset: DeepAccident, path: Path, task: str) -> None:
    grid = LABELS.grid if task == "motion" else None
    path.parent.mkdir(exist_ok=True)
    with ResultsWriter(path, task, meta={"method": "a healthy one"}, grid=grid, step=HORIZON) as writer:  # type: ignore[arg-type]
        for token in tokens(dataset):
            writer.add(token, _prediction(dataset, token, task))


def _prediction(dataset: DeepAccident, token: str, task: str) -> object:
    if task == "motion":
        label = dataset.motion_labels(token, LABELS).to_present("bilinear")
        return instances_of(label.instance, label.config.grid)
    if task == "detection":
        boxes = dataset.boxes(token)
        return DetectedBoxes(boxes=boxes, scores=np.linspace(0.1, 1.0, len(boxes)))
    truth = accident_context(dataset, token, HORIZON).truth
    true = None if truth is None else truth.accident
    return [] if true is None else [Accident(positions=true.positions, time=true.time, score=0.5)]
