"""Every misreading that public parsers commit is named, and a right reader is not blamed."""

import json
import math
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from itertools import count, cycle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.audit import AuditReport, audit_reader, write_audit_release
from deepaccident_devkit.release import world_from_label_velocity
from deepaccident_devkit.taxonomy import BEV_CAMERA

pytestmark = pytest.mark.slow

Row = list[str]
Reader = Callable[[str], Any]


def labels(root: str) -> Iterator[tuple[list[float], list[Row]]]:
    """Line 1 and the words of the other lines of each label."""
    for path in sorted(Path(root).glob("*/*/label/*/*.txt")):
        first, *lines = path.read_text().splitlines()
        yield [float(word) for word in first.split()], [line.split() for line in lines]


def rows(root: str) -> list[Row]:
    return [row for _, lines in labels(root) for row in lines]


def of_rows(make: Callable[[Row], Any]) -> Reader:
    return lambda root: {"objects": [make(row) for row in rows(root)]}


def arrays_of_bev(root: str) -> list[np.ndarray]:
    return [np.load(path)["data"] for path in sorted(Path(root).glob(f"*/*/{BEV_CAMERA}/*/*.npz"))]


def misread(report: AuditReport) -> dict[str, str]:
    """Key → what it holds, of keys that are misread."""
    return {str(row[0]): str(row[1]) for row in report.tables["keys"] if row[3] == "misread"}


def holds(report: AuditReport) -> dict[str, str]:
    return {str(row[0]): str(row[1]) for row in report.tables["keys"][1:]}


def test_points_as_a_countdown() -> None:
    names = ("ttc", "time_to_collision", "countdown", "timeToCollision", "collision_time")
    report = audit_reader(of_rows(lambda row: dict.fromkeys(names, float(row[11])) | {"cls": row[0]}))
    assert misread(report) == {f"objects/*/{name}": "column 12 of the labels" for name in names}
    assert report.findings[0].what == (
        "objects/*/ttc holds column 12 of the labels: the LiDAR points in the box; you read it as `ttc`."
    )


def test_line_1_as_speed_and_yaw_rate_or_a_position() -> None:
    names = [("speed", "yaw_rate"), ("velocity", "angularVelocity"), ("pos_x", "pos_y")]
    columns = ["line 1 of the labels, number 1", "line 1 of the labels, number 2"]
    wrong = {name: place for pair in names for place, name in enumerate(pair)}
    report = audit_reader(
        lambda root: [{"ego": {name: first[place] for name, place in wrong.items()}} for first, _ in labels(root)]
    )
    assert misread(report) == {f"*/ego/{name}": columns[place] for name, place in wrong.items()}
    assert "own velocity along the world's x" in report.findings[0].what


def test_line_1_as_a_position_in_a_list() -> None:
    report = audit_reader(
        lambda root: {f"{number:03d}": {"position": first} for number, (first, _) in enumerate(labels(root))}
    )
    assert list(misread(report)) == ["*/position/*[0]", "*/position/*[1]"]


def test_sizes_in_another_order() -> None:
    wrong = {"width": "column 5", "height": "column 6", "length": "column 7"}
    report = audit_reader(of_rows(lambda row: dict(zip(wrong, map(float, row[4:7]), strict=True))))
    assert misread(report) == {f"objects/*/{name}": f"{column} of the labels" for name, column in wrong.items()}
    report = audit_reader(of_rows(lambda row: {"whl": list(map(float, row[4:7])), "lwh": list(map(float, row[4:7]))}))
    assert list(misread(report)) == [f"objects/*/whl/*[{place}]" for place in range(3)]
    assert "you read it as `w`" in report.findings[0].what
    assert holds(report)["objects/*/lwh/*[2]"] == "column 7 of the labels"


@pytest.mark.parametrize("own", [True, False])
def test_visibility_as_a_collision(own: bool) -> None:
    flags = {"collided": lambda word: word == "True", "crash": lambda word: int(word == "True"), "is_hit": str}
    report = audit_reader(
        lambda root: [
            {name: flag(row[12]) for name, flag in flags.items()} for row in rows(root) if own or row[10] != "-100"
        ]
    )
    assert misread(report) == {f"*/{name}": "column 13 of the labels" for name in flags}


def test_the_number_of_frames_as_a_speed() -> None:
    def read(root: str) -> Any:
        lines = [path.read_text().splitlines()[0].split() for path in sorted(Path(root).glob("*/meta/*.txt"))]
        return {"scenes": [{"speed": float(words[-1]), "num_frames": int(words[-1])} for words in lines]}

    report = audit_reader(read)
    assert misread(report) == {"scenes/*/speed": "line 1 of meta, word 9"}
    assert holds(report)["scenes/*/num_frames"] == "line 1 of meta, word 9"


def test_undecoded_velocities() -> None:
    names = ("velocity", "velocity_ego", "vel")
    report = audit_reader(
        of_rows(
            lambda row: {
                **{name: [float(row[8]), -float(row[9])] for name in names},
                "raw_velocity": float(row[8]),
                "vx": row[8],
                "speed_y": round(float(row[9]), 2),
            }
        )
    )
    columns = [f"column {number} of the labels" for number in (9, 10)]
    both = {f"objects/*/{name}/*[{place}]": columns[place] for name in names for place in (0, 1)}
    assert misread(report) == both | {"objects/*/vx": columns[0], "objects/*/speed_y": columns[1]}
    assert holds(report)["objects/*/raw_velocity"] == columns[0]
    assert "of no frame until it is decoded" in report.findings[0].what
    assert "v_world = Rz(−yaw) · (vx, vy)" in report.findings[0].remedy


def test_the_bev_array_as_a_picture(tmp_path: Path) -> None:
    def saved(root: str) -> Any:
        for number, array in enumerate(arrays_of_bev(root)[:2]):
            cv2.imwrite(str(tmp_path / f"{number}.jpg"), array)
        return {"images": [str(tmp_path / f"{number}.jpg") for number in range(2)], "image_height": 1200}

    for read, number in ((saved, 2), (lambda root: {"rgb": arrays_of_bev(root)[0][..., ::-1]}, 1)):
        report = audit_reader(read)
        assert [(finding.kind, finding.number) for finding in report.findings] == [("picture", number)]
    assert (
        audit_reader(lambda root: {"bev": arrays_of_bev(root)[0], "image": np.zeros((90, 160, 3), np.uint8)}).findings
        == ()
    )
    for path in tmp_path.glob("*.jpg"):  # smaller pictures, in a folder
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (300, 300), interpolation=cv2.INTER_AREA))
    (tmp_path / "torn.png").write_bytes(b"\x89PNG")
    assert audit_reader(tmp_path).findings[0].examples == ("0.jpg", "1.jpg")


def decoded(root: str) -> Any:
    """A right reader of its own."""
    for first, lines in labels(root):
        numbers = np.array([[float(word) for word in row[1:12]] for row in lines])
        velocity = world_from_label_velocity(numbers[:, 7:9], numbers[:, 6])
        yield {
            "agent_velocity": first,
            "speed": float(np.hypot(*first)),
            "boxes": numbers[:, :7].astype(np.float32),
            "velocity": np.round(velocity, 3),
            "track_id": [row[10] for row in lines],
            "numPoints": [int(row[11]) for row in lines],
            "visible": [row[12] == "True" for row in lines],
            "names": [row[0] for row in lines],
        }


def tables(root: str) -> Any:
    dataset = DeepAccident(dataroot=root, verbose=False)
    return {name: getattr(dataset, name)[:] for name in dataset.table_names}


def test_a_right_reader_is_not_blamed() -> None:
    report = audit_reader(lambda root: [*decoded(root)])
    assert (report.findings, report.exit_status, report.compared["keys by their names"]) == ((), 0, 5)
    assert report.to_text().startswith("Nothing was found.\n\nCompared: 5 keys by their names, 0 pictures.")
    found = holds(report)
    assert [found[f"*/boxes/*/*[{place}]"] for place in range(7)] == [
        f"column {2 + place} of the labels" for place in range(7)
    ]
    assert found["*/agent_velocity/*[1]"] == "line 1 of the labels, number 2"
    assert {name: found[f"*/{name}/*"] for name in ("track_id", "numPoints", "visible")} == {
        "track_id": "column 11 of the labels",
        "numPoints": "column 12 of the labels",
        "visible": "column 13 of the labels",
    }
    assert not [key for key in found if "/velocity" in key or "speed" in key]


def test_the_devkit_itself_is_not_blamed() -> None:
    report = audit_reader(tables)
    assert report.findings == ()
    found = holds(report)
    assert found["annotation/*/velocity_label/*[0]"] == "column 9 of the labels"
    assert found["annotation/*/num_lidar_pts"] == "column 12 of the labels"
    assert found["annotation/*/camera_visible"] == "column 13 of the labels"
    assert found["sample/*/velocity/*[0]"] == "line 1 of the labels, number 1"
    assert not [key for key in found if key.startswith(("annotation/*/velocity/", "track/*/velocity", "calibrated"))]


def test_each_column_has_numbers_of_its_own(tmp_path: Path) -> None:
    root = str(write_audit_release(tmp_path / "release"))
    own = [first for first, _ in labels(root)]
    others = [row for row in rows(root) if row[10] != "-100"]
    columns = [*map(list, zip(*own, strict=True)), *([float(row[place]) for row in others] for place in range(1, 12))]
    near = [{round(abs(number) + step, 2) for number in column for step in (-0.01, 0, 0.01)} for column in columns]
    assert sum(map(len, near)) == len(set.union(*near))
    for place in (1, 2, 8, 9, 11):
        assert len({row[place] for row in others}) == len(others)
    with pytest.raises(ConfigError, match="release"):
        write_audit_release(tmp_path / "release")


def test_what_was_written_of_the_release(tmp_path: Path) -> None:
    root, out = write_audit_release(tmp_path / "labels" / "release"), tmp_path / "out"
    assert len(arrays_of_bev(str(root))) == 20
    (out / "deep").mkdir(parents=True)
    (out / "deep" / "boxes.json").write_text(
        json.dumps([{"ttc": row[11], "score": float("nan")} for row in rows(str(root))])
    )
    assert misread(audit_reader(out)) == {"boxes/*/ttc": "column 12 of the labels"}
    (out / "boxes.json").write_text("{")
    with pytest.raises(ConfigError, match=r"boxes\.json: is no JSON"):
        audit_reader(out)


@pytest.mark.parametrize(
    ("output", "unread"),
    [
        (None, "NoneType"),
        ([], ""),
        ("text", "str"),
        (b"\x80\xff", "bytes"),
        (print, "function"),
        ({"ttc": [None, math.inf, "x"], "image": None, "photo": "none.jpg", "deep": [[[]]], 1: {2: 3}}, ""),
        ([{"when": datetime.now(timezone.utc)}], "datetime"),
        ({"cloud": np.zeros((9000, 4))}, "ndarray"),
    ],
)
def test_nothing_that_is_known_is_no_verdict(output: object, unread: str) -> None:
    report = audit_reader(lambda _: output)
    assert (report.findings, report.exit_status, any(report.compared.values())) == ((), 2, False)
    assert "Nothing was found" not in report.to_text()
    assert "Cannot say: no key holds numbers" in report.to_text()
    assert unread in report.cannot_say[-1]


def test_scaled_numbers_and_names_that_say_nothing_are_no_verdict() -> None:
    report = audit_reader(of_rows(lambda row: {"ttc": float(row[11]) / 10, "length": float(row[5]) * 100}))
    assert report.exit_status == 2
    assert "objects/*/ttc" in report.cannot_say[1]
    report = audit_reader(lambda root: [[float(row[11]), float(row[4])] for row in rows(root)])
    assert (report.exit_status, len(holds(report))) == (2, 2)
    partly = audit_reader(of_rows(lambda row: {"ttc": float(row[11]) / 10, "x": float(row[1])}))
    assert (partly.exit_status, partly.compared["keys by their names"]) == (0, 1)
    assert "objects/*/ttc" in partly.cannot_say[0]


@pytest.mark.parametrize(
    ("names", "wrong"),
    [
        ({"x": "y", "y": "x"}, ["objects/*/x", "objects/*/y"]),
        ({"x": "z", "z": "x"}, ["objects/*/x", "objects/*/z"]),
        ({"z": "y"}, ["objects/*/z"]),
        ({"center": "yxz"}, ["objects/*/center/*[0]", "objects/*/center/*[1]"]),
        ({"position_xy": "yx"}, ["objects/*/position_xy/*[0]", "objects/*/position_xy/*[1]"]),
        ({"pos_x": "x", "posY": "z"}, ["objects/*/posY"]),
        ({"center": "xyz", "center_yx": "yx", "cz": "z", "pos_y": "y"}, []),
    ],
)
def test_axes_that_are_exchanged(names: dict[str, str], wrong: list[str]) -> None:
    def read(row: Row) -> dict[str, Any]:
        made = {name: [float(row["xyz".index(axis) + 1]) for axis in axes] for name, axes in names.items()}
        return {name: values if values[1:] else values[0] for name, values in made.items()}

    report = audit_reader(of_rows(read))
    assert list(misread(report)) == wrong
    assert all("nuScenes" in finding.remedy for finding in report.findings)
    assert report.exit_status == (1 if wrong else 0)


def test_rows_in_place_of_columns() -> None:
    for order, wrong in (([1, 2, 3], 0), ([2, 1, 3], 2)):
        columns = audit_reader(lambda root, order=order: {"pos": np.array(rows(root))[:, order].astype(float)})
        assert len(columns.findings) == wrong
        turned = audit_reader(lambda root, order=order: {"pos": np.array(rows(root))[:, order].astype(float).T})
        assert (len(turned.findings), turned.compared["keys by their names"]) == (wrong, 3)


def test_extents_along_other_axes() -> None:
    report = audit_reader(of_rows(lambda row: dict(zip(("dy", "dx", "size_z"), map(float, row[4:7]), strict=True))))
    assert list(misread(report)) == ["objects/*/dy", "objects/*/dx"]


def test_what_has_no_end_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deepaccident_devkit.plugins.audit.reader.MOST_VALUES", 5000)
    report = audit_reader(lambda root: cycle([{"ttc": float(row[11])} for row in rows(root)]))
    assert (list(misread(report)), report.cannot_say) == (
        ["*/ttc"],
        ("not looked into: values after the first 5,000.",),
    )
    large = np.zeros((1000, 1000, 3), np.uint8)
    report = audit_reader(lambda _: ({"image": large} for _ in count()))
    assert (report.findings, report.exit_status, "values after" in report.cannot_say[1]) == ((), 2, True)


def test_right_pictures_do_not_speak_for_numbers() -> None:
    picture = {"image": np.zeros((90, 160, 3), np.uint8)}
    report = audit_reader(lambda _: picture)
    assert (report.exit_status, report.compared["pictures"]) == (0, 1)
    assert audit_reader(lambda root: [picture, {"ttc": [float(row[11]) / 10 for row in rows(root)]}]).exit_status == 2
    assert audit_reader(lambda _: [picture, object()]).exit_status == 2


def test_files_of_other_formats_are_named_and_not_opened(tmp_path: Path) -> None:
    (tmp_path / "evil.pkl").write_bytes(b"cos\nsystem\n(S'touch evil'\ntR.")
    (tmp_path / "boxes.npz").write_bytes(b"PK")
    report = audit_reader(tmp_path)
    assert (report.exit_status, report.cannot_say[1]) == (2, "not looked into: boxes.npz, evil.pkl.")
    assert audit_reader(tmp_path / "nowhere").exit_status == 2


def test_errors_of_a_reader_are_its_own() -> None:
    for reader in (lambda _: 1 / 0, lambda _: (1 / number for number in (1, 0))):
        with pytest.raises(ZeroDivisionError):
            audit_reader(reader)


@pytest.mark.parametrize(
    ("name", "place", "column"),
    [
        ("eta", lambda row: float(row[11]), "column 12 of the labels"),
        ("seconds_left", lambda row: int(row[11]), "column 12 of the labels"),
        ("size_whl", lambda row: [float(word) for word in row[4:7]], "column 5 of the labels"),
        ("boxWHL", lambda row: [float(word) for word in row[4:7]], "column 6 of the labels"),
        ("v", lambda row: float(row[8]), "column 9 of the labels"),
        ("velocity_xy", lambda row: [float(row[8]), float(row[9])], "column 9 of the labels"),
    ],
    ids=["eta", "left", "size_whl", "WHL", "v", "velocity_xy"],
)
def test_names_that_tell_what_a_reader_believes(name: str, place: Any, column: str) -> None:
    found = misread(audit_reader(lambda root: [{name: place(row)} for row in rows(root) if row[10] != "-100"]))
    assert column in found.values(), found


def test_velocities_of_line_1_are_in_the_world_whatever_they_are_called() -> None:
    def read(root: str) -> Any:
        lines = [path.read_text().splitlines()[0].split() for path in sorted(Path(root).glob("*/*/label/*/*.txt"))]
        return [{"velocity_xy": [float(words[0]), float(words[1])], "vel": {"x": float(words[0])}} for words in lines]

    assert misread(audit_reader(read)) == {}
