"""`validate`: healthy releases are clean, what it says is right, and it says so in every form it
promises.

Planted faults are in tests/fault_injection; here are the rules behind them and what a fault cannot
show.
"""

import json
import shutil
import tracemalloc
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import tiny
from PIL import Image
from refusals import assert_refused
from verbs import called

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import LabelError, TokenError
from deepaccident_devkit.release import read_labels
from deepaccident_devkit.release.npz import read_npz
from deepaccident_devkit.tables import scan
from deepaccident_devkit.validation import Finding, ValidationReport, validate_release
from deepaccident_devkit.validation.sensors import PICTURE_ORIENTATIONS, out_of_sequence

SKIPPED = ("label-line-skipped", "note")


def codes(report: ValidationReport) -> set[str]:
    return {finding.code for finding in report.findings}


def labels_of(root: Path, agent: str) -> list[Path]:
    return sorted(root.glob(f"**/{agent}/label/*/*.txt"))


def rewrite_boxes(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    first, *lines = path.read_text().splitlines()
    path.write_text("\n".join([first, *(" ".join(change(line.split())) for line in lines)]) + "\n")


@pytest.mark.slow
def test_healthy_releases_are_clean(release_root: Path, release_root_b: Path) -> None:
    for root, deep in ((release_root, True), (release_root_b, False)):
        report = validate_release(root, deep=deep)
        assert (report.findings, report.is_good, report.velocity.best) == ([], True, "released")
        assert set(report.velocity_frames) == {
            f"{path.parts[-3]}/{path.stem}" for path in root.glob("**/meta/*.txt")
        }


def test_partial_downloads_are_notes(own_release: Path) -> None:
    for folder in (
        *own_release.glob("train/*/infrastructure"),
        *own_release.glob("test/*/*/label"),
    ):
        shutil.rmtree(folder)
    report = validate_release(own_release)
    assert (report.is_good, codes(report)) == (True, {"agent-missing", "unlabelled"})
    lacking = {
        (name, each.agent): each.missing == each.expected
        for name, split in report.files.splits.items()
        for each in split.files
        if each.missing and each.channel == "label"
    }
    assert lacking == {("train", "infrastructure"): True}


def test_a_few_frames_of_a_sensor_are_listed(release_root: Path, tmp_path: Path) -> None:
    root = tmp_path / "release"
    shutil.copytree(
        release_root, root, ignore=shutil.ignore_patterns(".deepaccident", "Camera_*", "*_BEV_*")
    )
    scenario = DeepAccident(dataroot=root, verbose=False).scenario[0]
    for agent, frame in (
        *product(["ego_vehicle"], (1, 3, 4, 6)),
        *product(["other_vehicle"], (5, 6)),
    ):
        folder = root / scenario["scenario_type"] / agent / "lidar01" / scenario["name"]
        (folder / f"{scenario['name']}_{frame:03d}.npz").unlink()
    few, last = (
        each.what for each in validate_release(root, scenarios=[scenario["token"]]).findings
    )
    assert ("(2, 5)" in few, "5–6" in last) == (True, True)


def write_velocities(root: Path, angle: Callable[[float, float], float]) -> dict[str, np.ndarray]:
    """Write each box's world velocity turned by `angle` of its yaw and its agent's, and return the
    truth by token.
    """
    release = DeepAccident(dataroot=root, verbose=False)
    truth = {}
    for sample in release.sample:
        boxes = release.boxes(sample)
        truth[sample["token"]] = boxes.velocity
        rotation = release.world_from(sample["token"], "lidar").rotation
        agent_yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
        scenario = release.get("scenario", sample["scenario_token"])
        frame, name = release.get("frame", sample["frame_token"])["index"], scenario["name"]
        folder = (
            root / scenario["folder"] / scenario["scenario_type"] / sample["agent"] / "label" / name
        )
        velocities = iter(boxes.velocity[:, :2])

        def turned(words: list[str], rows=velocities, agent_yaw=agent_yaw) -> list[str]:
            (x, y), turn = next(rows), angle(-float(words[7]), agent_yaw)
            if words[10] != "-100":
                words[8] = repr(float(np.cos(turn) * x - np.sin(turn) * y))
                words[9] = repr(float(-np.sin(turn) * x - np.cos(turn) * y))
            return words

        rewrite_boxes(folder / f"{name}_{frame:03d}.txt", turned)
    return truth


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "angle"),
    [
        ("world", lambda _yaw, _agent: 0.0),
        ("lidar", lambda _yaw, agent: -agent),
        ("turned-wrong", lambda _yaw, agent: agent),
        ("box", lambda yaw, agent: -(yaw + agent)),
        ("released", lambda yaw, _agent: yaw),
    ],
)
def test_velocities_in_another_frame_are_told_and_decoded(
    own_release: Path, name: str, angle: Callable[[float, float], float]
) -> None:
    truth = write_velocities(own_release, angle)
    shutil.rmtree(own_release / ".deepaccident")
    report = validate_release(own_release)
    told = {(finding.code, finding.severity, finding.known) for finding in report.findings}
    assert (report.velocity.best, told) == (
        name,
        {("velocity-frame", "warning", False)} if name != "released" else set(),
    )
    release = DeepAccident(dataroot=own_release, verbose=False)
    frames = {scenario["token"]: scenario["velocity_frame"] for scenario in release.scenario}
    assert frames == report.velocity_frames == dict.fromkeys(frames, name)
    for token, velocity in truth.items():
        np.testing.assert_allclose(release.boxes(token).velocity[:, :2], velocity[:, :2], atol=0.02)


def test_velocities_of_no_frame_are_told(own_release: Path) -> None:
    for path in labels_of(own_release, "*"):
        rewrite_boxes(
            path,
            lambda words: (
                words if words[10] == "-100" else [*words[:8], "31.0", "-17.0", *words[10:]]
            ),
        )
    report = validate_release(own_release)
    assert (report.velocity.best, codes(report)) == (None, {"velocity-unexplained"})


def test_findings_of_one_scenario_even_if_it_is_left_out(tmp_path: Path) -> None:
    other = "Town05_type001_subtype0001_scenario00007"
    root = tiny.write_tiny_release(tmp_path / "release")
    tiny.write_tiny_release(root, name=other)
    label = root / tiny.TYPE / "ego_vehicle" / "label" / tiny.NAME / f"{tiny.NAME}_002.txt"
    label.write_text("0 0\ncar 1 2\n")
    release = DeepAccident(dataroot=root, verbose=False, on_error="skip")
    (finding,) = [found for found in release.findings(tiny.TOKEN) if found.severity == "error"]
    told = ("label-unreadable", f"{label}:2", "expected 13 fields, found 3: 'car 1 2'")
    assert (finding.code, finding.where, finding.what) == told
    assert [str(finding)] == list(
        release.problems[0].messages
    )  # one implementation: what indexing said
    assert not [
        found for found in release.findings(release.scenario[0]) if found.severity == "error"
    ]
    assert_refused(
        (lambda: release.findings("nowhere"), TokenError, "has no scenario 'nowhere'"),
        *(
            (
                lambda given=each: release.findings(given),
                TokenError,
                "expected a token or a record with one, found",
            )
            for each in (None, 5, {}, {"token": None}, ["a/b"])
        ),
    )


def test_the_known_faults_of_the_release_are_told_apart(tmp_path: Path) -> None:
    def found(number: str, **of_scenario: str) -> dict[str, tuple[bool, str]]:
        report = validate_release(tiny.write_tiny_release(tmp_path / number, **of_scenario))
        return {one.code: (one.known, one.severity) for one in report.findings}

    curtain = {
        "scenario_type": "type1_subtype2_accident",
        "name": "Town05_type001_subtype0002_scenario00035",
    }
    known = found("curtain", **curtain, meta="ClearNoon -1 -1 -1 -1 -1 -1 -1 14\n")
    assert {
        known[code][0] for code in ("sheer-curtain", "no-collision-in-accident", "meta-incomplete")
    } == {True}
    normal = {"scenario_type": "type1_subtype2_normal"}
    assert found("normal", **normal)["collision-in-normal"] == (True, "note")


@pytest.mark.parametrize(
    ("changes", "codes_told", "said"),
    [
        ({"1212 car": "0 car"}, {"counterpart-unknown"}, "nobody annotated actor 0"),
        (
            {"1212 car": "7 bus", "ego other": "ego none"},
            {"counterpart-unknown"},
            "nobody annotated actor 7",
        ),
        (
            {"1212 car": "7 car"},
            {"counterpart-unknown", "meta-pair"},
            "'ego other' are not the pair (1223, 7)",
        ),
        ({"ego other": "none none"}, {"nobody-named"}, "the colliding agents are 'none none'"),
        (
            {"same": "across"},
            {"collision-word"},
            "spawn relation is 'across', the release is known to have same, opp",
        ),
        ({"front_side": "left_side"}, {"collision-word"}, "contact side is 'left_side'"),
        ({"same front_side": "opposite rear"}, set(), ""),
    ],
)
def test_what_meta_says_of_a_collision(
    tmp_path: Path, changes: dict[str, str], codes_told: set[str], said: str
) -> None:
    """The tiny agents stand far apart, which is told in any case."""
    meta = tiny.META
    for old, new in changes.items():
        meta = meta.replace(old, new)
    report = validate_release(tiny.write_tiny_release(tmp_path, meta=meta))
    sound = {"no-contact"} if "1223 car 1212" in meta else set()
    assert codes(report) == codes_told | sound
    assert all(
        finding.severity == ("warning" if finding.code in ("meta-pair", "no-contact") else "note")
        for finding in report.findings
    )
    assert any(said in finding.what for finding in report.findings) or not said


@pytest.mark.parametrize(
    ("speed", "gap", "said"),
    [
        (0.0, -0.5, ""),
        (2.0, 0.5, ""),
        (2.0, -0.2, "actors 1300, 1400 overlap by up to 0.20 m, frame 4"),
    ],
)
def test_a_mover_that_overlaps_somebody_is_noted(
    tmp_path: Path, speed: float, gap: float, said: str
) -> None:
    """Parked rows overlap in the release, and in an accident the pair does."""

    def lines(agent: str, frame: int) -> list[str]:
        x = 20.0 + speed * (frame - 4) / 10
        rows = [(x, 1300, speed), (24.0 + gap, 1400, 0.0)] if agent == "infrastructure" else []
        return [
            "0 0",
            *(f"car {at} 0 -1.2 4 2 1.5 0 {now} 0 {actor} 9 True" for at, actor, now in rows),
        ]

    where = {
        "scenario_type": "type1_subtype1_normal",
        "meta": "ClearNoon -1 -1 -1 -1 -1 -1 -1 14\n",
    }
    root = tiny.write_tiny_release(tmp_path, lines_of=lines, agents=("infrastructure",), **where)
    told = [
        finding for finding in validate_release(root).findings if finding.code == "overlap-unnamed"
    ]
    assert [(finding.what, finding.severity) for finding in told] == (
        [(said, "note")] if said else []
    )


def test_what_is_left_aside_is_named(tmp_path: Path) -> None:
    root = tiny.write_tiny_release(tmp_path / "release")
    copy, loop = root / f"{tiny.TYPE} (1)", root / tiny.TYPE / "loop"
    tiny.write_tiny_release(copy.parent, scenario_type=copy.name)
    loop.symlink_to(root)
    told = [found for found in validate_release(root, workers=1).findings if found.scenario is None]
    assert [(found.code, found.severity, found.where) for found in told] == [
        ("folder-left-aside", "warning", str(copy)),
        ("link-leads-nowhere", "note", str(loop)),
    ]
    assert told[0].what == f"is not read; it looks like {tiny.TYPE}"
    assert [
        found
        for found in validate_release(root, scenarios=[tiny.TOKEN]).findings
        if not found.scenario
    ] == []


TURNS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "mirrored": lambda picture: picture[:, ::-1],
    "backward-up": lambda picture: picture[::-1, ::-1],
    "mirrored-backward": lambda picture: picture[::-1],
    "left-up": lambda picture: np.rot90(picture, -1),
    "right-up": lambda picture: np.rot90(picture, 1),
    "transposed": lambda picture: picture.swapaxes(0, 1),
    "anti-transposed": lambda picture: np.rot90(picture, 2).swapaxes(0, 1),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "orientation", [name for name in PICTURE_ORIENTATIONS if name != "forward-up"]
)
def test_a_turned_bev_camera_is_recognised(
    release_root: Path, tmp_path: Path, orientation: str
) -> None:
    agent = next(release_root.glob("*_accident")) / "ego_vehicle"
    for kind in ("calib", "label", "BEV_instance_camera"):
        shutil.copytree(agent / kind, tmp_path / agent.parent.name / agent.name / kind)
    for path in tmp_path.glob("*/ego_vehicle/BEV_instance_camera/*/*.npz"):
        np.savez(path, data=TURNS[orientation](read_npz(path, "bev")))
    findings = validate_release(tmp_path, deep=True).findings
    assert {
        f"'{orientation}'" in finding.what
        for finding in findings
        if finding.code == "bev-orientation"
    } == {True}


def test_images_out_of_sequence() -> None:
    rng = np.random.default_rng(0)
    scene, foreign = rng.uniform(0, 64, (18, 32, 3)), rng.uniform(0, 255, (18, 32, 3))
    smooth = {frame: 10.0 * frame + scene for frame in range(1, 9)}
    for images, found in (
        (smooth, []),
        *(({**smooth, frame: foreign}, [frame]) for frame in smooth),
        ({1: smooth[1], 2: foreign}, []),  # two pictures have no sequence
        ({1: smooth[1], 2: smooth[2], 28: foreign, 29: smooth[3], 51: smooth[1]}, []),
        ({**smooth, 20: foreign, 31: smooth[1], 32: foreign, 33: smooth[3]}, [32]),
    ):
        assert out_of_sequence(images) == found


@pytest.mark.parametrize(("place", "is_told"), [(0, True), (-1, False)])
def test_at_the_impact_another_car_may_fill_the_view(
    da: DeepAccident, tmp_path: Path, place: int, *, is_told: bool
) -> None:
    accidents = (each for each in da.scenario if each["collision"])
    token, agent = next(
        (each["token"], name) for each in accidents for name in each["collision"]["agents"] if name
    )
    of_type, name = token.split("/")
    for folder in (
        *(f"{agent}/{kind}/{name}" for kind in ("calib", "label", "Camera_Front")),
        "meta",
    ):
        shutil.copytree(da.dataroot / of_type / folder, tmp_path / of_type / folder)
    images = sorted(tmp_path.glob("*/*/Camera_Front/*/*.jpg"))
    for path in images[1:]:
        shutil.copy(images[0], path)
    other = np.random.default_rng(0).integers(0, 256, (36, 64, 3), dtype=np.uint8)
    Image.fromarray(other).save(images[place], quality=90)
    assert (
        "image-out-of-sequence" in codes(validate_release(tmp_path, deep=True, scenarios=[token]))
    ) is is_told


def test_json_has_everything_and_exit_status_tells(own_release: Path) -> None:
    def run(*words: str, status: int) -> str:
        return called("validate", own_release, *words, status=status).stdout

    content = json.loads(run("--json", status=0))
    assert (content["counts"], content["velocity"]["best"]) == (
        dict.fromkeys(("error", "warning", "note"), 0),
        "released",
    )
    first = labels_of(own_release, "ego_vehicle")[0]
    first.write_text(first.read_text()[:-20])
    (finding,) = json.loads(run("--json", status=1))["findings"]
    assert set(finding) == {"code", "severity", "scenario", "where", "what", "remedy", "known"}
    assert f"label-unreadable: {finding['where']}: " in run(status=1)
    assert json.loads(run("--scenario", finding["scenario"], "--json", status=1))["scenarios"] == 1


def test_the_worst_scenario_comes_first(own_release: Path) -> None:
    files = labels_of(own_release, "other_vehicle")
    warned, broken = sorted({path.parent for path in files})[:2]
    for path in broken.iterdir():
        path.write_text("")
    rewrite_boxes(
        sorted(warned.iterdir())[1], lambda row: [row[0], repr(float(row[1]) + 3), *row[2:]]
    )
    findings = validate_release(own_release).findings
    order = [
        str(scenario).split("/")[1]
        for scenario in dict.fromkeys(finding.scenario for finding in findings)
    ]
    assert order == [broken.name, warned.name]
    assert findings == sorted(
        findings, key=lambda finding: ("error", "warning", "note").index(finding.severity)
    )


@pytest.mark.parametrize(
    ("change", "code", "severity", "line"),
    [
        (
            lambda text: text.replace(b"\n", b"\n" + 100 * b"word" + b"\n", 1) + b"\nanother\n",
            *SKIPPED,
            2,
        ),
        (
            lambda text: 2 * b"\xef\xbb\xbf" + text,
            "label-unreadable",
            "error",
            1,
        ),  # alone, Arrow would drop one
    ],
    ids=["words alone on a line", "two marks of byte order"],
)
def test_a_label_that_is_read_in_part_or_not(
    small: Path, change, code: str, severity: str, line: int
) -> None:
    path = labels_of(small, "ego_vehicle")[2]
    path.write_bytes(change(path.read_bytes()))
    (finding,) = validate_new(small)
    assert (finding.code, finding.severity, finding.where) == (code, severity, f"{path}:{line}")
    assert len(finding.what) < 200


@pytest.mark.parametrize("actor", ["-1", "{row}"])
def test_a_crowd_at_one_place_is_told_in_time_that_grows_with_it(small: Path, actor: str) -> None:
    """20,000 boxes would be 200 million pairs."""
    path = labels_of(small, "ego_vehicle")[2]
    rows = (
        f"car 9.0 9.0 -1.0 4.0 2.0 1.5 0.0 0.0 0.0 {actor.format(row=row)} 5 True"
        for row in range(40_000, 60_000)
    )
    lines = [*path.read_text().splitlines(), *rows]
    path.write_text("\n".join(lines))
    tracemalloc.start()
    found = {finding.code: finding.what for finding in validate_new(small)}
    assert tracemalloc.get_traced_memory()[1] < 100 * 2**20
    tracemalloc.stop()
    assert (
        found["label-crowded"]
        == f"up to {len(lines) - 1:,} boxes in a label, more than 500, frame 3"
    )
    assert found["duplicate-box"].startswith("two boxes stand in the same place")


def validate_new(root: Path) -> list[Finding]:
    """Findings but for the four agents that a small release lacks, and what follows from it."""
    return [
        one for one in validate_release(root, workers=1).findings if one.code != "agent-missing"
    ]


def test_labels_that_are_good_alone_but_not_together_are_a_finding(
    small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read(paths: list[Path]) -> object:
        if len(paths) > 1:
            raise LabelError("the labels: do not go together; mend them")
        return read_labels(paths)

    monkeypatch.setattr(scan, "read_labels", read)
    (finding,) = validate_new(small)
    assert (finding.code, str(finding)) == (
        "label-unreadable",
        "the labels: do not go together; mend them",
    )
