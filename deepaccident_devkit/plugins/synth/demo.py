"""`deepaccident demo`: a tour on a small synthetic release, and a page that shows it."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final

import click
import numpy as np
from tqdm import tqdm

from deepaccident_devkit.cli.options import PATH, use_threads_sparingly, workers_parameter
from deepaccident_devkit.cli.verbs import verb
from deepaccident_devkit.dataset import RowArgument
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import ConfigError, MissingExtraError, MissingPluginError
from deepaccident_devkit.evaluation.results import ResultsTask, read_results
from deepaccident_devkit.evaluation.runs import SampleSelection, evaluate_results, save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.evaluation.task import headlines
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.motion import MotionLabelConfig, motion_labels
from deepaccident_devkit.plugins.baselines import Baseline, predict_results
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.render import detached_figure, render_replay
from deepaccident_devkit.render.boxes import draw_boxes_from_above, recorders_of, write_beside
from deepaccident_devkit.render.evaluation import draw_motion_outcome, save_report
from deepaccident_devkit.render.figures import save_picture
from deepaccident_devkit.render.ground import draw_underlay
from deepaccident_devkit.render.styles import COLLIDER_COLOR, page_style
from deepaccident_devkit.support.files import place_in, remove_leftovers, write_bytes
from deepaccident_devkit.support.pages import document
from deepaccident_devkit.support.plugins import need_plugin
from deepaccident_devkit.support.text import columns_text
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import FRAME_PERIOD, short_name
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import FrameRecord, ScenarioRecord

_PAGE_FILE = "index.html"
PICTURES: Final = (
    "countdown.png",
    "five_agents_1s_before.png",
    "ego_cameras_1s_before.png",
    "motion_labels_1s_before.png",
)
"""Files next to the page, in the order in which its template shows them."""
MODEL_PICTURE: Final = "model_1s_before.png"
"""Name of the picture that is made only where PyTorch is installed."""
_REPLAY_FILE = "replay.html"
REPORT_FOLDER: Final = "evaluation"
# The page may load only files from its own folder, and only pages in frames may run code.
_CONTENT_POLICY = (
    "default-src 'none'; img-src 'self' file:; frame-src 'self' file:; style-src 'unsafe-inline'"
)
SCENARIO: Final = """\
# The accident of `deepaccident demo`: in clear weather, by day, the other car runs a red light. \
A house hides it from
# ego until about 2.5 s before the impact; from then on it is in ego's front camera.
name: demo
road: {kind: four-way, signalized: true, lanes: 1}
view: hidden
actors:
  - {role: ego, from: west, max_speed: 10}
  - {role: ego_behind, gap: [8, 16]}
  - {role: other, from: south, max_speed: 4, ignores: [signal]}
  - {role: other_behind, gap: [8, 16]}
meet: {actors: [ego, other], offset: [-0.2, 0.2]}
background: {vehicles: [6, 12], two_wheelers: [2, 6], parked: [3, 9], walking: [3, 9], \
crossing: [1, 4]}
weather: Clear
time_of_day: Noon
"""
RELEASE: Final = SynthConfig(scenarios=2, frames=40, seed=1, sensors="accidents", traffic="v1")
# File that marks a folder as one of the demo.
_MARKER_FILE = ".deepaccident_demo"
_SCENARIO_FILE = "accident.yaml"
_RUN_NAME = "single_vehicle"
_RESULTS_FILE = f"{_RUN_NAME}.json"
# Times before the impact, seconds; at the first one the house hides the other car from ego.
_COUNTDOWN = (3.0, 2.0, 1.0, 0.5, 0.0)
_SECONDS_BEFORE = 1.0
# Distance from ego to the edge of the model's picture.
_VIEW_RANGE_M = 35.0
# The released labels, but they end at the impact.
_LABEL_CONFIG = MotionLabelConfig(future_frames=2)
# Samples of the table and of the report: ego's samples in the last four seconds of the accident and
# of its twin.
_SELECTION = SampleSelection(split="train", scope="all", agents=("ego_vehicle",), horizon=4.0)
_AGENT_SET_NAMES = {"single": "single vehicle", "all": "five agents"}
# The protocol of each task, and the heading of each number of the table with its name in the
# result.
_TABLE_NUMBERS: Mapping[ResultsTask, tuple[str, Mapping[str, str]]] = {
    "motion": ("paper", {"IoU (%)": "iou 100x100", "VPQ (%)": "vpq 100x100"}),
    "accident": ("boxes", {"APA": "apa", "precision": "precision", "recall": "recall"}),
    "detection": ("paper", {"mAP (%)": "mAP"}),
}
_RECORDING = "Recording the scene"
# Approximate duration of each step on two cores, seconds.
_STEP_SECONDS = {
    _RECORDING: 15.0,
    "Indexing the release": 1.0,
    "Drawing pictures": 5.0,
    "Predicting with the model": 5.0,
    "Comparing one car with five": 3.0,
    "Evaluating the baseline": 4.0,
    "Writing the replay": 4.0,
}
_BAR_FORMAT = "{desc:<33} {percentage:3.0f}%|{bar}| {elapsed}<{remaining}"


@dataclass(frozen=True, slots=True)
class NextStep:
    """A suggestion for what to try next.

    Attributes:
        sentence: Description of the step.
        command: Command for a shell.
    """

    sentence: str
    command: str


@verb()
@click.argument("out", type=PATH, default="deepaccident_demo")
@workers_parameter
def demo(out: Path, workers: int | None) -> None:
    """Make a small synthetic release in the folder OUT, and a page that shows what the devkit does.

    The release contains one accident with all sensor files, and its normal twin (the same traffic
    without the accident) with labels only. The page OUT/index.html shows pictures, motion labels, a
    table that compares the predictions of one car and of five agents, a replay, the report of an
    evaluation, and six next steps. If PyTorch is installed, the page also shows the predictions of
    a small trained model.

    OUT must be a new or empty folder, or the folder of an earlier demo, whose release is reused.
    """
    _claim_folder(out)
    steps = _list_next_steps(out)
    with tqdm(total=sum(_STEP_SECONDS.values()), bar_format=_BAR_FORMAT, disable=None) as bar:
        with _show_step(bar, _RECORDING):
            _make_release(out, workers, bar)
        with _show_step(bar, "Indexing the release"):
            release = DeepAccident("v1", out / "release", workers=workers, verbose=False)
        with _show_step(bar, "Drawing pictures"):
            draw_accident(release, out)
        with _show_step(bar, "Predicting with the model"):
            model = draw_model(release, out)
        with _show_step(bar, "Comparing one car with five"):
            table = demo_table(release)
        with _show_step(bar, "Evaluating the baseline"):
            _evaluate(release, out)
        with _show_step(bar, "Writing the replay"):
            render_replay(release, None, out / _REPLAY_FILE)
    write_bytes(out / _PAGE_FILE, demo_page(table, steps, model=model).encode())
    click.echo(f"{columns_text(table)}\n\nNext steps:")
    for number, step in enumerate(steps, 1):
        click.echo(f"{number}. {step.sentence}\n   {step.command}")
    click.echo(f"\nOpen {out / _PAGE_FILE} in a browser to see the results.")


def demo_page(table: Sequence[Sequence[str]], steps: Sequence[NextStep], *, model: bool) -> str:
    """Render the complete page; it refers to the other files of its folder by their names.

    Args:
        table: Rows of `demo_table`.
        steps: Suggestions for what to try next.
        model: Whether there is a picture of a model's predictions.
    """
    # A column for each set of agents fits a narrow window.
    heading, *rows = zip(*table, strict=True)
    return document(
        "demo.html",
        style=page_style(),
        policy=_CONTENT_POLICY,
        pictures=PICTURES,
        model=MODEL_PICTURE if model else "",
        heading=heading,
        rows=rows,
        replay=_REPLAY_FILE,
        report=f"{REPORT_FOLDER}/report.html",
        folder=str(Path.cwd()),
        steps=steps,
    )


def draw_accident(release: DeepAccident, out: Path) -> None:
    """Draw the first accident: its countdown, and the moment a second before.

    At that moment, the pictures show the five agents, ego's cameras and ego's labels.
    """
    accident, before = _find_accident(release)
    ego = release.samples_of(before)[0]
    countdown = partial(
        release.render_accident, seconds=_COUNTDOWN, agents=("ego_vehicle", "infrastructure")
    )
    labels = partial(release.render_motion_labels, config=_LABEL_CONFIG)
    drawings: tuple[tuple[tuple[float, float], Callable[..., Any], RowArgument], ...] = (
        ((17.0, 8.6), countdown, accident),
        ((20.0, 6.5), release.render_frame, before),
        ((16.0, 5.5), release.render_sample, ego),
        ((11.0, 12.0), labels, ego),
    )
    for name, (size, render, record) in zip(PICTURES, drawings, strict=True):
        fig = render(record, fig=detached_figure(size))
        save_picture(fig, out / name, dpi=80)


def draw_model(release: DeepAccident, out: Path) -> bool:
    """Draw the shipped model's predictions a second before the impact, next to the truth.

    One column shows the predictions from ego's LiDAR, the other from the LiDARs of all agents.
    Below is the road, and on top the pair at its true positions at each of the two moments.

    Returns:
        Whether PyTorch is installed; without it there is no picture.
    """
    picture_path = out / MODEL_PICTURE
    picture_path.unlink(missing_ok=True)  # of an earlier demo
    use_threads_sparingly()
    try:
        need_plugin("model", "the picture of a model")
        from deepaccident_devkit.plugins.model import PredictConfig, load_model, predictions

        model = load_model("tiny_lidar")
    except (MissingExtraError, MissingPluginError):
        return False
    accident, before = _find_accident(release)
    token = release.samples_of(before)[0]["token"]
    label = motion_labels(release, token, model.config.labels)
    road = release.load_bev(token)
    moments = ((0, before["index"]), (None, accident["num_frames"]))
    fig = detached_figure((11.0, 11.0))
    columns = fig.subplots(2, 2).T
    titles_by_agents = {"single": "ego alone", "all": "five agents"}
    for column, (agents, title) in zip(columns, titles_by_agents.items(), strict=True):
        [prediction] = predictions(model, release, [token], PredictConfig(agents=agents))
        for ax, (label_frame, index) in zip(column, moments, strict=True):
            draw_motion_outcome(prediction.motion, label, frame=label_frame, ax=ax)
            limits = (-_VIEW_RANGE_M, _VIEW_RANGE_M)
            ax.set(xlim=limits, ylim=limits, title=f"{title}: {ax.get_title()}")
            draw_underlay(road, ax, target_from_ego=SE3.identity())
            _draw_pair(release, accident, token, index, ax)
    save_picture(fig, picture_path, dpi=80)
    return True


def _draw_pair(
    release: DeepAccident, accident: ScenarioRecord, sample: str, index: int, ax: Any
) -> None:
    """Draw the true outlines of an accident's pair at a frame, with names.

    Args:
        release: The release.
        accident: Record of the scenario.
        sample: Token of the sample with the ego frame to draw in.
        index: Frame number.
        ax: Matplotlib axes.
    """
    scenario = accident["token"]
    collision = accident["collision"]
    pair_ids = collision["ids"] if collision else []
    boxes = scenario_tracks(release, scenario).at(index)
    boxes = boxes.select(np.isin(boxes.actor_id, pair_ids))
    ego_from_world = release.world_from(sample, "ego").inverse()
    boxes = boxes.transform(ego_from_world, "ego")
    draw_boxes_from_above(boxes, ax, [COLLIDER_COLOR] * len(boxes), fill=0, linewidths=2)
    recorders = recorders_of(release, scenario)
    centers = boxes.center[:, :2].tolist()
    for (x, y), actor_id in zip(centers, boxes.actor_id.tolist(), strict=True):
        write_beside(ax, short_name(recorders[actor_id]), (x, y), COLLIDER_COLOR)


def _find_accident(release: DeepAccident) -> tuple[ScenarioRecord, FrameRecord]:
    """Return the first accident's scenario, and its frame a second before the impact."""
    accident = next(scenario for scenario in release.scenario if scenario["collision"])
    impact_row = release.getind("frame", accident["last_frame_token"])
    num_frames = round(_SECONDS_BEFORE / FRAME_PERIOD)
    return accident, release.frame[impact_row - num_frames]


@contextmanager
def _show_step(bar: tqdm[Any], name: str) -> Iterator[None]:
    """Show a step on the bar, and move the bar to the end of the step.

    A log gets a line at the beginning of the step.
    """
    number = list(_STEP_SECONDS).index(name) + 1
    seconds = list(_STEP_SECONDS.values())
    title = f"[{number}/{len(seconds)}] {name}"
    bar.set_description_str(title)
    if _is_log(bar):
        click.echo(f"{title} (about {seconds[number - 1]:.0f} s)")
    end = sum(seconds[:number])
    yield
    bar.update(end - bar.n)


def _is_log(bar: tqdm[Any]) -> bool:
    """Return whether the output is not a terminal, so that printed lines show the progress."""
    return bar.disable or not sys.stdout.isatty()


def _claim_folder(out: Path) -> None:
    """Mark a folder as one of the demo, before anything else is written.

    Raises:
        ConfigError: The folder is not empty, and was not made by a demo of this version.
    """
    marker = out / _MARKER_FILE
    version = f"{__version__}\n".encode()
    if marker.is_file() and marker.read_bytes() == version:
        return
    remove_leftovers(out)  # of a demo that was killed before it had marked the folder
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(
            f"{out}: already exists, and was not made by the demo of version {__version__}; "
            "choose a new folder: deepaccident demo OTHER_FOLDER"
        )
    write_bytes(marker, version)


def _make_release(out: Path, workers: int | None, bar: tqdm[Any]) -> None:
    """Make the release unless it exists, and continue an interrupted one."""
    root = place_in(out, "release", opened=True)
    scenario_path = out / _SCENARIO_FILE
    if root.is_dir():
        return
    if not scenario_path.exists():
        write_bytes(scenario_path, SCENARIO.encode())
    recorded = 0.0

    def show_progress(share: float) -> None:
        nonlocal recorded
        previous = recorded
        recorded = recorded + share
        bar.update(share * _STEP_SECONDS[_RECORDING])
        if _is_log(bar) and int(10 * recorded) > int(10 * previous):
            click.echo(f"  {100 * recorded:.0f} % recorded")

    config = replace(RELEASE, spec=scenario_path)
    make_release(root, config, workers=workers or 2, progress=show_progress)


def demo_table(release: DeepAccident) -> list[list[str]]:
    """Return a table of how well ego and five agents foresee crashes.

    Returns:
        Rows of texts: a heading, and a row for each of the two.
    """
    tokens = _SELECTION.tokens(release)
    heading = [""]
    for _, names_by_heading in _TABLE_NUMBERS.values():
        heading += names_by_heading
    rows = [heading]
    for agents, row_name in _AGENT_SET_NAMES.items():
        baseline = Baseline(agents=agents, horizon=_SELECTION.horizon)
        row = [row_name]
        with TemporaryDirectory() as folder:
            for task, (protocol, names_by_heading) in _TABLE_NUMBERS.items():
                path = predict_results(
                    release, task, tokens, Path(folder) / task, baseline, workers=1
                )
                setup = EvaluationSetup(task=task, protocol=protocol, horizon=_SELECTION.horizon)
                run = evaluate_results(release, path, setup, _SELECTION, workers=1)
                numbers = {number.name: number for number in headlines(run.result)}
                for name in names_by_heading.values():
                    row.append(numbers[name].text().removesuffix(" %"))
        rows.append(row)
    return rows


def _evaluate(release: DeepAccident, out: Path) -> None:
    """Evaluate the baseline of a single vehicle, and write a report and a bundle."""
    path = out / _RESULTS_FILE
    path.unlink(missing_ok=True)  # of an earlier demo
    baseline = Baseline(agents="single", horizon=_SELECTION.horizon)
    tokens = _SELECTION.tokens(release)
    results = read_results(predict_results(release, "accident", tokens, path, baseline, workers=1))
    setup = EvaluationSetup(task="accident", protocol="boxes", horizon=_SELECTION.horizon)
    run = evaluate_results(release, results, setup, _SELECTION, workers=1).broken_down()
    folder = place_in(out, REPORT_FOLDER, opened=True)
    save_report(run, folder, dataset=release, results=results)
    bundle = place_in(folder, _RUN_NAME, opened=True)
    save_run(run, bundle, include_results=True, overwrite=True)


def _list_next_steps(out: Path) -> tuple[NextStep, ...]:
    """Return the suggestions for what to try next, with the paths of the demo's folder."""
    names = (
        "release",
        "five_agents",
        "own",
        _SCENARIO_FILE,
        f"{REPORT_FOLDER}/{_RUN_NAME}",
        "five_agents/evaluation",
    )
    paths = [shlex.quote(str(out / name)) for name in names]
    release, predictions, own_release, scenario, bundle, evaluation = paths
    selection = (
        f"--split {_SELECTION.split} --scope {_SELECTION.scope} --horizon {_SELECTION.horizon:g}"
    )
    return (
        NextStep(
            "See what the release contains:", f"deepaccident info {release} --where collision=true"
        ),
        NextStep(
            "See in your browser which predictions were right; first run: pip install '.[explore]'",
            f"deepaccident explore {release} --results {bundle}",
        ),
        NextStep(
            "Check the files, as you would check your download:",
            f"deepaccident validate {release} --deep",
        ),
        NextStep(
            "Let five agents predict together:",
            f"deepaccident predict constant_velocity {release} {selection} --task accident "
            f"--agents all --out {predictions}",
        ),
        NextStep(
            "Evaluate these predictions, and compare them with the report:",
            f"deepaccident evaluate accident {release} --results {predictions}/accident.json "
            f"{selection} --protocol boxes --agents ego_vehicle --allow-partial "
            f"--out {evaluation} && deepaccident evaluate compare {bundle} {evaluation}",
        ),
        NextStep(
            "Edit the scenario file of the accident, such as its weather, and see what happens "
            "in it:",
            f"deepaccident synth {own_release} --design {scenario} --scenarios 2 --sensors none",
        ),
    )
