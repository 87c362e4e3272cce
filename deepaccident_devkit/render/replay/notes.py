"""What a page does not show, and why: sentences for whoever looks at it."""

from __future__ import annotations

from collections.abc import Iterator

from deepaccident_devkit.render.replay.pictures import CameraPictures
from deepaccident_devkit.render.replay.recording import Recording
from deepaccident_devkit.render.roles import short_name
from deepaccident_devkit.taxonomy import AGENTS


def notes(recording: Recording, pictures: CameraPictures, *, points: bool) -> list[str]:
    """Sentences on what is missing in the release or was left out.

    Args:
        recording: the scenario and the agents.
        pictures: what there is of the cameras.
        points: whether there are LiDAR points.
    """
    return [*_labels(recording), *_pictures(recording, pictures), *_points(recording, points=points)]


def _labels(recording: Recording) -> Iterator[str]:
    absent = [short_name(agent) for agent in AGENTS if agent not in recording.agents]
    if absent:
        yield f"Agents not shown: {', '.join(absent)}."
    samples = [recording.sample(agent, frame) for agent in recording.agents for frame in recording.frames]
    unlabelled = sum(not recording.dataset.sample.get(sample)["labelled"] for sample in samples)
    if unlabelled == len(samples):
        yield "The release has no labels of this scenario: nobody's boxes, and not who sees whom."
    elif unlabelled:
        yield f"{unlabelled} of {len(samples)} samples have no label: what those agents see then is not known."
    if recording.unknown:
        yield f"How the accident happened is not known: {recording.unknown}."
    elif recording.contact is not None and recording.contact.disagreements:
        yield f"Meta and the recording disagree: {'; '.join(recording.contact.disagreements)}."


def _pictures(recording: Recording, pictures: CameraPictures) -> Iterator[str]:
    settings = pictures.settings
    if not pictures.found:
        yield f"No pictures: none of the {pictures.wanted} camera files is here; unpack the cameras' archives."
        return
    if pictures.found < pictures.wanted:
        missing = pictures.wanted - pictures.found
        yield f"{missing} of {pictures.wanted} camera files are missing in the release; unpack the cameras' archives."
    if settings is None:
        yield "No pictures: they do not fit beside the rest."
        return
    kept = [short_name(agent) for agent in recording.agents]
    others = kept if settings.front_only else kept[1:]
    yield f"Pictures are up to {settings.width} pixels wide, of JPEG quality {settings.quality}."
    if settings.every > 1:
        yield f"Of {settings.every} frames one has pictures, to keep the file small."
    if others:
        yield f"Left out to keep the file small: all but the front camera of {', '.join(others)}."


def _points(recording: Recording, *, points: bool) -> Iterator[str]:
    if not points:
        title = short_name(recording.agents[0])
        yield f"No LiDAR points: no file of {title} is here; unpack the archive of lidar01."
