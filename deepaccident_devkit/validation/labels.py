"""Checks of one agent's labels without the others: ids, sizes, own rows, tracks (docs/format.md, Label)."""

from collections.abc import Callable, Iterator

import numpy as np

from deepaccident_devkit.release.labels import read_lone_words
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, UNTRACKED_ID
from deepaccident_devkit.validation.subject import MOST_BOXES, Subject, frames_text, near_pairs

MOST_ACTOR_ID = 2_000_000
"""The released code drops ids from here on."""
LENGTHS: dict[str, tuple[float, float]] = {
    "car": (1.8, 7.5),
    "truck": (3.0, 20.0),
    "van": (2.5, 9.0),
    "cyclist": (0.3, 3.0),
    "motorcycle": (0.5, 3.5),
    "pedestrian": (0.1, 1.6),
}
"""Metres, shortest and longest of each class."""
LARGEST_SIZE = 5.0
"""Metres; no road user is wider or higher."""
FURTHEST = 1000.0
"""Metres from the LiDAR in which labels annotate."""
OWN_OFFSET = 0.6
"""Metres that the own row's box may lie off the agent's origin; the real ones reach 0.3."""
OWN_TURN = np.radians(15.0)
"""Heading of the own row's box against the agent's."""
OWN_VELOCITY = 0.05
"""m/s between the own row and the first line, which print the same number with other digits."""
# Metres within which two boxes of a class stand in the same place.
_SAME_PLACE = 0.05
SIZE_CHANGE = 0.02
WALKER_SIZE_CHANGE = 1.0
"""Metres by which a pedestrian's box may change from frame to frame: real ones stretch by 0.62."""
JUMP = 0.6
"""The largest distance of an actor from the middle of its neighbours in time, metres: 120 m/s²."""
TURN = np.radians(40.0)
"""The largest turn of a car from the middle of its neighbours in time."""
LAST_FRAMES = 2
"""Frames at the end in which a collision may throw its pair about."""
_FOUR_WHEELS = [CATEGORIES.index(name) for name in ("car", "truck", "van")]


def check_labels(subject: Subject) -> Iterator[Finding]:
    """All findings in one label, or in one agent's labels, without the others."""
    for check in _CHECKS:
        yield from check(subject)


def _lone_words(subject: Subject) -> Iterator[Finding]:
    """Lines of one word, which readers skip; nothing else shows that a label ends within a class."""
    for agent in subject.files.scan.labelled:
        for frame in range(1, subject.num_frames + 1):
            path = subject.files.scenario.label_path(agent, frame)
            skipped = read_lone_words(path)
            if not skipped:
                continue
            _, word, ends = skipped[-1]
            if ends and any(name.startswith(word) for name in CATEGORIES):
                yield subject.finding(
                    "label-cut", str(path), f"its last line is cut off after '{word}'"
                )
                skipped.pop()
            if skipped:
                number, word, _ = skipped[0]
                what = f"skipped are {len(skipped)} lines of one word, the first is {word!r}"
                yield subject.finding("label-line-skipped", f"{path}:{number}", what)


def _crowds(subject: Subject) -> Iterator[Finding]:
    count = np.bincount(subject.boxes.sample, minlength=subject.files.num_samples)
    for agent, counts in enumerate(count.reshape(len(subject.agents), -1)):
        frames = np.flatnonzero(counts > MOST_BOXES) + 1
        if len(frames):
            what = f"up to {counts.max():,} boxes in a label, more than {MOST_BOXES:,}, {frames_text(frames)}"
            yield subject.finding("label-crowded", subject.label_where(agent), what)


def _ids(subject: Subject) -> Iterator[Finding]:
    label_id = subject.label_id
    odd = (label_id < UNTRACKED_ID) & (label_id != OWN_ACTOR_ID) | (label_id >= MOST_ACTOR_ID)
    yield from subject.label_findings("odd-id", odd, "ids that the format does not know")
    repeated = _repeated(np.column_stack([subject.boxes.sample, label_id])) & (
        label_id != UNTRACKED_ID
    )
    yield from subject.label_findings(
        "duplicate-id", repeated & ~subject.own, "an id occurs twice in one label"
    )


def _same_places(subject: Subject) -> Iterator[Finding]:
    labels, sample = subject.boxes.labels, subject.boxes.sample
    pairs, doubled = near_pairs(
        labels.center, sample * len(CATEGORIES) + labels.category, _SAME_PLACE
    )
    doubled[pairs.ravel()] = True
    yield from subject.label_findings("duplicate-box", doubled, "two boxes stand in the same place")


def _sizes_and_points(subject: Subject) -> Iterator[Finding]:
    size = subject.boxes.labels.size
    shortest, longest = np.array([LENGTHS[name] for name in CATEGORIES])[
        subject.boxes.labels.category
    ].T
    odd: BoolArray = np.any(size <= 0, axis=1) | np.any(size[:, 1:] > LARGEST_SIZE, axis=1)
    unlike = (
        (size[:, 0] < shortest)
        | (size[:, 0] > longest)
        | (_is_car(subject) & (size[:, 0] < size[:, 1]))
    )
    odd |= unlike & (
        subject.label_id != UNTRACKED_ID
    )  # real untracked rows have sizes of another class
    odd |= size[:, 0] > max(most for _, most in LENGTHS.values())
    yield from subject.label_findings("odd-size", odd, "sizes that their classes do not have")
    yield from subject.label_findings(
        "odd-points", subject.boxes.labels.num_lidar_pts < 0, "less than 0 LiDAR points"
    )
    far: BoolArray = np.any(np.abs(subject.boxes.labels.center) > FURTHEST, axis=1)
    yield from subject.label_findings("odd-position", far, f"over {FURTHEST:.0f} m from the LiDAR")
    unknown: BoolArray = np.any(np.isnan(subject.boxes.labels.velocity), axis=1)
    yield from subject.label_findings("velocity-unknown", unknown, "velocities that are no numbers")


def _own_rows(subject: Subject) -> Iterator[Finding]:
    labelled = [agent in subject.files.scan.labelled for agent in subject.agents]
    count = np.bincount(subject.boxes.sample[subject.own], minlength=subject.files.num_samples)
    for agent, counts in enumerate(count.reshape(len(subject.agents), -1)):
        if not labelled[agent]:
            continue
        expected = 0 if subject.is_pole(agent) else 1
        for code, frames in (
            ("own-row-missing", np.flatnonzero(counts < expected) + 1),
            ("own-row-odd", np.flatnonzero(counts > expected) + 1),
        ):
            if len(frames):
                what = f"expected {expected} rows of id {OWN_ACTOR_ID}, found another number in {frames_text(frames)}"
                yield subject.finding(code, subject.label_where(agent), what)


def _own_boxes(subject: Subject) -> Iterator[Finding]:
    rows = np.flatnonzero(subject.own)
    pose = subject.files.calibs.world_from_ego[subject.boxes.sample[rows]]
    standing = (
        pose[:, :3, 3] + pose[:, :3, 2] * subject.boxes.labels.size[rows, 2:] / 2
    )  # on the road, upright
    turn = subject.yaw[rows] - np.arctan2(pose[:, 1, 0], pose[:, 0, 0])
    far = np.zeros(len(subject.own), dtype=bool)
    far[rows] = np.linalg.norm(subject.centers[rows] - standing, axis=1) > OWN_OFFSET
    far[rows] |= np.abs(np.arctan2(np.sin(turn), np.cos(turn))) > OWN_TURN
    what = f"the own box is turned, or over {OWN_OFFSET} m off standing on the agent's origin"
    yield from subject.label_findings("own-box-off", far, what)
    first_line = np.full((subject.files.num_samples, 2), np.nan)
    labelled = np.repeat(
        [agent in subject.files.scan.labelled for agent in subject.agents], subject.num_frames
    )
    first_line[labelled] = subject.files.labels.agent_velocity
    differs = np.zeros(len(subject.own), dtype=bool)
    difference = np.abs(
        subject.boxes.labels.velocity[rows] - first_line[subject.boxes.sample[rows]]
    ).max(axis=1)
    differs[rows] = difference > OWN_VELOCITY
    yield from subject.label_findings(
        "own-velocity", differs, "the agent's own velocity differs from the first line"
    )


def _tracks(subject: Subject) -> Iterator[Finding]:
    """Changes along each track: one agent's rows of one id."""
    rows = np.flatnonzero(subject.seen)
    boxes = subject.boxes
    rows = rows[np.lexsort((boxes.frame[rows], subject.label_id[rows], boxes.agent[rows]))]
    frame = boxes.frame[rows]
    same = (subject.label_id[rows][1:] == subject.label_id[rows][:-1]) & (
        boxes.agent[rows][1:] == boxes.agent[rows][:-1]
    )
    allowed = np.where(
        boxes.labels.category == CATEGORIES.index("pedestrian"), WALKER_SIZE_CHANGE, SIZE_CHANGE
    )
    for code, changed in (
        ("class-changes", boxes.labels.category[rows][1:] != boxes.labels.category[rows][:-1]),
        (
            "size-changes",
            np.abs(np.diff(boxes.labels.size[rows], axis=0)).max(axis=1) > allowed[rows[1:]],
        ),
    ):
        yield from subject.label_findings(
            code, subject.mask(rows[1:][same & changed]), "changes along the track"
        )
    step = np.diff(frame)
    three = same[1:] & same[:-1] & (step[1:] == 1) & (step[:-1] == 1)
    bend = np.linalg.norm(_second_difference(subject.centers[rows]), axis=1) / 2
    free = ~(subject.in_collision[rows[1:-1]] & (frame[2:] > subject.num_frames - LAST_FRAMES))
    jumps = three & (bend > JUMP) & free
    yield from subject.label_findings(
        "track-jump",
        subject.mask(rows[1:-1][jumps]),
        f"over {JUMP} m off the middle of the frames around",
    )
    yaw = subject.yaw[rows]
    steps = np.abs(np.arctan2(np.sin(np.diff(yaw)), np.cos(np.diff(yaw))))
    turns = three & free & _is_car(subject)[rows[1:-1]] & (steps[1:] > TURN) & (steps[:-1] > TURN)
    yield from subject.label_findings(
        "track-turn", subject.mask(rows[1:-1][turns]), "turned to and fro"
    )
    near = np.linalg.norm(boxes.labels.center[rows, :2], axis=1) < subject.reach[boxes.agent[rows]]
    gap = np.flatnonzero(same & (step > 1) & near[1:] & near[:-1])
    before, after = rows[gap], rows[gap + 1]
    middle = (subject.centers[before] + subject.centers[after]) / 2
    for agent in range(len(subject.agents)):
        of_agent = boxes.agent[before] == agent
        frames = (boxes.frame[before] + boxes.frame[after])[of_agent] // 2
        of_agent[of_agent] = ~subject.has_untracked(agent, frames, middle[of_agent])
        yield from subject.label_findings(
            "track-gap", subject.mask(after[of_agent]), "near, and missing in the frames before"
        )


def _is_car(subject: Subject) -> BoolArray:
    """(N,) boxes of what has four wheels."""
    return np.isin(subject.boxes.labels.category, _FOUR_WHEELS)


def _second_difference(values: FloatArray) -> FloatArray:
    return (
        values[2:] - 2 * values[1:-1] + values[:-2]
        if len(values) > 2
        else np.zeros((0, values.shape[1]))
    )


def _repeated(keys: AnyArray) -> BoolArray:
    """Which rows of keys (N, K) occur more than once."""
    if not len(keys):
        return np.zeros(0, dtype=bool)
    _, inverse, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(count[inverse.reshape(-1)] > 1)


_CHECKS: tuple[Callable[[Subject], Iterator[Finding]], ...] = (
    _lone_words,
    _crowds,
    _ids,
    _same_places,
    _sizes_and_points,
    _own_rows,
    _own_boxes,
    _tracks,
)
