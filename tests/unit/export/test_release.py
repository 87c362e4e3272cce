"""A part of a release is a release itself, with the same bytes except for resized images."""

import json
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support import stopped_index_process
from support.command_calls import invoke_command
from support.expected_errors import assert_raises
from support.zipped_releases import zip_agents, zip_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    DatarootError,
    ExportError,
    NotAvailableError,
)
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.release import ReleasePart
from deepaccident_devkit.export.released_infos import ReleasedInfos
from deepaccident_devkit.release import read_image, read_split_file
from deepaccident_devkit.release.images import decode_image, encode_jpeg, write_image
from deepaccident_devkit.testing import SmallRelease, write_small_release
from deepaccident_devkit.validation import validate_release

pytestmark = pytest.mark.slow

IMAGE_SIZE = (64, 36)
SIZE = (32, 18)
AGENTS = ("ego_vehicle", "infrastructure")
CHANNELS = ("Camera_Front", "lidar01")
FORM = ReleasePart(split="train", agents=AGENTS, channels=CHANNELS)
SMALL = SmallRelease(image_size=IMAGE_SIZE, agents=("ego_vehicle", "other_vehicle", AGENTS[1]))


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("whole") / "release"
    write_small_release(root, SMALL)
    return root


@pytest.fixture(scope="module")
def dataset(root: Path) -> DeepAccident:
    return DeepAccident("v1", root, verbose=False)


def export(dataset: DeepAccident, out: Path, form: ReleasePart = FORM, **options: Any) -> Exported:
    return export_release(dataset, out, form, workers=1, **options)


def read_contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files of a part by their path, but not of those of its index."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and ".deepaccident" not in path.parts
    }


def is_additional(path: str) -> bool:
    return path in ("README.md", "release.manifest.json") or path.startswith(".deepaccident")


def open_zipped(root: Path, folder: Path) -> DeepAccident:
    names = [*SMALL.agents, "meta"]
    return DeepAccident("v1", zip_agents(root, folder, names), verbose=False)


class TestUnchanged:
    @pytest.mark.parametrize("layout", ["A", "B", "zips"])
    def test_files_have_the_same_paths_and_bytes(
        self, root: Path, tmp_path: Path, layout: str
    ) -> None:
        if layout == "B":
            root = tmp_path / "release"
            write_small_release(root, replace(SMALL, layout="B"))
        if layout == "zips":
            dataset = open_zipped(root, tmp_path / "zips")
        else:
            dataset = DeepAccident("v1", root, verbose=False)
        done = export(dataset, tmp_path / "part")

        contents = read_contents(tmp_path / "part")
        expected = {}
        for path, content in read_contents(root).items():
            _, *names = path.removeprefix("train/").split("/")
            is_train = path.startswith(("type1_subtype1", "train/"))
            is_chosen = names[:1] == ["meta"] or (
                names[:1] and names[0] in AGENTS and names[1] in ("calib", "label", *CHANNELS)
            )
            if is_train and is_chosen:
                expected[path] = content
        assert len(expected) == 2 * (2 * 3 * 4 + 1)
        added = {path for path in contents if path not in expected}
        assert {path for path in added if not is_additional(path)} == {
            path.relative_to(root).as_posix()
            for path in root.rglob("*.txt")
            if "_" not in path.parent.name
            and path.stem.removesuffix("_mini") in ("train", "val", "test")
        }
        assert {path: contents[path] for path in expected} == expected
        assert done.tally.linked == {"copy" if layout == "zips" else "hard": len(expected)}

    def test_the_additional_files_are_not_taken_for_scenarios(
        self, dataset: DeepAccident, tmp_path: Path
    ) -> None:
        export(dataset, tmp_path / "part")

        part = DeepAccident("v1", tmp_path / "part", verbose=False)
        expected = [
            scenario["token"] for scenario in dataset.scenario if scenario["split"] == "train"
        ]
        assert [scenario["token"] for scenario in part.scenario] == expected
        assert {sample["agent"] for sample in part.sample} == set(AGENTS)
        token = part.sample[-1]["token"]
        np.testing.assert_array_equal(part.boxes(token).center, dataset.boxes(token).center)

    def test_split_files_name_what_is_there(
        self, root: Path, dataset: DeepAccident, tmp_path: Path
    ) -> None:
        where = ("designed_accident=true",)
        export(dataset, tmp_path / "part", replace(FORM, split=None, where=where))

        for path in root.glob("*.txt"):
            tokens = [token for token in read_split_file(path) if "_accident/" in token]
            assert read_split_file(tmp_path / "part" / path.name) == tokens
        assert (tmp_path / "part" / "test.txt").read_bytes() == b""
        assert read_split_file(tmp_path / "part" / "train_mini.txt")

    def test_a_part_of_a_part(self, dataset: DeepAccident, tmp_path: Path) -> None:
        export(dataset, tmp_path / "part")
        part = DeepAccident("v1", tmp_path / "part", verbose=False)
        form = replace(FORM, agents=("ego_vehicle",))
        export(part, tmp_path / "from part", form)
        export(dataset, tmp_path / "from whole", form)

        contents = read_contents(tmp_path / "from part")
        for path, content in read_contents(tmp_path / "from whole").items():
            assert contents[path] == content or is_additional(path)
        assert_raises((lambda: export(part, tmp_path / "part" / "x", form), ExportError, "lies in"))

    def test_released_infos_are_those_of_the_whole(self, da: DeepAccident, tmp_path: Path) -> None:
        """The released code wants all agents and finds meta by the length of the path."""
        export(da, tmp_path / "part", ReleasePart(where=("designed_accident=true",)))
        part = DeepAccident("v1", tmp_path / "part", verbose=False)
        infos = {}
        for name, source in (("part", part), ("whole", da)):
            out = tmp_path / f"infos of {name}"
            form = ReleasedInfos(where=("designed_accident=true",))
            export_release(source, out, form, workers=1)
            infos[name] = {path.name: path.read_bytes() for path in out.glob("*.pkl")}

        assert infos["part"] == infos["whole"]
        assert any(pickle.loads(content)["infos"] for content in infos["part"].values())


@pytest.fixture(scope="module")
def resized(dataset: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """A part with smaller images, opened."""
    out = tmp_path_factory.mktemp("resized") / "part"
    form = replace(FORM, channels=(*CHANNELS, "BEV_instance_camera"), size=SIZE)
    export(dataset, out, form)
    return DeepAccident("v1", out, verbose=False)


class TestResized:
    def test_a_point_is_projected_to_the_scaled_pixel(
        self, dataset: DeepAccident, resized: DeepAccident
    ) -> None:
        points = np.array([[1.0, 0.5, 7.0], [-3.0, 1.0, 20.0], [0.0, 0.0, 5.0]])
        for channel in ("Camera_Front", "Camera_Back"):
            token = f"{resized.sample[-1]['token']}/{channel}"
            camera = resized.camera(token)
            assert (camera.width, camera.height) == SIZE
            pixels, _ = camera.project(points)
            full_pixels, _ = dataset.camera(token).project(points)
            np.testing.assert_allclose(pixels, full_pixels / 2, atol=1e-9)

    def test_images_are_resized_by_area(self, dataset: DeepAccident, resized: DeepAccident) -> None:
        token = f"{resized.sample[-1]['token']}/Camera_Front"
        image = resized.load_image(token)
        expected = cv2.resize(dataset.load_image(token), SIZE, interpolation=cv2.INTER_AREA)
        path = Path("image.jpg")
        np.testing.assert_array_equal(image, decode_image(path, encode_jpeg(path, expected)))

    def test_only_images_and_calib_change(self, root: Path, resized: DeepAccident) -> None:
        original = read_contents(root)
        for path, content in read_contents(Path(str(resized.dataroot))).items():
            kind = Path(path).parts[-3] if path.count("/") > 2 else "meta"
            if kind in ("Camera_Front", "calib"):
                assert content != original[path]
            elif "/" in path:
                assert content == original[path]

    def test_validate_finds_nothing(self, resized: DeepAccident) -> None:
        assert validate_release(resized.dataroot, deep=True, workers=1).is_good

    def test_the_stored_size_changes_nothing(self, dataset: DeepAccident, tmp_path: Path) -> None:
        done = export(dataset, tmp_path / "part", replace(FORM, size=IMAGE_SIZE))
        assert done.tally.linked == {"hard": 2 * (2 * 3 * 4 + 1)}


class TestValidate:
    @pytest.fixture
    def part(self, dataset: DeepAccident, tmp_path: Path) -> Path:
        export(dataset, tmp_path / "part")
        return tmp_path / "part"

    def test_what_was_left_out_is_no_finding(self, part: Path) -> None:
        report = validate_release(part, workers=1)
        assert list(report.findings) == []
        assert report.files.whole == report.files.scenarios == 2
        assert report.files.total.missing == 0
        assert "2 scenarios in this part of a release, 2 complete" in report.to_text()
        assert "in the full release" not in report.to_text()
        output = invoke_command("validate", part, "--files").output
        assert "2 scenarios in this part of a release" in output

    def test_a_promised_file_that_is_missing_is_a_finding(self, part: Path) -> None:
        path = next(part.glob("*_accident/ego_vehicle/Camera_Front/*/*_002.jpg"))
        path.unlink()
        findings = validate_release(part, workers=1).findings
        (finding,) = [finding for finding in findings if finding.code == "part-incomplete"]
        assert finding.scenario == f"{path.parts[-5]}/{path.parts[-2]}"
        assert "1 Camera_Front file" in finding.what

    def test_a_missing_agent_and_a_missing_scenario_are_findings(self, part: Path) -> None:
        for folder in part.glob("*_accident/infrastructure"):
            folder.rename(part.parent / "infrastructure")
        (normal,) = part.glob("*_normal")
        normal.rename(part.parent / "normal")
        findings = validate_release(part, workers=1).findings
        texts = [finding.what for finding in findings if finding.code == "part-incomplete"]
        assert len(texts) == 2
        assert any(normal.name in text for text in texts)
        assert any("3 calib files, 3 label files" in text for text in texts)

    def test_gaps_of_the_release_are_no_gaps_of_its_part(
        self, da_partial: DeepAccident, tmp_path: Path
    ) -> None:
        export(da_partial, tmp_path / "part", ReleasePart())
        report = validate_release(tmp_path / "part", workers=1)
        assert "part-incomplete" not in {finding.code for finding in report.findings}
        assert report.files.total.missing == 0

    def test_an_interrupted_export_is_a_finding(self, part: Path) -> None:
        path = part / "release.manifest.json"
        manifest = json.loads(path.read_text())
        path.write_text(json.dumps({**manifest, "release": None, "contents": {}}))
        findings = validate_release(part, workers=1).findings
        assert any("interrupted" in finding.what for finding in findings)

        path.write_text("{}[")
        assert_raises(
            (lambda: validate_release(part, workers=1), DatarootError, ("release.manifest.json",))
        )


class TestRuns:
    def test_a_killed_export_goes_on(
        self, root: Path, dataset: DeepAccident, tmp_path: Path
    ) -> None:
        form = replace(FORM, size=SIZE)
        export(dataset, tmp_path / "whole", form)
        words = ["export", "release", str(root), "--out", str(tmp_path / "part"), "--workers", "1"]
        words += ["--split", "train", "--agents", ",".join(AGENTS), "--size", "32x18"]
        words += ["--channels", ",".join(CHANNELS)]
        with subprocess.Popen(
            [sys.executable, stopped_index_process.__file__, "deepaccident_devkit.export.release"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        ) as server:
            requests: Any = server.stdin
            answers: Any = server.stdout
            statuses = []
            for step in (3, 60, 90, 130, 30):
                request = {"words": words, "step": step, "after": step % 20 == 10}
                requests.write(json.dumps(request) + "\n")
                requests.flush()
                statuses.append(json.loads(answers.readline())["status"])
            requests.close()

        assert statuses[:2] == [-9, -9]
        done = export(dataset, tmp_path / "part", form)
        assert done.kept > 0
        assert read_contents(tmp_path / "part") == read_contents(tmp_path / "whole")

    def test_the_dry_run_says_scenarios_files_and_bytes(self, root: Path, tmp_path: Path) -> None:
        words = ("export", "release", root, "--out", tmp_path / "part", "--agents", "ego_vehicle")
        output = invoke_command(*words, "--channels", "Camera_Front", "--dry-run").output
        paths = [*root.glob("*/ego_vehicle/*/*/*")]
        paths = [path for path in paths if path.parts[-3] in ("calib", "label", "Camera_Front")]
        paths += root.glob("*/meta/*")
        size = sum(path.stat().st_size for path in paths)
        assert f"selected: 4 scenarios, {len(paths)} files, {size / 1e3:.1f} kB" in output
        assert not (tmp_path / "part").exists()

    def test_a_dry_run_of_zips_counts_copies(self, root: Path, tmp_path: Path) -> None:
        archive = zip_release(root, tmp_path / "zips" / "all.zip")
        dataset = DeepAccident("v1", archive, verbose=False)
        expected = export(dataset, tmp_path / "part", dry_run=True).tally.bytes
        export(dataset, tmp_path / "part")
        size = sum(len(content) for content in read_contents(tmp_path / "part").values())
        assert size == pytest.approx(expected, rel=0.25)

    def test_other_settings_and_another_release_are_refused(self, tmp_path: Path) -> None:
        root = tmp_path / "release"
        write_small_release(root, SMALL)
        own = DeepAccident("v1", root, verbose=False)
        out = tmp_path / "part"
        export(own, out)
        assert_raises(
            (
                lambda: export(own, out, replace(FORM, size=SIZE)),
                ConfigError,
                ("size: None", "[32, 18]"),
            )
        )

        label = next(root.glob("*_accident/ego_vehicle/label/*/*_001.txt"))
        lines = label.read_text().splitlines()
        label.unlink()  # the part has a link to it
        label.write_text("\n".join(lines[:-1]) + "\n")
        changed = DeepAccident("v1", root, verbose=False, index_dir=tmp_path / "index")
        assert_raises((lambda: export(changed, out), ExportError, ("has changed",)))
        (tmp_path / "other").mkdir()
        (tmp_path / "other" / "notes.txt").write_text("mine")
        assert_raises(
            (lambda: export(own, tmp_path / "other"), ExportError, ("notes.txt", "new folder"))
        )

    def test_bad_input_is_refused_before_anything_is_written(
        self, dataset: DeepAccident, da_b: DeepAccident, tmp_path: Path
    ) -> None:
        out = tmp_path / "part"
        inside = Path(str(dataset.dataroot)) / "part"
        link = tmp_path / "link"
        link.symlink_to(dataset.dataroot)
        images = ReleasePart(channels=("Camera_Front",))
        for dry_run in (True, False):
            run = partial(export, dry_run=dry_run)
            small = replace(FORM, size=(30, 20))
            large = replace(FORM, size=(128, 72))
            resized = ReleasePart(size=SIZE)
            assert_raises(
                (partial(run, dataset, inside), ExportError, "choose a folder outside"),
                (partial(run, dataset, link / "x"), ExportError, "lies in the release"),
                (partial(run, dataset, out, small), ConfigError, ("64x36", "30x20")),
                (partial(run, dataset, out, large), ConfigError, ("64x36", "128x72")),
                (partial(run, da_b, out, resized), NotAvailableError, "no files of Camera_Front"),
                (partial(run, da_b, out, images), NotAvailableError, "no files of Camera_Front"),
            )
        assert not out.exists()
        assert not inside.exists()
        assert_raises(
            (lambda: ReleasePart(channels=("label",)), ChoiceError, "channels: expected one of"),
            (lambda: ReleasePart(agents=("me",)), ChoiceError, "agents: expected one of"),
            (lambda: ReleasePart(size=(0, 9)), ConfigError, "size: expected width and height"),
            (lambda: ReleasePart(size=(9,)), ConfigError, "size"),  # type: ignore[arg-type]
        )

    def test_an_image_of_another_shape_fails_with_its_path(self, tmp_path: Path) -> None:
        root = tmp_path / "release"
        write_small_release(root, replace(SMALL, splits=("val",)))
        path = next(root.glob("*/ego_vehicle/Camera_Front/*/*_002.jpg"))
        write_image(path, read_image(path)[:, :36])
        dataset = DeepAccident("v1", root, verbose=False)
        with pytest.raises(Exception, match=path.name):
            export(dataset, tmp_path / "part", ReleasePart(size=SIZE))
