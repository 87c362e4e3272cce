"""Which rows `deepaccident render` renders, and into which files."""

from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.render.boxes import collider_ids
from deepaccident_devkit.render.camera import best_view
from deepaccident_devkit.render.figures import PICTURE_SUFFIXES
from deepaccident_devkit.support.arrays import IntArray, as_floats
from deepaccident_devkit.tables.tokens import (
    annotation_token,
    frame_token,
    instance_token,
    sample_token,
)
from deepaccident_devkit.taxonomy import CAMERAS, CHANNELS, FRAME_PERIOD, OWN_ACTOR_ID
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.collisions import default_scenario, first_accident

_SECONDS_BEFORE = 1.0


def rows_to_draw(
    dataset: Dataset,
    table: str,
    tokens: Sequence[str],
    frames: range | None,
    channels: Sequence[str] = CHANNELS,
    *,
    latency: float = 0.0,
) -> list[str]:
    """The tokens of a table's rows that a verb renders; raises DeepAccidentError, or click.UsageError for `frames`.

    `tokens` are of rows of this table or of scenarios. A scenario stands for its first agent at `frames` (None: one
    second before its end), and for the actor that this agent collides with. Of a partial download it is the moment,
    agent and camera with most files of the `channels` that the verb shows, now and `latency` seconds before; of those
    the nearest to the usual one. No tokens stand for the first accident; if there is none, for the first scenario,
    except where a whole scenario is rendered.
    """
    if frames is not None and table in ("scenario", "instance"):
        raise click.UsageError(
            f"--frame-range is for moments; a whole {table} is rendered, leave it out"
        )
    rows: list[str] = []
    first = (
        first_accident if table == "scenario" else default_scenario
    )  # a whole scenario is counted down
    for token in tokens or [first(dataset)]:
        if token.count("/") == 1:
            rows += _of_scenario(
                dataset, table, token, frames, _files(dataset, token, channels, latency)
            )
        elif frames is not None:
            raise click.UsageError(
                f"--frame-range is for scenarios; {token} is a {table}, name its scenario instead"
            )
        else:
            rows.append(token)
    return rows


def _of_scenario(
    dataset: Dataset, table: str, token: str, frames: range | None, files: IntArray
) -> list[str]:
    record = dataset.get("scenario", token)
    if table == "scenario":
        return [token]
    if table == "instance":
        return [_instance(dataset, token)]
    if frames is not None and frames[-1] > record["num_frames"]:
        raise ChoiceError(
            f"--frame-range: expected frames from 1 to {record['num_frames']}, found {frames[-1]}"
        )
    if frames is None:
        usual = max(1, record["num_frames"] - round(_SECONDS_BEFORE / FRAME_PERIOD))
        of_agents = files.sum(axis=1)
        counts = of_agents.sum(axis=0) if table == "frame" else of_agents.max(axis=0)
        most = np.flatnonzero(counts == counts.max()) + 1
        nearest = int(most[np.abs(most - usual).argmin()])
        frames = range(nearest, nearest + 1)
    if table == "frame":
        return [frame_token(token, number) for number in frames]
    of_frames = files[..., frames.start - 1 : frames.stop - 1].sum(axis=2)
    agent = int(of_frames.sum(axis=1).argmax())
    samples = [sample_token(token, agents_of(dataset, token)[agent], number) for number in frames]
    if table == "sample_data":
        camera = CAMERAS[of_frames[agent, : len(CAMERAS)].argmax()]
        return [f"{sample}/{camera}" for sample in samples]
    return (
        [_annotation(dataset, sample) for sample in samples] if table == "annotation" else samples
    )


def _files(dataset: Dataset, scenario: str, channels: Sequence[str], latency: float) -> IntArray:
    """How many files are here, (agents of the scenario, channels, frames), of each moment and of `latency` before."""
    agents, late = agents_of(dataset, scenario), round(latency / FRAME_PERIOD)
    files = np.zeros(
        (len(agents), len(channels), dataset.get("scenario", scenario)["num_frames"]),
        dtype=np.int64,
    )
    for (agent, channel), frames in dataset.sensor_frames(scenario).items():
        if channel in channels:
            files[agents.index(agent), channels.index(channel), np.array(frames, dtype=int) - 1] = 1
    files[..., late:] += files[..., : max(0, files.shape[2] - late)].copy()
    return files


def _instance(dataset: Dataset, scenario: str) -> str:
    """The actor that the first agent collides with; without a collision, the scenario's first actor."""
    record = dataset.get("scenario", scenario)
    pair = () if record["collision"] is None else record["collision"]["ids"]
    first = dataset.agent.get(f"{scenario}/{agents_of(dataset, scenario)[0]}")["actor_id"]
    labelled = dataset.field2token("instance", "scenario_token", scenario)
    others = (instance_token(scenario, actor) for actor in pair if actor != first)
    return next((other for other in others if other in labelled), labelled[0])


def _annotation(dataset: Dataset, sample: str) -> str:
    """The box of a colliding actor that is not the sample's agent, or of those in an image, that with most points."""
    boxes = dataset.boxes(sample)
    boxes = boxes.select(boxes.actor_id != OWN_ACTOR_ID)
    if not len(boxes):
        raise NotAvailableError(f"{sample}: has no boxes of other actors; name an annotation")
    collides = np.isin(boxes.actor_id, list(collider_ids(dataset, sample)))
    in_image = as_floats(
        [
            best_view(dataset, [sample], boxes.select(boxes.row == row)) is not None
            for row in boxes.row
        ]
    )
    return annotation_token(
        sample, int(boxes.row[np.lexsort((boxes.num_lidar_pts, in_image, collides))[-1]])
    )


def picture_paths(out: Path, view: str, rows: Sequence[str]) -> list[Path]:
    """Where the pictures of rows go: a single one into the file `out`, several into the folder; or click.UsageError."""
    if out.suffix.lower() not in PICTURE_SUFFIXES:
        if out.suffix and not out.is_dir():
            kinds = ", ".join(PICTURE_SUFFIXES)
            raise click.UsageError(
                f"--out: expected a folder, or a file that ends in {kinds}; found {out}"
            )
        return [out / f"{view}_{row.replace('/', '_')}.png" for row in rows]
    if len(rows) > 1:
        raise click.UsageError(f"--out: {len(rows)} pictures need a folder, found the file {out}")
    return [out]
