"""`validate`: healthy releases are clean, and findings are right in every form of the report.
Planted faults are in tests/fault_injection; here are the rules behind them, and what a fault
cannot show.
"""

import json
import shutil
import tracemalloc
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support import tiny_release
from support.command_calls import invoke_command
from support.expected_errors import assert_raises
from support.tiny_release import META_TEXT, SCENARIO_NAME, SCENARIO_TOKEN, SCENARIO_TYPE

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import LabelError, TokenError
from deepaccident_devkit.release import read_labels
from deepaccident_devkit.release.npz import read_npz
from deepaccident_devkit.tables import scan
from deepaccident_devkit.validation import Finding, ValidationReport, validate_release
from deepaccident_devkit.validation.sensors import PICTURE_ORIENTATIONS, out_of_sequence

SKIPPED_LINE_NOTE = ("label-line-skipped", "note")


def collect_codes(report: ValidationReport) -> set[str]:
    return {finding.code for finding in report.findings}


def list_labels(root: Path, agent: str) -> list[Path]:
    return sorted(root.glob(f"**/{agent}/label/*/*.txt"))


def rewrite_boxes(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    first_line, *lines = path.read_text().splitlines()
    new_lines = [first_line, *(" ".join(change(line.split())) for line in lines)]
    path.write_text("\n".join(new_lines) + "\n")


@pytest.mark.slow
def test_healthy_releases_are_clean(release_root: Path, release_root_b: Path) -> None:
    for root, deep in ((release_root, True), (release_root_b, False)):
        report = validate_release(root, deep=deep)
        meta_paths = root.glob("**/meta/*.txt")
        assert report.findings == []
        assert report.is_good is True
        assert report.velocity.best == "released"
        assert set(report.velocity_frames) == {
            f"{path.parts[-3]}/{path.stem}" for path in meta_paths
        }


def test_partial_downloads_are_notes(own_release: Path) -> None:
    removed_folders = (
        *own_release.glob("train/*/infrastructure"),
        *own_release.glob("test/*/*/label"),
    )
    for folder in removed_folders:
        shutil.rmtree(folder)
    report = validate_release(own_release)
    assert report.is_good is True
    assert collect_codes(report) == {"agent-missing", "unlabelled"}

    is_all_missing = {}
    for name, split in report.files.splits.items():
        for count in split.files:
            if count.missing and count.channel == "label":
                is_all_missing[name, count.agent] = count.missing == count.expected
    assert is_all_missing == {("train", "infrastructure"): True}


def test_a_few_frames_of_a_sensor_are_listed(release_root: Path, tmp_path: Path) -> None:
    root = tmp_path / "release"
    ignored = shutil.ignore_patterns(".deepaccident", "Camera_*", "*_BEV_*")
    shutil.copytree(release_root, root, ignore=ignored)
    scenario = DeepAccident(dataroot=root, verbose=False).scenario[0]
    for agent, frames in (("ego_vehicle", (1, 3, 4, 6)), ("other_vehicle", (5, 6))):
        folder = root / scenario["scenario_type"] / agent / "lidar01" / scenario["name"]
        for frame in frames:
            (folder / f"{scenario['name']}_{frame:03d}.npz").unlink()

    ego_finding, other_finding = validate_release(root, scenarios=[scenario["token"]]).findings
    assert "(2, 5)" in ego_finding.what
    assert "5–6" in other_finding.what


def write_velocities(root: Path, angle: Callable[[float, float], float]) -> dict[str, np.ndarray]:
    """Write each box's world velocity, turned by `angle(box_yaw, agent_yaw)`, and return the true
    velocities by sample token.
    """
    release = DeepAccident(dataroot=root, verbose=False)
    velocities_by_token = {}
    for sample in release.sample:
        boxes = release.boxes(sample)
        velocities_by_token[sample["token"]] = boxes.velocity
        rotation = release.world_from(sample["token"], "lidar").rotation
        agent_yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
        scenario = release.get("scenario", sample["scenario_token"])
        frame = release.get("frame", sample["frame_token"])["index"]
        type_folder = root / scenario["folder"] / scenario["scenario_type"]
        folder = type_folder / sample["agent"] / "label" / scenario["name"]
        velocities = iter(boxes.velocity[:, :2])

        def turn_velocity(row: list[str], velocities=velocities, agent_yaw=agent_yaw) -> list[str]:
            x, y = next(velocities)
            turn = angle(-float(row[7]), agent_yaw)
            if row[10] != "-100":
                row[8] = repr(float(np.cos(turn) * x - np.sin(turn) * y))
                row[9] = repr(float(-np.sin(turn) * x - np.cos(turn) * y))
            return row

        rewrite_boxes(folder / f"{scenario['name']}_{frame:03d}.txt", turn_velocity)
    return velocities_by_token


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
def test_velocities_in_another_frame_are_reported_and_decoded(
    own_release: Path, name: str, angle: Callable[[float, float], float]
) -> None:
    velocities_by_token = write_velocities(own_release, angle)
    shutil.rmtree(own_release / ".deepaccident")
    expected = set() if name == "released" else {("velocity-frame", "warning", False)}

    report = validate_release(own_release)
    assert report.velocity.best == name
    findings = report.findings
    assert {(finding.code, finding.severity, finding.known) for finding in findings} == expected

    release = DeepAccident(dataroot=own_release, verbose=False)
    frames = {scenario["token"]: scenario["velocity_frame"] for scenario in release.scenario}
    assert frames == report.velocity_frames == dict.fromkeys(frames, name)
    for token, velocity in velocities_by_token.items():
        np.testing.assert_allclose(release.boxes(token).velocity[:, :2], velocity[:, :2], atol=0.02)


def test_velocities_of_no_frame_are_reported(own_release: Path) -> None:
    def change_velocity(row: list[str]) -> list[str]:
        if row[10] != "-100":
            row[8:10] = ["31.0", "-17.0"]
        return row

    for path in list_labels(own_release, "*"):
        rewrite_boxes(path, change_velocity)
    report = validate_release(own_release)
    assert report.velocity.best is None
    assert collect_codes(report) == {"velocity-unexplained"}


def test_findings_of_a_scenario_are_known_even_if_it_is_left_out(tmp_path: Path) -> None:
    root = tiny_release.write_tiny_release(tmp_path / "release")
    tiny_release.write_tiny_release(root, name="Town05_type001_subtype0001_scenario00007")
    name = SCENARIO_NAME
    folder = root / SCENARIO_TYPE / "ego_vehicle" / "label" / name
    label = folder / f"{name}_002.txt"
    label.write_text("0 0\ncar 1 2\n")
    release = DeepAccident(dataroot=root, verbose=False, on_error="skip")

    findings = release.findings(SCENARIO_TOKEN)
    [error] = [finding for finding in findings if finding.severity == "error"]
    assert error.code == "label-unreadable"
    assert error.where == f"{label}:2"
    assert error.what == "expected 13 fields, found 3: 'car 1 2'"
    # indexing uses the same implementation
    assert [str(error)] == list(release.problems[0].messages)
    other_findings = release.findings(release.scenario[0])
    assert "error" not in [finding.severity for finding in other_findings]
    assert_raises(
        (lambda: release.findings("nowhere"), TokenError, "has no scenario 'nowhere'"),
        *(
            (
                partial(release.findings, scenario),
                TokenError,
                "expected a token or a record with one, found",
            )
            for scenario in (None, 5, {}, {"token": None}, ["a/b"])
        ),
    )


def test_the_known_faults_of_the_release_are_marked_as_known(tmp_path: Path) -> None:
    def validate_scenario(folder: str, **options: str) -> dict[str, Finding]:
        root = tiny_release.write_tiny_release(tmp_path / folder, **options)
        return {finding.code: finding for finding in validate_release(root).findings}

    curtain = validate_scenario(
        "curtain",
        scenario_type="type1_subtype2_accident",
        name="Town05_type001_subtype0002_scenario00035",
        meta="ClearNoon -1 -1 -1 -1 -1 -1 -1 14\n",
    )
    for code in ("sheer-curtain", "no-collision-in-accident", "meta-incomplete"):
        assert curtain[code].known is True, code
    normal = validate_scenario("normal", scenario_type="type1_subtype2_normal")
    assert normal["collision-in-normal"].known is True
    assert normal["collision-in-normal"].severity == "note"


@pytest.mark.parametrize(
    ("changes", "expected_codes", "message"),
    [
        ({"1212 car": "0 car"}, {"counterpart-unknown"}, "no agent annotated actor 0"),
        (
            {"1212 car": "7 bus", "ego other": "ego none"},
            {"counterpart-unknown"},
            "no agent annotated actor 7",
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
            "spawn relation is 'across', but known values are same, opp",
        ),
        ({"front_side": "left_side"}, {"collision-word"}, "contact side is 'left_side'"),
        ({"same front_side": "opposite rear"}, set(), ""),
    ],
)
def test_faults_of_a_collision_in_meta_are_findings(
    tmp_path: Path, changes: dict[str, str], expected_codes: set[str], message: str
) -> None:
    """The tiny agents stand far apart, which is a finding in any case."""
    meta = META_TEXT
    for old, new in changes.items():
        meta = meta.replace(old, new)
    if "1223 car 1212" in meta:
        expected_codes = expected_codes | {"no-contact"}

    report = validate_release(tiny_release.write_tiny_release(tmp_path, meta=meta))
    assert collect_codes(report) == expected_codes
    for finding in report.findings:
        is_warning = finding.code in ("meta-pair", "no-contact")
        assert finding.severity == ("warning" if is_warning else "note")
    assert any(message in finding.what for finding in report.findings) or not message


@pytest.mark.parametrize(
    ("speed_m_s", "gap_m", "message"),
    [
        (0.0, -0.5, ""),
        (2.0, 0.5, ""),
        (2.0, -0.2, "actors 1300, 1400 overlap by up to 0.20 m, frame 4"),
    ],
)
def test_a_mover_that_overlaps_another_actor_is_noted(
    tmp_path: Path, speed_m_s: float, gap_m: float, message: str
) -> None:
    """Parked rows overlap in the release, and in an accident the pair does."""

    def make_lines(_agent: str, frame: int) -> list[str]:
        x = 20.0 + speed_m_s * (frame - 4) / 10
        return [
            "0 0",
            f"car {x} 0 -1.2 4 2 1.5 0 {speed_m_s} 0 1300 9 True",
            f"car {24.0 + gap_m} 0 -1.2 4 2 1.5 0 0.0 0 1400 9 True",
        ]

    root = tiny_release.write_tiny_release(
        tmp_path,
        lines_of=make_lines,
        agents=("infrastructure",),
        scenario_type="type1_subtype1_normal",
        meta="ClearNoon -1 -1 -1 -1 -1 -1 -1 14\n",
    )
    findings = validate_release(root).findings
    overlaps = [finding for finding in findings if finding.code == "overlap-unnamed"]
    expected = [(message, "note")] if message else []
    assert [(finding.what, finding.severity) for finding in overlaps] == expected


def test_folders_that_are_left_aside_are_named(tmp_path: Path) -> None:
    root = tiny_release.write_tiny_release(tmp_path / "release")
    copy = root / f"{SCENARIO_TYPE} (1)"
    loop = root / SCENARIO_TYPE / "loop"
    tiny_release.write_tiny_release(root, scenario_type=copy.name)
    loop.symlink_to(root)

    findings = validate_release(root, workers=1).findings
    findings = [finding for finding in findings if finding.scenario is None]
    assert [(finding.code, finding.severity, finding.where) for finding in findings] == [
        ("folder-left-aside", "warning", str(copy)),
        ("link-leads-nowhere", "note", str(loop)),
    ]
    assert findings[0].what == f"is ignored; it looks like {SCENARIO_TYPE}"
    part_report = validate_release(root, scenarios=[SCENARIO_TOKEN])
    assert all(finding.scenario for finding in part_report.findings)


PICTURE_TURNS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
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
        np.savez(path, data=PICTURE_TURNS[orientation](read_npz(path, "bev")))
    findings = validate_release(tmp_path, deep=True).findings
    messages = [finding.what for finding in findings if finding.code == "bev-orientation"]

    assert messages
    assert all(f"'{orientation}'" in message for message in messages)


def test_images_out_of_sequence() -> None:
    rng = np.random.default_rng(0)
    scene = rng.uniform(0, 64, (18, 32, 3))
    foreign = rng.uniform(0, 255, (18, 32, 3))
    smooth = {frame: 10.0 * frame + scene for frame in range(1, 9)}
    short_runs = {1: smooth[1], 2: smooth[2], 28: foreign, 29: smooth[3], 51: smooth[1]}
    later_run = {**smooth, 20: foreign, 31: smooth[1], 32: foreign, 33: smooth[3]}

    assert out_of_sequence(smooth) == []
    for frame in smooth:
        assert out_of_sequence({**smooth, frame: foreign}) == [frame]
    assert out_of_sequence({1: smooth[1], 2: foreign}) == []  # two pictures have no sequence
    assert out_of_sequence(short_runs) == []
    assert out_of_sequence(later_run) == [32]


@pytest.mark.parametrize(("index", "is_expected"), [(0, True), (-1, False)])
def test_at_the_impact_another_car_may_fill_the_view(
    da: DeepAccident, tmp_path: Path, index: int, *, is_expected: bool
) -> None:
    scenario = next(scenario for scenario in da.scenario if scenario["collision"])
    agent = next(name for name in scenario["collision"]["agents"] if name)
    scenario_type, name = scenario["token"].split("/")
    kinds = [f"{agent}/{kind}/{name}" for kind in ("calib", "label", "Camera_Front")]
    for folder in (*kinds, "meta"):
        shutil.copytree(da.dataroot / scenario_type / folder, tmp_path / scenario_type / folder)
    images = sorted(tmp_path.glob("*/*/Camera_Front/*/*.jpg"))
    for path in images[1:]:
        shutil.copy(images[0], path)
    noise = np.random.default_rng(0).integers(0, 256, (36, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(images[index], quality=90)

    report = validate_release(tmp_path, deep=True, scenarios=[scenario["token"]])
    assert ("image-out-of-sequence" in collect_codes(report)) is is_expected


def test_json_has_everything_and_the_exit_status_shows_errors(own_release: Path) -> None:
    def run_validate(*options: str, status: int) -> str:
        return invoke_command("validate", own_release, *options, status=status).stdout

    payload = json.loads(run_validate("--json", status=0))
    assert payload["counts"] == {"error": 0, "warning": 0, "note": 0}
    assert payload["velocity"]["best"] == "released"

    label = list_labels(own_release, "ego_vehicle")[0]
    label.write_text(label.read_text()[:-20])
    [finding] = json.loads(run_validate("--json", status=1))["findings"]
    assert set(finding) == {"code", "severity", "scenario", "where", "what", "remedy", "known"}
    assert f"label-unreadable: {finding['where']}: " in run_validate(status=1)
    payload = json.loads(run_validate("--scenario", finding["scenario"], "--json", status=1))
    assert payload["scenarios"] == 1


def test_the_worst_scenario_comes_first(own_release: Path) -> None:
    labels = list_labels(own_release, "other_vehicle")
    warned_folder, broken_folder = sorted({path.parent for path in labels})[:2]
    for path in broken_folder.iterdir():
        path.write_text("")
    second_label = sorted(warned_folder.iterdir())[1]
    rewrite_boxes(second_label, lambda row: [row[0], repr(float(row[1]) + 3), *row[2:]])

    findings = validate_release(own_release).findings
    scenarios = list(dict.fromkeys(finding.scenario for finding in findings))
    assert [str(scenario).split("/")[1] for scenario in scenarios] == [
        broken_folder.name,
        warned_folder.name,
    ]
    severities = [finding.severity for finding in findings]
    assert severities == sorted(severities, key=("error", "warning", "note").index)


@pytest.mark.parametrize(
    ("change", "code", "severity", "line"),
    [
        (
            lambda text: text.replace(b"\n", b"\n" + 100 * b"word" + b"\n", 1) + b"\nanother\n",
            *SKIPPED_LINE_NOTE,
            2,
        ),
        # Arrow drops one mark
        (lambda text: 2 * b"\xef\xbb\xbf" + text, "label-unreadable", "error", 1),
    ],
    ids=["a line of words", "two marks of byte order"],
)
def test_a_label_that_is_read_only_in_part_or_not_at_all(
    small: Path, change, code: str, severity: str, line: int
) -> None:
    path = list_labels(small, "ego_vehicle")[2]
    path.write_bytes(change(path.read_bytes()))
    [finding] = validate_small(small)

    assert (finding.code, finding.severity) == (code, severity)
    assert finding.where == f"{path}:{line}"
    assert len(finding.what) < 200


@pytest.mark.parametrize("actor_id", ["-1", "{row}"])
def test_a_crowd_at_one_place_is_found_in_little_memory(small: Path, actor_id: str) -> None:
    """The pairs of 20,000 boxes would be 200 million."""
    path = list_labels(small, "ego_vehicle")[2]
    lines = path.read_text().splitlines()
    for row in range(40_000, 60_000):
        row_id = actor_id.format(row=row)
        lines.append(f"car 9.0 9.0 -1.0 4.0 2.0 1.5 0.0 0.0 0.0 {row_id} 5 True")
    path.write_text("\n".join(lines))

    tracemalloc.start()
    messages = {finding.code: finding.what for finding in validate_small(small)}
    assert tracemalloc.get_traced_memory()[1] < 100 * 2**20
    tracemalloc.stop()
    crowd = f"up to {len(lines) - 1:,} boxes in a label, more than 500, frame 3"
    assert messages["label-crowded"] == crowd
    assert messages["duplicate-box"].startswith("two boxes are in the same place")


def validate_small(root: Path) -> list[Finding]:
    """Return the findings, except for the four agents that a small release lacks."""
    findings = validate_release(root, workers=1).findings
    return [finding for finding in findings if finding.code != "agent-missing"]


def test_labels_that_are_good_one_by_one_but_not_together_are_a_finding(
    small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    message = "the labels: do not go together; mend them"

    def read_or_refuse(paths: list[Path]) -> object:
        if len(paths) > 1:
            raise LabelError(message)
        return read_labels(paths)

    monkeypatch.setattr(scan, "read_labels", read_or_refuse)
    [finding] = validate_small(small)
    assert finding.code == "label-unreadable"
    assert str(finding) == message
