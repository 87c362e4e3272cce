"""Every misreading that public parsers commit is named, and a right reader is not blamed."""

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


def of_first_lines(make: Callable[[list[float]], Any]) -> Reader:
    """A reader of line 1 of each label."""
    return lambda root: [make(first) for first, _ in labels(root)]


def frames_as_a_speed(root: str) -> Any:
    lines = [
        path.read_text().splitlines()[0].split() for path in sorted(Path(root).glob("*/meta/*.txt"))
    ]
    return {
        "scenes": [{"speed": float(words[-1]), "num_frames": int(words[-1])} for words in lines]
    }


COUNTDOWNS = (
    "ttc",
    "time_to_collision",
    "countdown",
    "timeToCollision",
    "collision_time",
    "eta",
    "seconds_left",
)
OBJECT = "objects/*/"
LINE_1 = ("line 1 of the labels, number 1", "line 1 of the labels, number 2")


def column(number: int) -> str:
    return f"column {number} of the labels"


@pytest.mark.parametrize(
    ("reader", "wrong"),
    [
        pytest.param(
            of_rows(lambda row: dict.fromkeys(COUNTDOWNS, float(row[11])) | {"cls": row[0]}),
            {OBJECT + name: column(12) for name in COUNTDOWNS},
            id="points as a countdown",
        ),
        pytest.param(
            of_first_lines(
                lambda first: {"speed": first[0], "yaw_rate": first[1], "pos_x": first[0]}
            ),
            {"*/speed": LINE_1[0], "*/yaw_rate": LINE_1[1], "*/pos_x": LINE_1[0]},
            id="line 1 as speed, yaw rate and position",
        ),
        pytest.param(
            of_first_lines(lambda first: {"position": first}),
            {f"*/position/*[{place}]": LINE_1[place] for place in (0, 1)},
            id="line 1 as a position in a list",
        ),
        pytest.param(
            of_first_lines(lambda first: {"velocity_xy": first[:2], "vel": {"x": first[0]}}),
            {},
            id="line 1 as the velocity in the world that it is",
        ),
        pytest.param(
            of_rows(
                lambda row: dict(
                    zip(("width", "height", "length"), map(float, row[4:7]), strict=True)
                )
            ),
            {
                OBJECT + name: column(5 + place)
                for place, name in enumerate(("width", "height", "length"))
            },
            id="sizes in another order",
        ),
        pytest.param(
            of_rows(
                lambda row: {"whl": list(map(float, row[4:7])), "lwh": list(map(float, row[4:7]))}
            ),
            {f"{OBJECT}whl/*[{place}]": column(5 + place) for place in range(3)},
            id="sizes in a list",
        ),
        pytest.param(
            of_rows(
                lambda row: dict(zip(("dy", "dx", "size_z"), map(float, row[4:7]), strict=True))
            ),
            {f"{OBJECT}dy": column(5), f"{OBJECT}dx": column(6)},
            id="extents along other axes",
        ),
        pytest.param(
            of_rows(
                lambda row: {
                    "collided": row[12] == "True",
                    "crash": int(row[12] == "True"),
                    "is_hit": row[12],
                }
            ),
            {OBJECT + name: column(13) for name in ("collided", "crash", "is_hit")},
            id="visibility as a collision",
        ),
        pytest.param(
            frames_as_a_speed, {"scenes/*/speed": "line 1 of meta, word 9"}, id="frames as a speed"
        ),
        pytest.param(
            of_rows(
                lambda row: {
                    "velocity": [float(row[8]), -float(row[9])],
                    "raw_velocity": float(row[8]),
                    "vx": row[8],
                    "speed_y": round(float(row[9]), 2),
                }
            ),
            {
                f"{OBJECT}velocity/*[0]": column(9),
                f"{OBJECT}velocity/*[1]": column(10),
                f"{OBJECT}vx": column(9),
                f"{OBJECT}speed_y": column(10),
            },
            id="undecoded velocities",
        ),
    ],
)
def test_a_misreading_is_named_with_its_key_and_column(
    reader: Reader, wrong: dict[str, str]
) -> None:
    report = audit_reader(reader)
    assert misread(report) == wrong
    assert report.exit_status == bool(wrong)


def test_the_bev_array_as_a_picture(tmp_path: Path) -> None:
    def saved(root: str) -> Any:
        for number, array in enumerate(arrays_of_bev(root)[:2]):
            cv2.imwrite(str(tmp_path / f"{number}.jpg"), array)
        return {
            "images": [str(tmp_path / f"{number}.jpg") for number in range(2)],
            "image_height": 1200,
        }

    for read, number in ((saved, 2), (lambda root: {"rgb": arrays_of_bev(root)[0][..., ::-1]}, 1)):
        report = audit_reader(read)
        assert [(finding.kind, finding.number) for finding in report.findings] == [
            ("picture", number)
        ]
    assert (
        audit_reader(
            lambda root: {"bev": arrays_of_bev(root)[0], "image": np.zeros((90, 160, 3), np.uint8)}
        ).findings
        == ()
    )
    for path in tmp_path.glob("*.jpg"):  # smaller pictures, in a folder
        cv2.imwrite(
            str(path), cv2.resize(cv2.imread(str(path)), (300, 300), interpolation=cv2.INTER_AREA)
        )
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
    assert (report.findings, report.exit_status, report.compared["keys by their names"]) == (
        (),
        0,
        5,
    )
    found = holds(report)
    assert [found[f"*/boxes/*/*[{place}]"] for place in range(7)] == [
        f"column {2 + place} of the labels" for place in range(7)
    ]
    assert found["*/agent_velocity/*[1]"] == "line 1 of the labels, number 2"
    assert not [key for key in found if "/velocity" in key or "speed" in key]


def test_the_devkit_itself_is_not_blamed() -> None:
    report = audit_reader(tables)
    assert report.findings == ()
    found = holds(report)
    assert found["annotation/*/velocity_label/*[0]"] == "column 9 of the labels"
    assert found["annotation/*/num_lidar_pts"] == "column 12 of the labels"
    assert found["annotation/*/camera_visible"] == "column 13 of the labels"
    assert found["sample/*/velocity/*[0]"] == "line 1 of the labels, number 1"
    assert not [
        key
        for key in found
        if key.startswith(("annotation/*/velocity/", "track/*/velocity", "calibrated"))
    ]


def test_what_was_written_of_the_release(tmp_path: Path) -> None:
    root, out = write_audit_release(tmp_path / "labels" / "release"), tmp_path / "out"
    assert len(arrays_of_bev(str(root))) == 20
    (out / "deep").mkdir(parents=True)
    (out / "deep" / "boxes.json").write_text(
        json.dumps([{"ttc": row[11], "score": float("nan")} for row in rows(str(root))])
    )
    assert misread(audit_reader(out)) == {"boxes/*/ttc": "column 12 of the labels"}


@pytest.mark.parametrize(
    ("output", "unread"),
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
def test_nothing_that_is_known_is_no_verdict(output: object, unread: str) -> None:
    report = audit_reader(lambda _: output)
    assert (report.findings, report.exit_status, any(report.compared.values())) == ((), 2, False)
    assert "Nothing was found" not in report.to_text()
    assert unread in report.cannot_say[-1]


def test_scaled_numbers_and_names_that_say_nothing_are_no_verdict() -> None:
    report = audit_reader(
        of_rows(lambda row: {"ttc": float(row[11]) / 10, "length": float(row[5]) * 100})
    )
    assert report.exit_status == 2
    assert "objects/*/ttc" in report.cannot_say[1]
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
        made = {
            name: [float(row["xyz".index(axis) + 1]) for axis in axes]
            for name, axes in names.items()
        }
        return {name: values if values[1:] else values[0] for name, values in made.items()}

    report = audit_reader(of_rows(read))
    assert list(misread(report)) == wrong
    assert report.exit_status == bool(wrong)


def test_rows_in_place_of_columns() -> None:
    for order, wrong in (([1, 2, 3], 0), ([2, 1, 3], 2)):
        columns = audit_reader(
            lambda root, order=order: {"pos": np.array(rows(root))[:, order].astype(float)}
        )
        assert len(columns.findings) == wrong
        turned = audit_reader(
            lambda root, order=order: {"pos": np.array(rows(root))[:, order].astype(float).T}
        )
        assert (len(turned.findings), turned.compared["keys by their names"]) == (wrong, 3)


def test_what_has_no_end_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deepaccident_devkit.plugins.audit.reader.MAX_VALUES", 5000)
    report = audit_reader(lambda root: cycle([{"ttc": float(row[11])} for row in rows(root)]))
    assert (list(misread(report)), report.cannot_say) == (
        ["*/ttc"],
        ("not looked into: values after the first 5,000.",),
    )


def test_files_of_other_formats_are_named_and_not_opened(tmp_path: Path) -> None:
    (tmp_path / "evil.pkl").write_bytes(b"cos\nsystem\n(S'touch evil'\ntR.")
    (tmp_path / "boxes.npz").write_bytes(b"PK")
    report = audit_reader(tmp_path)
    assert (report.exit_status, report.cannot_say[1]) == (
        2,
        "not looked into: boxes.npz, evil.pkl.",
    )
    assert audit_reader(tmp_path / "nowhere").exit_status == 2
