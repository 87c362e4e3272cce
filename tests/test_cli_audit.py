"""`check splits`, `check scores` and `check reader` as users call them: exit status 1 for findings,
2 for bad input.
"""

import json
from pathlib import Path

import pytest
from verbs import called

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, ResultsError
from deepaccident_devkit.selection.splits import official_split

READER = """
from pathlib import Path

def read(dataroot):
    files = sorted(Path(dataroot).glob("*/*/label/*/*.txt"))
    rows = [line.split() for path in files for line in path.read_text().splitlines()[1:]]
    return [{"ttc": float(row[11]), "x": float(row[1])} for row in rows]

def wrong():
    return []

def leaves(dataroot):
    raise SystemExit(0)

def forgets(dataroot):
    read(dataroot)
"""


@pytest.mark.slow
def test_splits(da: DeepAccident, tmp_path: Path) -> None:
    files = sorted(official_split(da).save(tmp_path))
    sides = [path for path in files if "mini" not in path.name]
    assert len("".join(path.read_text() for path in sides).splitlines()) == len(da.scenario)
    assert called("check", "splits", *sides, status=2).output.startswith(
        "Compared: 0 sides"
    )  # all are of train
    (tmp_path / "other.txt").write_text(
        "type1_subtype1_normal/Town09_type001_subtype0001_scenario00001\n"
    )
    assert called("check", "splits", *sides, tmp_path / "other.txt").output.startswith(
        "Nothing was found."
    )
    (tmp_path / "random.txt").write_text(f"{da.scenario[0]['token']}/ego_vehicle/001\n")
    found = called("check", "splits", *sides, tmp_path / "random.txt", "--json", status=1)
    assert [each["kind"] for each in json.loads(found.stdout)["findings"]] == [
        "recordings",
        "twins",
    ]


@pytest.mark.slow
def test_scores(da_b: DeepAccident, tmp_path: Path) -> None:
    """Of six clips, fewer clusters than an interval needs, nothing can be said."""
    path = tmp_path / "scores.csv"
    lines = [f"{each['token']},{int(each['collision'] is not None)}" for each in da_b.scenario]
    path.write_text("\n".join(["token,score", *lines]))
    told = called("check", "scores", da_b.dataroot, path, status=2).output
    assert "6 scenarios with meta and a score" in told
    assert "the scores 1.0" in " ".join(told.split())
    train = called(
        "check", "scores", da_b.dataroot, path, "--split", "train", "--json", status=2
    ).stdout
    assert json.loads(train)["tables"]["scores"][0][:2] == ["attribute", "AUC"]
    for token in ("a/b", "a/b/ego_vehicle/001"):
        path.write_text(f"{token},0.5")
        with pytest.raises(ResultsError, match=rf"scores\.csv: .*{token}"):
            called("check", "scores", da_b.dataroot, path)


@pytest.mark.slow
def test_a_function(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "audited_reader.py").write_text(READER)
    for target in ("audited_reader:read", tmp_path / "audited_reader.py:read"):
        found = called("check", "reader", target, status=1)
        assert (
            "FOUND misread: */ttc holds column 12 of the labels: the LiDAR points in the box"
            in found.output
        )
    for name, told in (
        ("wrong", "TypeError"),
        ("leaves", "SystemExit"),
    ):  # which exit status 1 or 0 would hide
        with pytest.raises(ConfigError, match=f"audited_reader:{name}: ended with {told}"):
            called("check", "reader", f"audited_reader:{name}")
    nothing = called("check", "reader", "audited_reader:forgets", status=2).output
    assert nothing.startswith("Compared: 0 keys")
    assert (
        "not looked into: NoneType" in nothing,
        any(
            json.loads(
                called("check", "reader", "audited_reader:forgets", "--json", status=2).stdout
            )["compared"].values()
        ),
    ) == (True, False)
    for target in ("audited_reader:no", "no_such_module:read", "nowhere"):
        assert (
            "module:function or file.py:function"
            in called("check", "reader", target, status=2).output
        )


@pytest.mark.slow
def test_a_folder_that_was_written(tmp_path: Path) -> None:
    release, out = tmp_path / "release", tmp_path / "out"
    assert (
        f"written: {release}" in called("check", "reader", release, "--write-release").output,
        DeepAccident(dataroot=release, verbose=False).scenario[0]["num_frames"],
    ) == (True, 2)
    space: dict[str, object] = {}
    exec(READER, space)  # noqa: S102
    out.mkdir()
    (out / "rows.json").write_text(json.dumps(space["read"](release)))  # type: ignore[operator]
    found = json.loads(called("check", "reader", out, "--json", status=1).stdout)
    assert [each["kind"] for each in found["findings"]] == ["misread"]
    assert found["tables"]["keys"][2] == ["rows/*/x", "column 2 of the labels", "200 of 200", ""]
