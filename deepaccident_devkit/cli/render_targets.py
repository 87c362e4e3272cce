"""Which rows `deepaccident render` draws, and which files it writes."""

from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.render.boxes import collider_ids
from deepaccident_devkit.render.camera import best_view
from deepaccident_devkit.render.figures import PICTURE_SUFFIXES
from deepaccident_devkit.render.moments import count_files, default_agent, default_frame
from deepaccident_devkit.support.arrays import as_floats
from deepaccident_devkit.tables.tokens import (
    annotation_token,
    frame_token,
    instance_token,
    sample_token,
)
from deepaccident_devkit.taxonomy import CAMERAS, CHANNELS, OWN_ACTOR_ID
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.collisions import default_scenario, first_accident


def rows_to_draw(
    dataset: Dataset,
    table: str,
    tokens: Sequence[str],
    frames: range | None,
    channels: Sequence[str] = CHANNELS,
) -> list[str]:
    """Return the tokens of the table rows that a subcommand draws.

    For a scenario, they are of one agent at `frames`, and of the actor that this agent collides
    with. In a partial download, the agent and the camera are chosen that have the most files of
    `channels` at these frames.

    Args:
        dataset: The release.
        table: Name of the table.
        tokens: Tokens of rows in this table, or of scenarios. If empty, the first accident is
            drawn; if there is none and the subcommand does not draw a full scenario, the first
            scenario.
        frames: Frame numbers; None for the default frame (`render.moments`).
        channels: Channels that the subcommand shows.

    Raises:
        DeepAccidentError: If a row, scenario or frame does not exist.
        UsageError: If frames cannot be combined with this table or these tokens.
    """
    if frames is not None and table in ("scenario", "instance"):
        raise click.UsageError(
            f"--frame-range has no effect, as a whole {table} is rendered; leave it out"
        )
    rows: list[str] = []
    if not tokens:
        # a full scenario is drawn as a countdown to its accident
        find_default = first_accident if table == "scenario" else default_scenario
        tokens = [find_default(dataset)]
    for token in tokens:
        if token.count("/") == 1:
            rows += _choose_scenario_rows(dataset, table, token, frames, channels)
        elif frames is not None:
            raise click.UsageError(
                f"--frame-range needs scenarios, and {token} is in the table {table}; give its "
                "scenario"
            )
        else:
            rows.append(token)
    return rows


def _choose_scenario_rows(
    dataset: Dataset, table: str, token: str, frames: range | None, channels: Sequence[str]
) -> list[str]:
    """Return the tokens of the rows that are drawn for a scenario."""
    record = dataset.get("scenario", token)
    if table == "scenario":
        return [token]
    if table == "instance":
        return [_choose_instance(dataset, token)]
    if frames is not None and frames[-1] > record["num_frames"]:
        raise ChoiceError(
            f"--frame-range: expected frames from 1 to {record['num_frames']}, found {frames[-1]}"
        )
    if frames is None:
        frame = default_frame(dataset, token)
        frames = range(frame, frame + 1)
    if table == "frame":
        return [frame_token(token, number) for number in frames]
    agent_name = default_agent(dataset, token, frames, channels)
    samples = [sample_token(token, agent_name, number) for number in frames]
    if table == "sample_data":
        files = count_files(dataset, token, CAMERAS)[agents_of(dataset, token).index(agent_name)]
        counts = files[:, frames.start - 1 : frames.stop - 1].sum(axis=1)
        camera = CAMERAS[counts.argmax()]
        return [f"{sample}/{camera}" for sample in samples]
    if table == "annotation":
        return [_choose_annotation(dataset, sample) for sample in samples]
    return samples


def _choose_instance(dataset: Dataset, scenario: str) -> str:
    """Return the actor that the first agent collides with; without a collision, the first actor."""
    record = dataset.get("scenario", scenario)
    pair_ids = () if record["collision"] is None else record["collision"]["ids"]
    first_agent = agents_of(dataset, scenario)[0]
    own_id = dataset.agent.get(f"{scenario}/{first_agent}")["actor_id"]
    instances: list[str] = dataset.field2token("instance", "scenario_token", scenario)
    for actor_id in pair_ids:
        instance = instance_token(scenario, actor_id)
        if actor_id != own_id and instance in instances:
            return instance
    return instances[0]


def _choose_annotation(dataset: Dataset, sample: str) -> str:
    """Return the token of a sample's most interesting box, other than the agent's own.

    Boxes of colliding actors come first, then boxes in an image, then boxes with the most points.
    """
    boxes = dataset.boxes(sample)
    boxes = boxes.select(boxes.actor_id != OWN_ACTOR_ID)
    if not len(boxes):
        raise NotAvailableError(f"{sample}: has no boxes of other actors; give an annotation")
    is_collider = np.isin(boxes.actor_id, list(collider_ids(dataset, sample)))
    views = [best_view(dataset, [sample], boxes.select(boxes.row == row)) for row in boxes.row]
    is_in_image = as_floats([view is not None for view in views])
    order = np.lexsort((boxes.num_lidar_pts, is_in_image, is_collider))
    label_row = int(boxes.row[order[-1]])
    return annotation_token(sample, label_row)


def picture_paths(out: Path, view: str, rows: Sequence[str]) -> list[Path]:
    """Return the path of each row's image: `out` itself if it is a file, else a file in `out`.

    Raise a UsageError if `out` has an unknown suffix, or is one file for several images.
    """
    if out.suffix.lower() not in PICTURE_SUFFIXES:
        if out.suffix and not out.is_dir():
            kinds = ", ".join(PICTURE_SUFFIXES)
            raise click.UsageError(
                f"--out: expected a folder, or a file that ends in {kinds}, found {out}"
            )
        return [out / f"{view}_{row.replace('/', '_')}.png" for row in rows]
    if len(rows) > 1:
        raise click.UsageError(f"--out: {len(rows)} pictures need a folder, found the file {out}")
    return [out]
