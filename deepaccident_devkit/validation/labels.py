"""Checks within one agent's labels: ids, sizes, own rows, tracks (docs/format.md, Label)."""

from collections.abc import Callable, Iterator

import numpy as np

from deepaccident_devkit.release.labels import read_lone_words
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, UNTRACKED_ID
from deepaccident_devkit.validation.subject import (
    MAX_LABEL_BOXES,
    Subject,
    frames_text,
    near_pairs,
)

ACTOR_ID_LIMIT = 2_000_000
"""Lowest of the ids that the released code drops."""
CLASS_LENGTHS_M: dict[str, tuple[float, float]] = {
    "car": (1.8, 7.5),
    "truck": (3.0, 20.0),
    "van": (2.5, 9.0),
    "cyclist": (0.3, 3.0),
    "motorcycle": (0.5, 3.5),
    "pedestrian": (0.1, 1.6),
}
"""Shortest and longest of each class."""
MAX_WIDTH_M = 5.0
"""Width and height of the largest road users."""
MAX_COORDINATE_M = 1000.0
"""Distance from the LiDAR along each axis within which labels annotate."""
OWN_OFFSET_TOLERANCE_M = 0.6
"""Distance of the own row's box from the agent's origin; real ones reach 0.3."""
OWN_TURN_TOLERANCE_RAD = np.radians(15.0)
"""Difference of the own row's heading from the agent's."""
OWN_VELOCITY_TOLERANCE_MPS = 0.05
"""Difference of the own row from the first line, which print one number with different digits."""
# Distance within which two boxes of a class are the same box.
_DUPLICATE_RADIUS_M = 0.05
SIZE_TOLERANCE_M = 0.02
WALKER_SIZE_TOLERANCE_M = 1.0
"""Change of a pedestrian's box from frame to frame: real ones stretch by 0.62."""
MAX_JUMP_M = 0.6
"""Distance of an actor from the middle of its neighbours in time: 120 m/s²."""
MAX_TURN_RAD = np.radians(40.0)
"""Turn of a car from the middle of its neighbours in time."""
IMPACT_FRAMES = 2
"""Frames at the end in which a collision may throw its pair about."""
_FOUR_WHEELED = [CATEGORIES.index(name) for name in ("car", "truck", "van")]


def check_labels(subject: Subject) -> Iterator[Finding]:
    """Yield all findings within one label, or within one agent's labels."""
    for check in _LABEL_CHECKS:
        yield from check(subject)


def _check_lone_words(subject: Subject) -> Iterator[Finding]:
    """Find lines of one word, which readers skip.

    Only they show that a label ends within a class name.
    """
    for agent in subject.files.scan.labelled:
        for frame in range(1, subject.num_frames + 1):
            path = subject.files.scenario.label_path(agent, frame)
            skipped = read_lone_words(path)
            if not skipped:
                continue
            _, word, ends_file = skipped[-1]
            if ends_file and any(name.startswith(word) for name in CATEGORIES):
                message = f"its last line is cut off after '{word}'"
                yield subject.finding("label-cut", str(path), message)
                skipped.pop()
            if skipped:
                number, word, _ = skipped[0]
                message = f"skipped are {len(skipped)} lines of one word, the first is {word!r}"
                yield subject.finding("label-line-skipped", f"{path}:{number}", message)


def _check_crowds(subject: Subject) -> Iterator[Finding]:
    counts = np.bincount(subject.boxes.sample, minlength=subject.files.num_samples)
    for agent, frame_counts in enumerate(counts.reshape(len(subject.agents), -1)):
        frames = np.flatnonzero(frame_counts > MAX_LABEL_BOXES) + 1
        if len(frames):
            message = f"up to {frame_counts.max():,} boxes in a label"
            message += f", more than {MAX_LABEL_BOXES:,}, {frames_text(frames)}"
            yield subject.finding("label-crowded", subject.label_folder(agent), message)


def _check_ids(subject: Subject) -> Iterator[Finding]:
    label_id = subject.label_id
    too_low = (label_id < UNTRACKED_ID) & (label_id != OWN_ACTOR_ID)
    odd = too_low | (label_id >= ACTOR_ID_LIMIT)
    yield from subject.label_findings("odd-id", odd, "ids that the format does not know")
    repeated = _find_repeated(np.column_stack([subject.boxes.sample, label_id]))
    duplicate = repeated & (label_id != UNTRACKED_ID) & ~subject.own
    yield from subject.label_findings("duplicate-id", duplicate, "an id occurs twice in one label")


def _check_duplicates(subject: Subject) -> Iterator[Finding]:
    labels = subject.boxes.labels
    groups = subject.boxes.sample * len(CATEGORIES) + labels.category
    pairs, duplicate = near_pairs(labels.center, groups, _DUPLICATE_RADIUS_M)
    duplicate[pairs.ravel()] = True
    yield from subject.label_findings(
        "duplicate-box", duplicate, "two boxes stand in the same place"
    )


def _check_sizes_and_points(subject: Subject) -> Iterator[Finding]:
    labels = subject.boxes.labels
    length = labels.size[:, 0]
    width = labels.size[:, 1]
    class_lengths = np.array([CLASS_LENGTHS_M[name] for name in CATEGORIES])
    min_length, max_length = class_lengths[labels.category].T
    too_small = np.any(labels.size <= 0, axis=1)
    odd: BoolArray = too_small | np.any(labels.size[:, 1:] > MAX_WIDTH_M, axis=1)
    is_crosswise = _is_four_wheeled(subject) & (length < width)
    unlike = (length < min_length) | (length > max_length) | is_crosswise
    # Real untracked rows have sizes of another class.
    odd |= unlike & (subject.label_id != UNTRACKED_ID)
    odd |= length > class_lengths.max()
    yield from subject.label_findings("odd-size", odd, "sizes that their classes do not have")
    negative = labels.num_lidar_pts < 0
    yield from subject.label_findings("odd-points", negative, "less than 0 LiDAR points")
    distant: BoolArray = np.any(np.abs(labels.center) > MAX_COORDINATE_M, axis=1)
    message = f"over {MAX_COORDINATE_M:.0f} m from the LiDAR"
    yield from subject.label_findings("odd-position", distant, message)
    unknown: BoolArray = np.any(np.isnan(labels.velocity), axis=1)
    yield from subject.label_findings("velocity-unknown", unknown, "velocities that are no numbers")


def _check_own_row_counts(subject: Subject) -> Iterator[Finding]:
    own_samples = subject.boxes.sample[subject.own]
    counts = np.bincount(own_samples, minlength=subject.files.num_samples)
    for agent, frame_counts in enumerate(counts.reshape(len(subject.agents), -1)):
        if subject.agents[agent] not in subject.files.scan.labelled:
            continue
        expected = 0 if subject.is_pole(agent) else 1
        for code, mask in (
            ("own-row-missing", frame_counts < expected),
            ("own-row-odd", frame_counts > expected),
        ):
            if mask.any():
                message = f"expected {expected} rows of id {OWN_ACTOR_ID}, found another number"
                message += f" in {frames_text(np.flatnonzero(mask) + 1)}"
                yield subject.finding(code, subject.label_folder(agent), message)


def _check_own_boxes(subject: Subject) -> Iterator[Finding]:
    boxes = subject.boxes
    rows = np.flatnonzero(subject.own)
    pose = subject.files.calibs.world_from_ego[boxes.sample[rows]]
    # The agent stands upright on the road.
    expected_center = pose[:, :3, 3] + pose[:, :3, 2] * boxes.labels.size[rows, 2:] / 2
    offset = np.linalg.norm(subject.centers[rows] - expected_center, axis=1)
    turn = subject.yaw[rows] - np.arctan2(pose[:, 1, 0], pose[:, 0, 0])
    misplaced = np.zeros(len(subject.own), dtype=bool)
    misplaced[rows] = offset > OWN_OFFSET_TOLERANCE_M
    misplaced[rows] |= np.abs(np.arctan2(np.sin(turn), np.cos(turn))) > OWN_TURN_TOLERANCE_RAD
    message = f"the own box is turned, or over {OWN_OFFSET_TOLERANCE_M} m off standing on the"
    message += " agent's origin"
    yield from subject.label_findings("own-box-off", misplaced, message)
    first_line = np.full((subject.files.num_samples, 2), np.nan)
    labelled = [agent in subject.files.scan.labelled for agent in subject.agents]
    first_line[np.repeat(labelled, subject.num_frames)] = subject.files.labels.agent_velocity
    difference = np.abs(boxes.labels.velocity[rows] - first_line[boxes.sample[rows]]).max(axis=1)
    differs = np.zeros(len(subject.own), dtype=bool)
    differs[rows] = difference > OWN_VELOCITY_TOLERANCE_MPS
    yield from subject.label_findings(
        "own-velocity", differs, "the agent's own velocity differs from the first line"
    )


def _check_tracks(subject: Subject) -> Iterator[Finding]:
    """Check changes along each track: one agent's rows of one id."""
    rows = np.flatnonzero(subject.tracked)
    boxes = subject.boxes
    rows = rows[np.lexsort((boxes.frame[rows], subject.label_id[rows], boxes.agent[rows]))]
    ids = subject.label_id[rows]
    agents = boxes.agent[rows]
    same_track = (ids[1:] == ids[:-1]) & (agents[1:] == agents[:-1])
    categories = boxes.labels.category[rows]
    is_walker = boxes.labels.category == CATEGORIES.index("pedestrian")
    tolerance = np.where(is_walker, WALKER_SIZE_TOLERANCE_M, SIZE_TOLERANCE_M)
    growth = np.abs(np.diff(boxes.labels.size[rows], axis=0)).max(axis=1)
    for code, changed in (
        ("class-changes", categories[1:] != categories[:-1]),
        ("size-changes", growth > tolerance[rows[1:]]),
    ):
        changed_rows = subject.mask(rows[1:][same_track & changed])
        yield from subject.label_findings(code, changed_rows, "changes along the track")
    yield from _check_motion(subject, rows, same_track)
    yield from _check_track_gaps(subject, rows, same_track)


def _check_motion(subject: Subject, rows: IntArray, same_track: BoolArray) -> Iterator[Finding]:
    """Find jumps and sudden turns between successive rows of a track."""
    frame = subject.boxes.frame[rows]
    step = np.diff(frame)
    successive = same_track[1:] & same_track[:-1] & (step[1:] == 1) & (step[:-1] == 1)
    in_impact = frame[2:] > subject.num_frames - IMPACT_FRAMES
    checked = successive & ~(subject.in_collision[rows[1:-1]] & in_impact)
    bend = np.linalg.norm(_second_difference(subject.centers[rows]), axis=1) / 2
    jumps = subject.mask(rows[1:-1][checked & (bend > MAX_JUMP_M)])
    message = f"over {MAX_JUMP_M} m off the middle of the frames around"
    yield from subject.label_findings("track-jump", jumps, message)
    change = np.diff(subject.yaw[rows])
    turns = np.abs(np.arctan2(np.sin(change), np.cos(change))) > MAX_TURN_RAD
    is_turned = checked & _is_four_wheeled(subject)[rows[1:-1]] & turns[1:] & turns[:-1]
    turned_rows = subject.mask(rows[1:-1][is_turned])
    yield from subject.label_findings("track-turn", turned_rows, "turned to and fro")


def _check_track_gaps(subject: Subject, rows: IntArray, same_track: BoolArray) -> Iterator[Finding]:
    """Find frames that a track near its agent lacks."""
    boxes = subject.boxes
    distance = np.linalg.norm(boxes.labels.center[rows, :2], axis=1)
    near = distance < subject.reach[boxes.agent[rows]]
    skips = np.diff(boxes.frame[rows]) > 1
    gap = np.flatnonzero(same_track & skips & near[1:] & near[:-1])
    before = rows[gap]
    after = rows[gap + 1]
    center = (subject.centers[before] + subject.centers[after]) / 2
    for agent in range(len(subject.agents)):
        is_gap = boxes.agent[before] == agent
        frames = (boxes.frame[before] + boxes.frame[after])[is_gap] // 2
        is_gap[is_gap] = ~subject.has_untracked(agent, frames, center[is_gap])
        yield from subject.label_findings(
            "track-gap", subject.mask(after[is_gap]), "near, and missing in the frames before"
        )


def _is_four_wheeled(subject: Subject) -> BoolArray:
    """Return a mask of boxes of four-wheeled vehicles, shape (N,)."""
    return np.isin(subject.boxes.labels.category, _FOUR_WHEELED)


def _second_difference(values: FloatArray) -> FloatArray:
    if len(values) <= 2:
        return np.zeros((0, values.shape[1]))
    return values[2:] - 2 * values[1:-1] + values[:-2]


def _find_repeated(keys: AnyArray) -> BoolArray:
    """Return a mask of keys (N, K) that occur more than once."""
    if not len(keys):
        return np.zeros(0, dtype=bool)
    _, inverse, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(count[inverse.reshape(-1)] > 1)


_LABEL_CHECKS: tuple[Callable[[Subject], Iterator[Finding]], ...] = (
    _check_lone_words,
    _check_crowds,
    _check_ids,
    _check_duplicates,
    _check_sizes_and_points,
    _check_own_row_counts,
    _check_own_boxes,
    _check_tracks,
)
