import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from tiny import META, NAME, TYPE, label_lines, old_pickle, write_tiny_release

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import (
    CalibError,
    LabelError,
    MetaError,
    MissingFileError,
    ReleaseError,
    SensorFileError,
)
from deepaccident_devkit.release import explain_file, read_calib, read_label, world_from_label_velocity, write_lidar
from deepaccident_devkit.release.labels import read_label_to_fault
from deepaccident_devkit.release.npz import write_npz


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_release(tmp_path_factory.mktemp("explained"), frames=2)


def tiny_file(root: Path, kind: str, agent: str = "ego_vehicle") -> Path:
    ending = {"label": "txt", "calib": "pkl"}[kind]
    return root / TYPE / agent / kind / NAME / f"{NAME}_001.{ending}"


def one_of(root: Path, pattern: str) -> Path:
    return min(root.glob(pattern))


def rows_of(text: str, first_word: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines() if line.split()[:1] == [first_word]]


def copied(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def test_a_label_is_told_row_by_row_in_both_frames(tiny: Path) -> None:
    path = tiny_file(tiny, "label")
    explanation = explain_file(path)
    assert (explanation.kind, explanation.fault) == ("label", None)
    lines = explanation.text.splitlines()
    assert lines[0] == str(path)
    assert "3 boxes: 1 car, 1 van, 1 pedestrian." in lines[1]
    assert "speed_x 0.000, speed_y 10.000 m/s" in explanation.text
    assert "vx 0.000, vy -10.000 m/s (right-handed); speed 10.00 m/s = 36.0 km/h" in explanation.text
    # the van drives at 2 m/s along world x; the label has that turned by its yaw of −90°
    said, made = rows_of(explanation.text, "1")
    assert " ".join(said[1:]) == "van 2.00 -15.20 -1.14 5.00 2.00 2.20 -1.571 0.00 -2.00 1300 12 yes"
    assert made[1:] == ["van", "15.20", "1.571", "90.0", "2.00", "0.00", "7.2", "actor", "1300"]


def test_special_ids_are_named(tiny: Path, tmp_path: Path) -> None:
    text = explain_file(tiny_file(tiny, "label")).text
    assert [rows_of(text, row)[1][8:] for row in ("0", "2")] == [["the", "agent", "itself"], ["not", "trackable"]]
    parked = label_lines("ego_vehicle", 1)[2].replace(" 1300 ", " 20001 ")
    told = explain_file(copied(tmp_path / "label.txt", f"0 0\n{parked}\n".encode())).text
    assert rows_of(told, "0")[1][8:] == ["static", "20001"]


def test_every_column_of_a_label_has_a_line_in_the_legend(tiny: Path) -> None:
    text = explain_file(tiny_file(tiny, "label")).text
    heading = next(line for line in text.splitlines() if line.startswith("row "))
    legend = text[text.rindex("row     counted") :]
    assert [name for name in heading.split() if not re.search(rf"\b{name}\b", legend)] == []


def test_long_labels_are_cut(release_root: Path) -> None:
    path = one_of(release_root, "*accident/ego_vehicle/label/*/*_001.txt")
    count = len(read_label(path))
    assert count > 3
    text = explain_file(path, rows=2).text
    assert text.count(f"… {count - 2} more") == 2
    assert not rows_of(text, "2")
    everything = explain_file(path, rows=None).text
    assert "…" not in everything
    assert len(rows_of(everything, str(count - 1))) == 2


def test_the_numbers_are_the_readers(release_root: Path) -> None:
    path = one_of(release_root, "*accident/infrastructure/label/*/*_002.txt")
    labels = read_label(path)
    world = world_from_label_velocity(labels.velocity, labels.yaw)
    made = [rows_of(explain_file(path, rows=None).text, str(row))[1] for row in range(len(labels))]
    assert [float(row[2]) for row in made] == pytest.approx(labels.center[:, 1], abs=0.006)
    assert [float(row[3]) for row in made] == pytest.approx(labels.yaw, abs=0.0006)
    assert [float(row[5]) for row in made] == pytest.approx(world[:, 0], abs=0.006)
    assert [float(row[6]) for row in made] == pytest.approx(world[:, 1], abs=0.006)


def test_a_label_without_boxes_has_no_table(tmp_path: Path) -> None:
    explanation = explain_file(copied(tmp_path / "empty.txt", b"1.5 2\n"))
    assert explanation.kind == "label"
    assert "0 boxes." in explanation.text
    assert "row" not in explanation.text


def test_a_broken_label_is_told_up_to_its_fault(tmp_path: Path) -> None:
    first, own, van, _ = label_lines("ego_vehicle", 1)
    path = copied(tmp_path / "label.txt", "\n".join([first, own, "", van, "car 1 2 3", van]).encode())
    explanation = explain_file(path)
    assert "2 boxes: 1 car, 1 van, before the line that cannot be read." in explanation.text
    assert isinstance(explanation.fault, LabelError)
    assert str(explanation.fault).startswith(f"{path}:5: expected 13 fields, found 4: 'car 1 2 3'")


def test_reading_to_the_fault_gives_what_stands_before_it(tmp_path: Path) -> None:
    lines = label_lines("ego_vehicle", 1)
    good = copied(tmp_path / "good.txt", "\n".join(lines).encode())
    bad = copied(tmp_path / "bad.txt", "\n".join([*lines, "boat " + lines[1]]).encode())
    for raw in (False, True):
        (labels, fault), expected = read_label_to_fault(bad, raw=raw), read_label(good, raw=raw)
        np.testing.assert_array_equal(labels.center, expected.center)
        np.testing.assert_array_equal(labels.velocity, expected.velocity)
        assert labels.raw is raw
        assert "found more than 13" in str(fault)
        assert read_label_to_fault(good, raw=raw)[1] is None


@pytest.mark.parametrize("content", [b"", b"abc def\n", b"1 2 3\n", b"\0\0\0\0"])
def test_a_label_without_a_first_line_is_an_error(tmp_path: Path, content: bytes) -> None:
    folder = tmp_path / "label" / NAME
    folder.mkdir(parents=True)
    with pytest.raises(LabelError, match=r"_001\.txt:1: "):
        explain_file(copied(folder / f"{NAME}_001.txt", content))


def test_a_meta_file_is_told_token_by_token(tiny: Path) -> None:
    path = tiny / TYPE / "meta" / f"{NAME}.txt"
    explanation = explain_file(path)
    assert explanation.kind == "meta"
    told = " ".join(explanation.text.split())
    for words in (
        "It ended with a collision of a car and a car",
        "1 HardRainNoon weather and time weather: HardRain; time of day: Noon",
        "1 1223 first id actor id of ego_vehicle",
        "1 14 simulated frames 4 recorded ones and 10 of warm-up",
        "2 other second of those who collided other_vehicle",
        "3 1237 actor id of other_vehicle_behind",
        "4 four-way junction road type",
        "7 straight direction of other",
    ):
        assert words in told
    for word in META.replace(":", " ").split():
        assert word in told or word in ("colliding", "agents", "road_type") or "_" in word


def test_no_collision_an_outsider_and_unknown_lines_are_told(tmp_path: Path) -> None:
    calm = explain_file(
        copied(tmp_path / "calm.txt", b"ClearNoon -1 -1 -1 -1 -1 -1 -1 110\n colliding agents: ego other")
    )
    assert "It ended without a collision." in calm.text
    assert calm.text.count("none: there was no collision") == 7
    assert "first of those who were to collide" in calm.text
    odd = META.replace("1212 car 6790", "77 car 6790").replace(": ego other", ": ego none") + " moon: full\n road_type:"
    told = " ".join(explain_file(copied(tmp_path / "odd.txt", odd.encode())).text.split())
    assert "77 second id actor id of a road user that records nothing" in told
    assert "none second of those who collided a road user that records nothing, or nobody" in told
    assert "full moon a line that the devkit does not know" in told
    assert "– road type unsaid" in told


def test_of_a_key_that_stands_twice_any_line_is_told(tmp_path: Path) -> None:
    first, *lines = META.split("\n")
    doubled = "\n".join(
        [first, " agents id: 7", " colliding agents: nobody here at all", " colliding agents: x y", *lines]
    )
    told = explain_file(copied(tmp_path / "meta.txt", doubled.encode())).text
    assert "nobody here at all" in told


def test_a_broken_meta_file_is_the_readers_error(tmp_path: Path) -> None:
    path = copied(tmp_path / "meta.txt", META.replace("1223 1236 1212 1237", "1 2 3").encode())
    with pytest.raises(MetaError, match=r"meta\.txt:3: expected four agents' ids"):
        explain_file(path)


def test_a_calib_file_is_told_matrix_by_matrix(tiny: Path) -> None:
    explanation = explain_file(tiny_file(tiny, "calib"))
    assert (explanation.kind, explanation.fault) == ("calib", None)
    table = {line.split()[0]: line.split()[1:] for line in explanation.text.splitlines() if line.strip()}
    assert table["ego_to_world"][:7] == ["world_from_ego", "5.000", "1.000", "0.500", "0.00", "0.00", "90.00"]
    assert table["lidar_to_Camera_FrontLeft"][0] == "Camera_FrontLeft_from_lidar"
    assert table["lidar_to_Camera_FrontLeft"][6] == "55.00"
    front_left = ["1.147", "-1.638", "-0.300", "-55.0", "1142.52", "70.0", "800.0", "450.0", "1600", "×", "900"]
    assert table["Camera_FrontLeft"] == front_left
    assert table["Camera_Back"][3:6] == ["180.0", "560.17", "110.0"]
    assert "All of them are rigid" in explanation.text
    assert "world_from_ego with the agent at (5.000, -1.000, 0.500) m, heading -90.00°" in explanation.text


def test_a_calib_file_that_is_not_rigid_is_told_and_is_a_fault(tiny: Path, tmp_path: Path) -> None:
    raw = read_calib(tiny_file(tiny, "calib"), raw=True)
    raw["ego_to_world"] = raw["ego_to_world"] * 1.1
    raw["lidar_to_Camera_Back"] = np.full((4, 4), np.nan)
    raw["intrinsic_Camera_Front"] = np.diag([1, 2, 3])
    raw["extra"] = np.zeros(2)
    explanation = explain_file(copied(tmp_path / "odd", old_pickle(raw)))
    assert "Not rigid: ego_to_world: its last row is" in explanation.text
    assert "Not rigid: lidar_to_Camera_Back: holds NaN or infinity" in explanation.text
    assert "Not of this form: intrinsic_Camera_Front: [[1, 0, 0], [0, 2, 0], [0, 0, 3]]" in explanation.text
    assert "Not known to the devkit: extra" in explanation.text
    assert isinstance(explanation.fault, CalibError)
    assert "ego_to_world: its last row is" in str(explanation.fault)


def test_many_unknown_keys_of_a_calib_file_are_cut_short(tiny: Path, tmp_path: Path) -> None:
    raw = read_calib(tiny_file(tiny, "calib"), raw=True) | {f"key {number}": np.zeros(2) for number in range(100)}
    text = explain_file(copied(tmp_path / "odd", old_pickle(raw))).text
    (line,) = [line for line in text.splitlines() if line.startswith("Not known to the devkit: key 0, key 1, ")]
    assert len(line) < 400


class Shout:
    """A pickle that would make a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return (Path.touch, (self.path,))


def test_nothing_of_a_pickle_is_run(tmp_path: Path) -> None:
    with pytest.raises(CalibError, match=r"hostile\.pkl: not a readable calibration \(the pickle asks for"):
        explain_file(copied(tmp_path / "hostile.pkl", old_pickle(Shout(tmp_path / "ran"))))
    assert not (tmp_path / "ran").exists()


def test_points_and_the_bev_camera_are_told(release_root: Path, tmp_path: Path) -> None:
    write_lidar(tmp_path / "cloud.npz", [[1.0, 2.0, 3.0], [-4.0, 0.0, np.nan]], [0.25, 0.5])
    table = {line.split()[0]: line.split() for line in explain_file(tmp_path / "cloud.npz").text.splitlines() if line}
    assert table["x"][-3:] == ["-4.000", "1.000", "0"]
    assert table["y"][-3:] == ["-2.000", "0.000", "0"]  # the file's y is to the right
    assert table["z"][-3:] == ["3.000", "3.000", "1"]
    write_lidar(tmp_path / "none.npz", np.zeros((0, 3)), [])
    assert "0 points" in explain_file(tmp_path / "none.npz").text
    explanation = explain_file(one_of(release_root, "*accident/ego_vehicle/BEV_instance_camera/*/*_001.npz"))
    assert explanation.kind == "sensor"
    assert rows_of(explanation.text, "7")[0][1] == "road"
    pixels = [
        int(row[-2].replace(",", ""))
        for tag in range(30)
        for row in rows_of(explanation.text, str(tag))[-1:]
        if row[-1].endswith("%")
    ]
    assert sum(pixels) == 1200 * 1200


def test_other_arrays_are_an_error(tmp_path: Path) -> None:
    write_npz(tmp_path / "odd.npz", np.zeros((3, 5)))
    with pytest.raises(SensorFileError, match=r"odd\.npz: an array of shape \(3, 5\) of float64 is none"):
        explain_file(tmp_path / "odd.npz")


def test_what_kind_a_file_is_does_not_hang_on_its_place(tiny: Path, tmp_path: Path) -> None:
    sources = {"label": tiny_file(tiny, "label"), "calib": tiny_file(tiny, "calib")}
    sources["meta"] = tiny / TYPE / "meta" / f"{NAME}.txt"
    for kind, source in sources.items():
        assert explain_file(copied(tmp_path / "renamed", source.read_bytes())).kind == kind
    rows = "\n".join(label_lines("ego_vehicle", 1)[1:])
    with pytest.raises(LabelError, match=r"headless\.txt:1: expected '<speed_x> <speed_y>', found 13 fields"):
        explain_file(copied(tmp_path / "headless.txt", rows.encode()))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("train.txt", f"{TYPE} {NAME}\n".encode(), r"train\.txt: is no file that can be explained; give a label"),
        ("nothing", b"", "nothing: is no file that can be explained"),
        ("picture.jpg", b"\xff\xd8\xff\xe0", "picture.jpg: is an image, which needs no words; open it"),
    ],
)
def test_files_of_other_kinds_are_an_error(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    with pytest.raises(ReleaseError, match=message):
        explain_file(copied(tmp_path / name, content))


def test_no_file_and_a_folder_are_errors(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"gone\.txt: no such file"):
        explain_file(tmp_path / "gone.txt")
    with pytest.raises(ReleaseError, match="not a regular file"):
        explain_file(tmp_path)


def test_the_verb_prints_it(tiny: Path, tmp_path: Path) -> None:
    path = tiny_file(tiny, "label")
    runner = CliRunner()
    assert runner.invoke(deepaccident, ["explain", str(path)]).output == explain_file(path).text + "\n"
    assert "… 2 more" in runner.invoke(deepaccident, ["explain", str(path), "--rows", "1"]).output
    assert "…" not in runner.invoke(deepaccident, ["explain", str(path), "--rows", "0"]).output
    broken = copied(tmp_path / "broken.txt", path.read_bytes() + b"car\ncar 1\n")
    result = runner.invoke(deepaccident, ["explain", str(broken)])
    assert isinstance(result.exception, LabelError)
    assert "3 boxes" in result.output
    assert "FILE" in runner.invoke(deepaccident, ["explain", "--help"]).output


@pytest.mark.parametrize("place", [0, 2])
def test_a_long_word_of_meta_is_shortened(tmp_path: Path, place: int) -> None:
    words = ["ClearNoon", *["-1"] * 7, "110"]
    words[place] = "x" * 20_000
    path = copied(tmp_path / "meta.txt", f"{' '.join(words)}\n {'key' * 9999}: {'x' * 9999}".encode())
    assert len(explain_file(path).text) < 6000
