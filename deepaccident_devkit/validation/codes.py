"""Every kind of finding: its severity, its meaning and the remedy (docs/validation.md)."""

from dataclasses import dataclass

from deepaccident_devkit.release.fingerprints import INDEX_REMEDY
from deepaccident_devkit.tables import Severity

_RESTORE = "restore the scenario's files from the archive"
_RESTORE_ONE = "restore the file from its archive"
_KEEP_OUT = "leave the scenario out, or restore it from the archive and validate again"
_NOTHING = "nothing to do; know it when you read numbers"


@dataclass(frozen=True, slots=True)
class Code:
    """A kind of finding.

    Attributes:
        severity: how bad it is.
        meaning: one sentence for the docs.
        remedy: what to do.
        known: why the real release itself has it, empty if it does not.
        deep: whether only `--deep` finds it.
    """

    severity: Severity
    meaning: str
    remedy: str
    known: str = ""
    deep: bool = False


CODES: dict[str, Code] = {
    # archives and the index
    "archive-unreadable": Code(
        "error",
        "An archive is cut off, damaged, encrypted or no zip, and is left out.",
        "fetch it again, or move it out of the folder: the others can be read without it",
    ),
    "archive-unfinished": Code(
        "warning",
        "An archive is left out, as its name is that of a download that has not ended.",
        "let the download end, or start it again",
    ),
    "index-outdated": Code(
        "warning",
        "The index was made from other label, calib or meta files than those that are here.",
        INDEX_REMEDY,
    ),
    # files, as indexing sees them
    "folder-unreadable": Code("error", "A folder cannot be listed.", "unpack its archive again, or make it readable"),
    "folder-left-aside": Code(
        "warning",
        "A folder is not read, as its name only looks like that of a split, scenario type, agent or sensor.",
        "merge it into the folder that it looks like, or rename it to that",
    ),
    "link-leads-nowhere": Code(
        "note",
        "A symbolic link leads to nothing, to itself or to a folder that it lies in, and is not followed.",
        "remove it, or unpack in its place what should be there",
    ),
    "odd-name": Code(
        "error",
        "A label or calib file has no frame number in its name, or a scenario's name is not UTF-8.",
        "rename it",
    ),
    "frames-missing": Code("error", "An agent lacks label or calib files of some frames.", _RESTORE),
    "label-unreadable": Code("error", "A label file is damaged; the finding names the line.", _RESTORE_ONE),
    "calib-unreadable": Code("error", "A calib file is damaged, not rigid, or asks to run something.", _RESTORE_ONE),
    "meta-unreadable": Code("error", "A meta file is damaged.", _RESTORE_ONE),
    "two-places": Code("error", "A scenario stands in two splits or two folders.", "remove it from one"),
    "split-file-unreadable": Code("error", "A split file is damaged.", "restore it from the release"),
    "in-no-split": Code(
        "warning", "There is a file of every split, and none lists this scenario.", "restore the split files"
    ),
    "splits-contradict": Code(
        "warning",
        "A split file lists a scenario that lies in another split's folder, or a mini split one that its split lacks.",
        "move the scenario, or restore the split files",
    ),
    "split-file-partial": Code(
        "note",
        "A split file lists scenarios that are not here.",
        "download them if you need the whole split",
    ),
    "split-file-repeats": Code("warning", "A split file lists a scenario more than once.", "remove all lines but one"),
    "twins-apart": Code(
        "warning",
        "A scenario and its twin (the accident and the normal one of a name) are of different splits.",
        "restore the split files, whose twins go together, or move one of the two",
    ),
    "labels-without-calib": Code(
        "warning", "An agent has labels but no calib files, and is left out.", "unpack its calib archive"
    ),
    "calib-missing": Code(
        "warning", "A scenario has files, but no calib of any agent, and is left out.", "unpack its calib archive"
    ),
    "meta-missing": Code(
        "warning", "A labelled scenario has no meta: weather and collision are unknown.", "unpack the meta folder"
    ),
    "agent-missing": Code("note", "An agent is wholly absent.", "download its archives if you need it"),
    "unlabelled": Code(
        "note",
        "A scenario has no labels.",
        "download them if you need them; those of the test split were never published",
    ),
    "agent-unlabelled": Code("warning", "An agent has no labels, while others have.", "unpack its label archive"),
    # sensor files by their names and sizes
    "sensor-frames-missing": Code("warning", "A sensor folder lacks some frames.", "unpack the sensor's archive again"),
    "sensor-frames-extra": Code("warning", "A sensor folder has frames that no calib file has.", _RESTORE),
    "sensor-odd-name": Code("warning", "A sensor file has no frame number in its name.", "rename or remove it"),
    "sensor-empty": Code("error", "A sensor file has no bytes.", _RESTORE_ONE),
    "sensor-irregular": Code(
        "error", "A pipe, a folder or a link that leads nowhere is among a sensor's files.", _RESTORE_ONE
    ),
    # calibration and poses
    "intrinsic-form": Code(
        "error", "A raw K is not [[cx, f, 0], [cy, 0, -f], [1, 0, 0]]: pixels would be wrong.", _RESTORE_ONE
    ),
    "intrinsic-odd": Code("warning", "A focal length does not fit the camera's field of view.", _RESTORE_ONE),
    "camera-misplaced": Code("warning", "A camera looks another way than its name says, or is far off.", _RESTORE_ONE),
    "lidar-height": Code("warning", "A LiDAR is not where it is mounted on this kind of agent.", _RESTORE_ONE),
    "calib-changes": Code("warning", "A sensor moves on its agent from frame to frame.", _RESTORE_ONE),
    "pole-moves": Code("warning", "The infrastructure's pose changes.", _RESTORE),
    "pose-tilted": Code("warning", "An agent leans by more than 45°.", _RESTORE),
    "pose-jump": Code("warning", "An agent's path has a jump that no vehicle can make.", _RESTORE),
    # labels
    "label-cut": Code("warning", "A label ends within a class: boxes may be missing.", _RESTORE_ONE),
    "label-line-skipped": Code("note", "A label has lines of one word, which readers skip.", _RESTORE_ONE),
    "label-crowded": Code("warning", "A label has more boxes than any scene: points are not counted.", _RESTORE_ONE),
    "own-row-missing": Code("warning", "A vehicle's label lacks its own row (id −100).", _RESTORE_ONE),
    "own-row-odd": Code("warning", "A label has several own rows, or a pole has one.", _RESTORE_ONE),
    "own-box-off": Code(
        "warning", "The own row's box does not stand on the agent's origin, turned as the agent is.", _RESTORE_ONE
    ),
    "own-velocity": Code("warning", "The own row's velocity is not the label's first line.", _RESTORE_ONE),
    "speed-off": Code("warning", "A label's first line does not fit the agent's displacement.", _RESTORE_ONE),
    "duplicate-id": Code("warning", "An id occurs twice in one label.", _RESTORE_ONE),
    "duplicate-box": Code("warning", "Two boxes of a label stand in the same place.", _RESTORE_ONE),
    "odd-id": Code("warning", "An id is not one that the format knows.", _RESTORE_ONE),
    "ids-untracked": Code(
        "warning",
        "All ids of a label, or of an agent's labels, are −1, though its actors can be tracked.",
        _RESTORE_ONE,
    ),
    "odd-size": Code("warning", "A box has no volume, or a size that its class cannot have.", _RESTORE_ONE),
    "odd-position": Code("warning", "A box is absurdly far away.", _RESTORE_ONE),
    "odd-points": Code("warning", "A box counts a negative number of LiDAR points.", _RESTORE_ONE),
    "velocity-unknown": Code(
        "note", "A label's velocity is NaN or infinite.", _NOTHING, known="the release has such velocities"
    ),
    "class-changes": Code("warning", "An actor changes its class from frame to frame.", _RESTORE_ONE),
    "size-changes": Code("warning", "An actor changes its size from frame to frame.", _RESTORE_ONE),
    "track-jump": Code("warning", "An actor makes a jump that no road user can make.", _RESTORE_ONE),
    "track-turn": Code("warning", "A vehicle's heading jumps from frame to frame.", _RESTORE_ONE),
    "track-gap": Code("warning", "A near actor is missing between two frames that have it.", _RESTORE_ONE),
    # agents against each other
    "positions-differ": Code(
        "warning", "Two agents place the same actors apart: a pose, a label or its frame is wrong.", _KEEP_OUT
    ),
    "headings-differ": Code("warning", "Two agents turn the same actors differently.", _KEEP_OUT),
    "sizes-differ": Code("warning", "Two agents give the same actors other sizes.", _KEEP_OUT),
    "classes-differ": Code("warning", "Two agents give the same actors other classes.", _KEEP_OUT),
    "ids-differ": Code("warning", "Two agents give other ids to what stands in the same place.", _KEEP_OUT),
    "own-box-apart": Code(
        "warning", "Others see an agent elsewhere than its own row says, or meta names the wrong id.", _KEEP_OUT
    ),
    "actor-missing": Code(
        "warning", "A near actor that others see is missing from an agent that annotates the rest.", _RESTORE_ONE
    ),
    # velocities
    "velocity-off": Code(
        "warning",
        "Actors' velocities do not fit their displacement, though those of others do.",
        "pass velocity='derived' where their velocities count",
    ),
    "velocity-frame": Code(
        "warning",
        "The labels' velocities are not written as the release writes them, but in another known frame.",
        "nothing to do for the column velocity, which is decoded by what was found; the released protocols use the raw "
        "pair",
    ),
    "velocity-unexplained": Code(
        "warning", "The labels' velocities fit no known frame.", "pass velocity='derived' where velocities count"
    ),
    # meta
    "name-and-folder": Code("warning", "A scenario lies in another type's folder than its name says.", "move it"),
    "meta-word": Code("warning", "Meta says a word that the format does not have.", _RESTORE_ONE),
    "meta-frames": Code("warning", "Meta counts other frames than were recorded (and 10).", _RESTORE),
    "meta-incomplete": Code(
        "note", "Meta lacks some of its lines 2 to 7.", _NOTHING, known="real files lack them now and then"
    ),
    "meta-pair": Code("warning", "Meta's pair, their classes and the colliding agents contradict.", _RESTORE_ONE),
    "pair-not-seen": Code("warning", "Nobody annotated an actor of meta's pair.", _KEEP_OUT),
    "no-contact": Code("warning", "Meta's pair do not touch at the last frame.", _KEEP_OUT),
    "counterpart-unknown": Code(
        "note",
        "Meta names a partner that is no agent and that no label shows.",
        "nothing to do; what needs both skips the accident by name",
        known="one of mini's eight collisions has the id 0",
    ),
    "nobody-named": Code(
        "note",
        "Meta has a colliding pair, and `colliding agents` is `none none`.",
        _NOTHING,
        known="release files say so",
    ),
    "collision-word": Code(
        "note", "Meta's first line has a word for the collision that nobody has found in the release.", _NOTHING
    ),
    "collision-in-normal": Code(
        "note",
        "A scenario of a _normal folder has a collision.",
        _NOTHING,
        known="one of val's 52 normal scenarios has one",
    ),
    "overlap-unnamed": Code(
        "note",
        "A moving actor's box overlaps another's, and meta names no collision.",
        _NOTHING,
        known="a car drives over a pedestrian's box in a real scenario",
    ),
    "no-collision-in-accident": Code(
        "note", "A scenario of an _accident folder has no collision.", _NOTHING, known="the release has such scenarios"
    ),
    "sheer-curtain": Code(
        "note",
        "Vehicles behind sheer curtains are marked invisible.",
        "leave it out where visibility counts, as the released code does",
        known="a CARLA bug in two scenarios of the release",
    ),
    # deep: what the sensors show
    "sensor-unreadable": Code("error", "A sensor file is damaged or of the wrong shape.", _RESTORE_ONE, deep=True),
    "image-size": Code("warning", "An image's size does not fit its K or its neighbours.", _RESTORE_ONE, deep=True),
    "file-repeated": Code("warning", "Two sensor files that should differ are the same.", _RESTORE_ONE, deep=True),
    "image-out-of-sequence": Code(
        "warning", "An image does not fit between its neighbours in time.", _RESTORE_ONE, deep=True
    ),
    "points-odd": Code("warning", "LiDAR points are not finite or out of range.", _RESTORE_ONE, deep=True),
    "points-differ": Code(
        "warning",
        "The LiDAR points in many boxes, or far more or fewer in one, are not those that the labels count.",
        _KEEP_OUT,
        deep=True,
    ),
    "box-points-differ": Code(
        "note",
        "Single boxes hold other LiDAR points than their labels count.",
        _NOTHING,
        known="0.3 % of a real scenario's boxes do, a car with 8 for 19 among them",
        deep=True,
    ),
    "bev-orientation": Code("warning", "The BEV camera's picture is turned or mirrored.", _KEEP_OUT, deep=True),
    "bev-differs": Code(
        "warning", "The BEV camera shows no vehicles where the labels have them.", _KEEP_OUT, deep=True
    ),
}
