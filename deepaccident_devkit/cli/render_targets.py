"""Rows that `deepaccident render` draws, and the files that it writes."""

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

# Time before the end of a scenario at which it is drawn by default.
_TIME_BEFORE_END_S = 1.0


def rows_to_draw(
    dataset: Dataset,
    table: str,
    tokens: Sequence[str],
    frames: range | None,
    channels: Sequence[str] = CHANNELS,
    *,
    latency: float = 0.0,
) -> list[str]:
    """Return the tokens of the rows of a table that a verb draws.

    A scenario stands for its first agent at `frames`, and for the actor that this agent collides
    with. In a partial download its moment, agent and camera are the ones with most files of the
    channels, now and `latency` seconds before; of several the nearest to the default moment.

    Args:
        dataset: The release.
        table: The table.
        tokens: Tokens of rows of this table or of scenarios. Without tokens the first accident is
            drawn, or the first scenario if there is no accident and the verb does not draw a full
            scenario.
        frames: Numbers of frames; None for one second before the end.
        channels: Channels that the verb shows.
        latency: Age of the oldest data that the verb shows, in seconds.

    Raises:
        DeepAccidentError: no such row, scenario or frame.
        UsageError: frames do not apply to the table or the tokens.
    """
    if frames is not None and table in ("scenario", "instance"):
        raise click.UsageError(
            f"--frame-range is for moments; a whole {table} is rendered, leave it out"
        )
    rows: list[str] = []
    if not tokens:
        # a full scenario is drawn as a countdown to its accident
        find_default = first_accident if table == "scenario" else default_scenario
        tokens = [find_default(dataset)]
    for token in tokens:
        if token.count("/") == 1:
            files = _file_counts(dataset, token, channels, latency)
            rows += _rows_of_scenario(dataset, table, token, frames, files)
        elif frames is not None:
            raise click.UsageError(
                f"--frame-range is for scenarios; {token} is a {table}, name its scenario instead"
            )
        else:
            rows.append(token)
    return rows


def _rows_of_scenario(
    dataset: Dataset, table: str, token: str, frames: range | None, files: IntArray
) -> list[str]:
    """Return the tokens of a scenario's rows; files are counts of (agents, channels, frames)."""
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
        default = max(1, record["num_frames"] - round(_TIME_BEFORE_END_S / FRAME_PERIOD))
        agent_counts = files.sum(axis=1)
        counts = agent_counts.sum(axis=0) if table == "frame" else agent_counts.max(axis=0)
        best_frames = np.flatnonzero(counts == counts.max()) + 1
        nearest = int(best_frames[np.abs(best_frames - default).argmin()])
        frames = range(nearest, nearest + 1)
    if table == "frame":
        return [frame_token(token, number) for number in frames]
    channel_counts = files[..., frames.start - 1 : frames.stop - 1].sum(axis=2)
    agent = int(channel_counts.sum(axis=1).argmax())
    agent_name = agents_of(dataset, token)[agent]
    samples = [sample_token(token, agent_name, number) for number in frames]
    if table == "sample_data":
        camera = CAMERAS[channel_counts[agent, : len(CAMERAS)].argmax()]
        return [f"{sample}/{camera}" for sample in samples]
    if table == "annotation":
        return [_annotation(dataset, sample) for sample in samples]
    return samples


def _file_counts(
    dataset: Dataset, scenario: str, channels: Sequence[str], latency: float
) -> IntArray:
    """Return the number of existing files at each moment and `latency` before.

    Its shape is (agents of the scenario, channels, frames).
    """
    agents, delay = agents_of(dataset, scenario), round(latency / FRAME_PERIOD)
    frame_count = dataset.get("scenario", scenario)["num_frames"]
    files = np.zeros((len(agents), len(channels), frame_count), dtype=np.int64)
    for (agent, channel), frames in dataset.sensor_frames(scenario).items():
        if channel in channels:
            files[agents.index(agent), channels.index(channel), np.array(frames, dtype=int) - 1] = 1
    files[..., delay:] += files[..., : max(0, files.shape[2] - delay)].copy()
    return files


def _instance(dataset: Dataset, scenario: str) -> str:
    """Return the actor that the first agent collides with; without a collision the first actor."""
    record = dataset.get("scenario", scenario)
    pair = () if record["collision"] is None else record["collision"]["ids"]
    own_actor = dataset.agent.get(f"{scenario}/{agents_of(dataset, scenario)[0]}")["actor_id"]
    labelled: list[str] = dataset.field2token("instance", "scenario_token", scenario)
    for actor in pair:
        instance = instance_token(scenario, actor)
        if actor != own_actor and instance in labelled:
            return instance
    return labelled[0]


def _annotation(dataset: Dataset, sample: str) -> str:
    """Return a box of another actor than the sample's agent.

    Colliding actors come first, then boxes in an image, then boxes with most points.
    """
    boxes = dataset.boxes(sample)
    boxes = boxes.select(boxes.actor_id != OWN_ACTOR_ID)
    if not len(boxes):
        raise NotAvailableError(f"{sample}: has no boxes of other actors; name an annotation")
    collides = np.isin(boxes.actor_id, list(collider_ids(dataset, sample)))
    views = [best_view(dataset, [sample], boxes.select(boxes.row == row)) for row in boxes.row]
    in_image = as_floats([view is not None for view in views])
    best = np.lexsort((boxes.num_lidar_pts, in_image, collides))[-1]
    return annotation_token(sample, int(boxes.row[best]))


def picture_paths(out: Path, view: str, rows: Sequence[str]) -> list[Path]:
    """Return the paths of the pictures of rows: the file `out` for one, files in it for several.

    Raises click.UsageError.
    """
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
