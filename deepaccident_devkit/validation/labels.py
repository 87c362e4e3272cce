"""Checks within one agent's labels: ids, sizes, own rows, tracks (docs/format.md, Label)."""

from collections.abc import Callable

import numpy as np

from deepaccident_devkit.release.labels import read_lone_words
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, UNTRACKED_ID
from deepaccident_devkit.validation.agreement import wrap_angle
from deepaccident_devkit.validation.subject import (
    CAR_CODES,
    MAX_LABEL_BOXES,
    Findings,
    Subject,
    frames_text,
    near_pairs,
)

ACTOR_ID_LIMIT = 2_000_000
"""Smallest id that the released code drops."""
CLASS_LENGTHS_M: dict[str, tuple[float, float]] = {
    "car": (1.8, 7.5),
    "truck": (3.0, 20.0),
    "van": (2.5, 9.0),
    "cyclist": (0.3, 3.0),
    "motorcycle": (0.5, 3.5),
    "pedestrian": (0.1, 1.6),
}
"""Shortest and longest box length of each class in metres."""
MAX_WIDTH_M = 5.0
"""Largest width and largest height of a road user."""
MAX_COORDINATE_M = 1000.0
"""Largest distance of an annotated box from the LiDAR, along each axis."""
OWN_OFFSET_TOLERANCE_M = 0.6
"""Largest distance of the agent's own row from its origin; it reaches 0.3 in real data."""
OWN_TURN_TOLERANCE_RAD = np.radians(15.0)
"""Largest difference between the heading of the agent's own row and the agent's heading."""
OWN_VELOCITY_TOLERANCE_MPS = 0.05
"""Largest difference between the velocities in the agent's own row and in the first line.

The two print the same number with a different number of digits.
"""
# Distance within which two boxes of the same class count as the same box.
_DUPLICATE_RADIUS_M = 0.05
SIZE_TOLERANCE_M = 0.02
"""Largest change of a box's size between frames."""
WALKER_SIZE_TOLERANCE_M = 1.0
"""Largest change of a pedestrian's box size between frames; it reaches 0.62 in real data."""
MAX_JUMP_M = 0.6
"""Largest distance of an actor from the midpoint of its positions one frame before and after.

It corresponds to 120 m/s².
"""
MAX_TURN_RAD = np.radians(40.0)
"""Largest change of a car's heading between frames."""
IMPACT_FRAMES = 2
"""Number of frames at the end in which a collision may throw the two colliders about."""


def check_labels(subject: Subject) -> Findings:
    """Yield all findings within single labels, and within one agent's labels."""
    for check in _LABEL_CHECKS:
        yield from check(subject)


def _check_lone_words(subject: Subject) -> Findings:
    """Find lines that consist of one word, which readers skip.

    Nothing else shows that a label file was cut off within a class name.
    """
    for agent in subject.labelled:
        for frame in range(1, subject.num_frames + 1):
            path = subject.files.scenario.label_path(agent, frame)
            skipped_lines = read_lone_words(path)
            if not skipped_lines:
                continue
            _, word, ends_file = skipped_lines[-1]
            begins_category = any(name.startswith(word) for name in CATEGORIES)
            if ends_file and begins_category:
                message = f"the last line is cut off after '{word}'"
                yield subject.finding("label-cut", str(path), message)
                skipped_lines.pop()
            if skipped_lines:
                number, word, _ = skipped_lines[0]
                count = len(skipped_lines)
                message = f"skipped {counted(count, 'line')} of one word, such as {word!r}"
                yield subject.finding("label-line-skipped", f"{path}:{number}", message)


def _check_crowds(subject: Subject) -> Findings:
    counts = np.bincount(subject.boxes.sample, minlength=subject.files.num_samples)
    for agent, frame_counts in enumerate(counts.reshape(len(subject.agents), -1)):
        frames = np.flatnonzero(frame_counts > MAX_LABEL_BOXES) + 1
        if len(frames):
            message = f"up to {frame_counts.max():,} boxes in a label"
            message += f", more than {MAX_LABEL_BOXES:,}, {frames_text(frames)}"
            yield subject.label_finding("label-crowded", agent, message)


def _check_ids(subject: Subject) -> Findings:
    label_id = subject.label_id
    is_low = (label_id < UNTRACKED_ID) & (label_id != OWN_ACTOR_ID)
    is_odd = is_low | (label_id >= ACTOR_ID_LIMIT)
    yield from subject.box_findings("odd-id", is_odd, "ids that the format does not define")
    is_repeated = _find_repeated(np.column_stack([subject.boxes.sample, label_id]))
    is_duplicate = is_repeated & subject.tracked
    yield from subject.box_findings("duplicate-id", is_duplicate, "an id occurs twice in one label")


def _check_duplicates(subject: Subject) -> Findings:
    labels = subject.boxes.labels
    groups = subject.boxes.sample * len(CATEGORIES) + labels.category
    pairs, is_duplicate = near_pairs(labels.center, groups, _DUPLICATE_RADIUS_M)
    is_duplicate[pairs.ravel()] = True
    message = "two boxes are in the same place"
    yield from subject.box_findings("duplicate-box", is_duplicate, message)


def _check_sizes_and_points(subject: Subject) -> Findings:
    labels = subject.boxes.labels
    length = labels.size[:, 0]
    width = labels.size[:, 1]
    class_lengths = np.array([CLASS_LENGTHS_M[name] for name in CATEGORIES])
    min_length, max_length = class_lengths[labels.category].T
    is_small = np.any(labels.size <= 0, axis=1)
    is_large = np.any(labels.size[:, 1:] > MAX_WIDTH_M, axis=1)
    is_odd: BoolArray = is_small | is_large | (length > class_lengths.max())
    is_crosswise = _is_four_wheeled(subject) & (length < width)
    is_unlike_class = (length < min_length) | (length > max_length) | is_crosswise
    # In real data, untracked rows have sizes of another class.
    is_odd |= is_unlike_class & (subject.label_id != UNTRACKED_ID)
    yield from subject.box_findings("odd-size", is_odd, "sizes that do not fit their classes")
    is_negative = labels.num_lidar_pts < 0
    yield from subject.box_findings("odd-points", is_negative, "a negative number of LiDAR points")
    is_distant: BoolArray = np.any(np.abs(labels.center) > MAX_COORDINATE_M, axis=1)
    message = f"more than {MAX_COORDINATE_M:.0f} m from the LiDAR"
    yield from subject.box_findings("odd-position", is_distant, message)
    is_unknown: BoolArray = np.any(np.isnan(labels.velocity), axis=1)
    message = "velocities that are not numbers"
    yield from subject.box_findings("velocity-unknown", is_unknown, message)


def _check_own_row_counts(subject: Subject) -> Findings:
    own_samples = subject.boxes.sample[subject.own]
    counts = np.bincount(own_samples, minlength=subject.files.num_samples)
    for agent, frame_counts in enumerate(counts.reshape(len(subject.agents), -1)):
        if subject.agents[agent] not in subject.labelled:
            continue
        if subject.is_pole(agent):
            expected = 0
        else:
            expected = 1
        for code, mask in (
            ("own-row-missing", frame_counts < expected),
            ("own-row-odd", frame_counts > expected),
        ):
            if mask.any():
                message = f"expected {counted(expected, 'row')} of id {OWN_ACTOR_ID}"
                message += f", found another number in {frames_text(np.flatnonzero(mask) + 1)}"
                yield subject.label_finding(code, agent, message)


def _check_own_boxes(subject: Subject) -> Findings:
    boxes = subject.boxes
    rows = np.flatnonzero(subject.own)
    samples = boxes.sample[rows]
    pose = subject.files.calibs.world_from_ego[samples]
    up = pose[:, :3, 2]
    # The agent is assumed to stand upright on the road.
    expected_center = pose[:, :3, 3] + up * boxes.labels.size[rows, 2:] / 2
    offset = np.linalg.norm(subject.centers[rows] - expected_center, axis=1)
    turn = np.abs(wrap_angle(subject.yaw[rows] - np.arctan2(pose[:, 1, 0], pose[:, 0, 0])))
    is_misplaced = (offset > OWN_OFFSET_TOLERANCE_M) | (turn > OWN_TURN_TOLERANCE_RAD)
    message = "the agent's own box is turned, or does not stand within "
    message += f"{OWN_OFFSET_TOLERANCE_M} m of the agent's origin"
    yield from subject.box_findings("own-box-off", subject.mask(rows[is_misplaced]), message)
    first_line = np.full((subject.files.num_samples, 2), np.nan)
    is_labelled = [agent in subject.labelled for agent in subject.agents]
    first_line[np.repeat(is_labelled, subject.num_frames)] = subject.files.labels.agent_velocity
    difference = np.abs(boxes.labels.velocity[rows] - first_line[samples])
    differs = difference.max(axis=1) > OWN_VELOCITY_TOLERANCE_MPS
    message = "the velocity of the agent's own box differs from the first line"
    yield from subject.box_findings("own-velocity", subject.mask(rows[differs]), message)


def _check_tracks(subject: Subject) -> Findings:
    """Check the changes along each track, which is one agent's rows with the same id."""
    boxes = subject.boxes
    rows = np.flatnonzero(subject.tracked)
    order = np.lexsort((boxes.frame[rows], subject.label_id[rows], boxes.agent[rows]))
    rows = rows[order]
    same_id = np.diff(subject.label_id[rows]) == 0
    same_agent = np.diff(boxes.agent[rows]) == 0
    same_track: BoolArray = same_id & same_agent
    class_changes = np.diff(boxes.labels.category[rows]) != 0
    is_walker = boxes.labels.category[rows] == CATEGORIES.index("pedestrian")
    tolerance = np.where(is_walker, WALKER_SIZE_TOLERANCE_M, SIZE_TOLERANCE_M)
    growth = np.abs(np.diff(boxes.labels.size[rows], axis=0)).max(axis=1)
    size_changes = growth > tolerance[1:]
    for code, changes in (("class-changes", class_changes), ("size-changes", size_changes)):
        changed_boxes = subject.mask(rows[1:][same_track & changes])
        yield from subject.box_findings(code, changed_boxes, "changes along the track")
    yield from _check_motion(subject, rows, same_track)
    yield from _check_track_gaps(subject, rows, same_track)


def _check_motion(subject: Subject, rows: IntArray, same_track: BoolArray) -> Findings:
    """Find jumps and sudden turns between successive rows of each track."""
    middle_rows = rows[1:-1]
    frame = subject.boxes.frame[rows]
    follows = same_track & (np.diff(frame) == 1)
    in_impact = frame[2:] > subject.num_frames - IMPACT_FRAMES
    is_thrown = subject.in_collision[middle_rows] & in_impact
    is_checked = follows[1:] & follows[:-1] & ~is_thrown
    bend = np.linalg.norm(_second_difference(subject.centers[rows]), axis=1) / 2
    jumps = is_checked & (bend > MAX_JUMP_M)
    message = f"more than {MAX_JUMP_M} m from the middle of the neighbouring frames"
    yield from subject.box_findings("track-jump", subject.mask(middle_rows[jumps]), message)
    change = np.abs(wrap_angle(np.diff(subject.yaw[rows])))
    turns = change > MAX_TURN_RAD
    is_turned = is_checked & _is_four_wheeled(subject)[middle_rows] & turns[1:] & turns[:-1]
    turned_boxes = subject.mask(middle_rows[is_turned])
    yield from subject.box_findings("track-turn", turned_boxes, "the heading flips back and forth")


def _check_track_gaps(subject: Subject, rows: IntArray, same_track: BoolArray) -> Findings:
    """Find frames that are missing from a track near its agent."""
    boxes = subject.boxes
    distance = np.linalg.norm(boxes.labels.center[rows, :2], axis=1)
    is_near = distance < subject.reach[boxes.agent[rows]]
    skips = np.diff(boxes.frame[rows]) > 1
    gaps = np.flatnonzero(same_track & skips & is_near[1:] & is_near[:-1])
    before = rows[gaps]
    after = rows[gaps + 1]
    center = (subject.centers[before] + subject.centers[after]) / 2
    middle_frame = (boxes.frame[before] + boxes.frame[after]) // 2
    message = "near the agent, but missing in earlier frames"
    for agent in range(len(subject.agents)):
        is_gap = boxes.agent[before] == agent
        is_gap[is_gap] = ~subject.has_untracked(agent, middle_frame[is_gap], center[is_gap])
        yield from subject.box_findings("track-gap", subject.mask(after[is_gap]), message)


def _is_four_wheeled(subject: Subject) -> BoolArray:
    """Return which boxes are four-wheeled vehicles, shape (N,)."""
    categories = subject.boxes.labels.category
    return np.isin(categories, CAR_CODES)


def _second_difference(values: FloatArray) -> FloatArray:
    if len(values) <= 2:
        return np.zeros((0, values.shape[1]))
    return values[2:] - 2 * values[1:-1] + values[:-2]


def _find_repeated(keys: AnyArray) -> BoolArray:
    """Return which keys (N, K) occur more than once, shape (N,)."""
    if not len(keys):
        return np.zeros(0, dtype=bool)
    _, group, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    return counts[group.reshape(-1)] > 1


# The checks of labels, in the order in which findings are listed.
_LABEL_CHECKS: tuple[Callable[[Subject], Findings], ...] = (
    _check_lone_words,
    _check_crowds,
    _check_ids,
    _check_duplicates,
    _check_sizes_and_points,
    _check_own_row_counts,
    _check_own_boxes,
    _check_tracks,
)
