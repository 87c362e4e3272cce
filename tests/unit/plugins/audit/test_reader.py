"""Every misreading that public parsers commit is named, and a correct reader is not blamed."""

import json
import math
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from itertools import cycle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.audit import AuditReport, audit_reader, write_audit_release
from deepaccident_devkit.release import world_from_label_velocity
from deepaccident_devkit.taxonomy import BEV_CAMERA

pytestmark = pytest.mark.slow

Row = list[str]
Reader = Callable[[str], Any]


def read_labels(root: str) -> Iterator[tuple[list[float], list[Row]]]:
    """Yield the numbers of the first line and the words of the other lines of each label."""
    for path in sorted(Path(root).glob("*/*/label/*/*.txt")):
        first_line, *lines = path.read_text().splitlines()
        velocity = [float(word) for word in first_line.split()]
        yield velocity, [line.split() for line in lines]


def read_rows(root: str) -> list[Row]:
    return [row for _, lines in read_labels(root) for row in lines]


def reader_of_rows(make: Callable[[Row], Any]) -> Reader:
    return lambda root: {"objects": [make(row) for row in read_rows(root)]}


def load_bev_arrays(root: str) -> list[np.ndarray]:
    paths = sorted(Path(root).glob(f"*/*/{BEV_CAMERA}/*/*.npz"))
    return [np.load(path)["data"] for path in paths]


def misread_keys(report: AuditReport) -> dict[str, str]:
    """Return what each misread key really holds."""
    return {
        str(key): str(contents)
        for key, contents, _, verdict in report.tables["keys"]
        if verdict == "misread"
    }


def contents_by_key(report: AuditReport) -> dict[str, str]:
    _, *rows = report.tables["keys"]
    return {str(row[0]): str(row[1]) for row in rows}


def reader_of_first_lines(make: Callable[[list[float]], Any]) -> Reader:
    return lambda root: [make(velocity) for velocity, _ in read_labels(root)]


def read_frames_as_speed(root: str) -> Any:
    scenes = []
    for path in sorted(Path(root).glob("*/meta/*.txt")):
        last_word = path.read_text().splitlines()[0].split()[-1]
        scenes.append({"speed": float(last_word), "num_frames": int(last_word)})
    return {"scenes": scenes}


COUNTDOWNS = (
    "ttc",
    "time_to_collision",
    "countdown",
    "timeToCollision",
    "collision_time",
    "eta",
    "seconds_left",
)
OBJECT_KEY = "objects/*/"
FIRST_LINE_NAMES = ("line 1 of the labels, number 1", "line 1 of the labels, number 2")


def column_name(number: int) -> str:
    return f"column {number} of the labels"


@pytest.mark.parametrize(
    ("reader", "misreadings"),
    [
        pytest.param(
            reader_of_rows(lambda row: dict.fromkeys(COUNTDOWNS, float(row[11])) | {"cls": row[0]}),
            {OBJECT_KEY + name: column_name(12) for name in COUNTDOWNS},
            id="points as a countdown",
        ),
        pytest.param(
            reader_of_first_lines(
                lambda velocity: {
                    "speed": velocity[0],
                    "yaw_rate": velocity[1],
                    "pos_x": velocity[0],
                }
            ),
            {
                "*/speed": FIRST_LINE_NAMES[0],
                "*/yaw_rate": FIRST_LINE_NAMES[1],
                "*/pos_x": FIRST_LINE_NAMES[0],
            },
            id="line 1 as speed, yaw rate and position",
        ),
        pytest.param(
            reader_of_first_lines(lambda velocity: {"position": velocity}),
            {f"*/position/*[{index}]": FIRST_LINE_NAMES[index] for index in (0, 1)},
            id="line 1 as a position in a list",
        ),
        pytest.param(
            reader_of_first_lines(
                lambda velocity: {"velocity_xy": velocity[:2], "vel": {"x": velocity[0]}}
            ),
            {},
            id="line 1 as the velocity in the world that it is",
        ),
        pytest.param(
            reader_of_rows(
                lambda row: dict(
                    zip(("width", "height", "length"), map(float, row[4:7]), strict=True)
                )
            ),
            {
                f"{OBJECT_KEY}width": column_name(5),
                f"{OBJECT_KEY}height": column_name(6),
                f"{OBJECT_KEY}length": column_name(7),
            },
            id="sizes in another order",
        ),
        pytest.param(
            reader_of_rows(
                lambda row: {"whl": list(map(float, row[4:7])), "lwh": list(map(float, row[4:7]))}
            ),
            {f"{OBJECT_KEY}whl/*[{index}]": column_name(5 + index) for index in range(3)},
            id="sizes in a list",
        ),
        pytest.param(
            reader_of_rows(
                lambda row: dict(zip(("dy", "dx", "size_z"), map(float, row[4:7]), strict=True))
            ),
            {f"{OBJECT_KEY}dy": column_name(5), f"{OBJECT_KEY}dx": column_name(6)},
            id="extents along other axes",
        ),
        pytest.param(
            reader_of_rows(
                lambda row: {
                    "collided": row[12] == "True",
                    "crash": int(row[12] == "True"),
                    "is_hit": row[12],
                }
            ),
            {OBJECT_KEY + name: column_name(13) for name in ("collided", "crash", "is_hit")},
            id="visibility as a collision",
        ),
        pytest.param(
            read_frames_as_speed,
            {"scenes/*/speed": "line 1 of meta, word 9"},
            id="frames as a speed",
        ),
        pytest.param(
            reader_of_rows(
                lambda row: {
                    "velocity": [float(row[8]), -float(row[9])],
                    "raw_velocity": float(row[8]),
                    "vx": row[8],
                    "speed_y": round(float(row[9]), 2),
                }
            ),
            {
                f"{OBJECT_KEY}velocity/*[0]": column_name(9),
                f"{OBJECT_KEY}velocity/*[1]": column_name(10),
                f"{OBJECT_KEY}vx": column_name(9),
                f"{OBJECT_KEY}speed_y": column_name(10),
            },
            id="undecoded velocities",
        ),
    ],
)
def test_a_misreading_is_named_with_its_key_and_column(
    reader: Reader, misreadings: dict[str, str]
) -> None:
    report = audit_reader(reader)
    assert misread_keys(report) == misreadings
    assert report.exit_status == bool(misreadings)


def test_a_bev_array_as_a_picture_is_reported(tmp_path: Path) -> None:
    def save_pictures(root: str) -> Any:
        paths = [str(tmp_path / f"{number}.jpg") for number in range(2)]
        for path, array in zip(paths, load_bev_arrays(root), strict=False):
            cv2.imwrite(path, array)
        return {"images": paths, "image_height": 1200}

    def return_picture(root: str) -> Any:
        return {"rgb": load_bev_arrays(root)[0][..., ::-1]}

    def return_array_and_picture(root: str) -> Any:
        return {
            "bev": load_bev_arrays(root)[0],
            "image": np.zeros((90, 160, 3), np.uint8),
        }

    for reader, count in ((save_pictures, 2), (return_picture, 1)):
        findings = audit_reader(reader).findings
        assert [(finding.kind, finding.number) for finding in findings] == [("picture", count)]
    assert audit_reader(return_array_and_picture).findings == ()

    for path in tmp_path.glob("*.jpg"):  # smaller pictures, in a folder
        picture = cv2.imread(str(path))
        cv2.imwrite(str(path), cv2.resize(picture, (300, 300), interpolation=cv2.INTER_AREA))
    (tmp_path / "torn.png").write_bytes(b"\x89PNG")
    assert audit_reader(tmp_path).findings[0].examples == ("0.jpg", "1.jpg")


def read_correctly(root: str) -> Any:
    """Read labels correctly, without the devkit's reader."""
    for agent_velocity, lines in read_labels(root):
        numbers = np.array([[float(word) for word in row[1:12]] for row in lines])
        velocity = world_from_label_velocity(numbers[:, 7:9], numbers[:, 6])
        yield {
            "agent_velocity": agent_velocity,
            "speed": float(np.hypot(*agent_velocity)),
            "boxes": numbers[:, :7].astype(np.float32),
            "velocity": np.round(velocity, 3),
            "track_id": [row[10] for row in lines],
            "numPoints": [int(row[11]) for row in lines],
            "visible": [row[12] == "True" for row in lines],
            "names": [row[0] for row in lines],
        }


def read_devkit_tables(root: str) -> Any:
    dataset = DeepAccident(dataroot=root, verbose=False)
    return {name: getattr(dataset, name)[:] for name in dataset.table_names}


def test_a_right_reader_is_not_blamed() -> None:
    report = audit_reader(lambda root: [*read_correctly(root)])
    assert (report.findings, report.exit_status) == ((), 0)
    assert report.compared["keys by their names"] == 5

    contents = contents_by_key(report)
    for index in range(7):
        assert contents[f"*/boxes/*/*[{index}]"] == column_name(index + 2)
    assert contents["*/agent_velocity/*[1]"] == "line 1 of the labels, number 2"
    assert not [key for key in contents if "/velocity" in key or "speed" in key]


def test_the_devkit_itself_is_not_blamed() -> None:
    report = audit_reader(read_devkit_tables)
    assert report.findings == ()
    contents = contents_by_key(report)
    assert contents["annotation/*/velocity_label/*[0]"] == "column 9 of the labels"
    assert contents["annotation/*/num_lidar_pts"] == "column 12 of the labels"
    assert contents["annotation/*/camera_visible"] == "column 13 of the labels"
    assert contents["sample/*/velocity/*[0]"] == "line 1 of the labels, number 1"
    unmatched = ("annotation/*/velocity/", "track/*/velocity", "calibrated")
    assert not [key for key in contents if key.startswith(unmatched)]


def test_files_written_from_the_release_are_audited(tmp_path: Path) -> None:
    root = write_audit_release(tmp_path / "labels" / "release")
    assert len(load_bev_arrays(str(root))) == 20
    boxes = [{"ttc": row[11], "score": float("nan")} for row in read_rows(str(root))]
    (tmp_path / "out" / "deep").mkdir(parents=True)
    (tmp_path / "out" / "deep" / "boxes.json").write_text(json.dumps(boxes))
    report = audit_reader(tmp_path / "out")
    assert misread_keys(report) == {"boxes/*/ttc": "column 12 of the labels"}


@pytest.mark.parametrize(
    ("output", "unread_type"),
    [
        (None, "NoneType"),
        ([], ""),
        ("text", "str"),
        (b"\x80\xff", "bytes"),
        (print, "function"),
        (
            {
                "ttc": [None, math.inf, "x"],
                "image": None,
                "photo": "none.jpg",
                "deep": [[[]]],
                1: {2: 3},
            },
            "",
        ),
        ([{"when": datetime.now(timezone.utc)}], "datetime"),
        ({"cloud": np.zeros((9000, 4))}, "ndarray"),
    ],
)
def test_output_without_known_values_gives_no_verdict(output: object, unread_type: str) -> None:
    report = audit_reader(lambda _: output)
    assert (report.findings, report.exit_status, any(report.compared.values())) == ((), 2, False)
    assert "No problems found" not in report.to_text()
    assert unread_type in report.cannot_say[-1]


def test_scaled_numbers_and_meaningless_names_give_no_verdict() -> None:
    def scale(row: Row) -> dict[str, float]:
        return {
            "ttc": float(row[11]) / 10,
            "length": float(row[5]) * 100,
        }

    def scale_partly(row: Row) -> dict[str, float]:
        return {
            "ttc": float(row[11]) / 10,
            "x": float(row[1]),
        }

    report = audit_reader(reader_of_rows(scale))
    assert report.exit_status == 2
    assert "objects/*/ttc" in report.cannot_say[1]
    report = audit_reader(reader_of_rows(scale_partly))
    assert (report.exit_status, report.compared["keys by their names"]) == (0, 1)
    assert "objects/*/ttc" in report.cannot_say[0]


@pytest.mark.parametrize(
    ("axes_by_name", "misread"),
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
def test_exchanged_axes_are_misread(axes_by_name: dict[str, str], misread: list[str]) -> None:
    def exchange_axes(row: Row) -> dict[str, Any]:
        record: dict[str, Any] = {}
        for name, axes in axes_by_name.items():
            values = [float(row["xyz".index(axis) + 1]) for axis in axes]
            record[name] = values if len(values) > 1 else values[0]
        return record

    report = audit_reader(reader_of_rows(exchange_axes))
    assert list(misread_keys(report)) == misread
    assert report.exit_status == bool(misread)


def read_columns(root: str, columns: list[int]) -> np.ndarray:
    words = np.array(read_rows(root))
    return words[:, columns].astype(float)


def test_rows_instead_of_columns_are_recognised() -> None:
    for order, count in (([1, 2, 3], 0), ([2, 1, 3], 2)):
        columns = audit_reader(lambda root, order=order: {"pos": read_columns(root, order)})
        transposed = audit_reader(lambda root, order=order: {"pos": read_columns(root, order).T})
        assert len(columns.findings) == count
        assert len(transposed.findings) == count
        assert transposed.compared["keys by their names"] == 3


def test_endless_output_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deepaccident_devkit.plugins.audit.reader.MAX_VALUES", 5000)
    report = audit_reader(lambda root: cycle([{"ttc": float(row[11])} for row in read_rows(root)]))
    assert list(misread_keys(report)) == ["*/ttc"]
    assert report.cannot_say == ("not examined: values after the first 5,000.",)


def test_files_of_other_formats_are_named_and_not_opened(tmp_path: Path) -> None:
    (tmp_path / "evil.pkl").write_bytes(b"cos\nsystem\n(S'touch evil'\ntR.")
    (tmp_path / "boxes.npz").write_bytes(b"PK")
    report = audit_reader(tmp_path)
    assert report.exit_status == 2
    assert report.cannot_say[1] == "not examined: boxes.npz, evil.pkl."
    assert audit_reader(tmp_path / "nowhere").exit_status == 2
