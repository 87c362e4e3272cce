"""`check splits`, `check scores` and `check reader` as users call them.

The exit status is 1 for findings and 2 for bad input.
"""

import json
from pathlib import Path

import pytest
from support.command_calls import invoke_command

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
def test_check_splits(da: DeepAccident, tmp_path: Path) -> None:
    paths = [path for path in official_split(da).save(tmp_path) if "mini" not in path.name]
    command = ("check", "splits", *sorted(paths))
    lines = [line for path in paths for line in path.read_text().splitlines()]
    assert len(lines) == len(da.scenario)
    output = invoke_command(*command, status=2).output
    assert output.startswith("Compared: 0 sides")  # all scenarios are of train

    other_path = tmp_path / "other.txt"
    other_path.write_text("type1_subtype1_normal/Town09_type001_subtype0001_scenario00001\n")
    assert invoke_command(*command, other_path).output.startswith("No problems found.")

    random_path = tmp_path / "random.txt"
    random_path.write_text(f"{da.scenario[0]['token']}/ego_vehicle/001\n")
    result = json.loads(invoke_command(*command, random_path, "--json", status=1).stdout)
    assert [finding["kind"] for finding in result["findings"]] == ["recordings", "twins"]


@pytest.mark.slow
def test_check_scores(da_b: DeepAccident, tmp_path: Path) -> None:
    """Six clips are fewer clusters than an interval needs: nothing can be concluded."""
    path = tmp_path / "scores.csv"
    lines = ["token,score"]
    for scenario in da_b.scenario:
        lines.append(f"{scenario['token']},{int(scenario['collision'] is not None)}")
    path.write_text("\n".join(lines))
    command = ("check", "scores", da_b.dataroot, path)

    output = invoke_command(*command, status=2).output
    assert "6 scenarios with meta and a score" in output
    assert "the scores 1.0" in " ".join(output.split())
    result = json.loads(invoke_command(*command, "--split", "train", "--json", status=2).stdout)
    assert result["tables"]["scores"][0][:2] == ["attribute", "AUC"]

    for token in ("a/b", "a/b/ego_vehicle/001"):
        path.write_text(f"{token},0.5")
        with pytest.raises(ResultsError, match=rf"scores\.csv: .*{token}"):
            invoke_command(*command)


@pytest.mark.slow
def test_check_reader_of_a_function(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "audited_reader.py").write_text(READER)

    finding = (
        "FOUND misread: */ttc contains column 12 of the labels: the number of LiDAR points in "
        "the box"
    )
    for target in ("audited_reader:read", tmp_path / "audited_reader.py:read"):
        assert finding in invoke_command("check", "reader", target, status=1).output

    # exit status 1 or 0 would hide these errors
    for name, error in (("wrong", "TypeError"), ("leaves", "SystemExit")):
        with pytest.raises(ConfigError, match=f"audited_reader:{name}: failed with {error}"):
            invoke_command("check", "reader", f"audited_reader:{name}")

    command = ("check", "reader", "audited_reader:forgets")
    output = invoke_command(*command, status=2).output
    assert output.startswith("Compared: 0 keys")
    assert "not examined: NoneType" in output
    result = json.loads(invoke_command(*command, "--json", status=2).stdout)
    assert not any(result["compared"].values())

    for target in ("audited_reader:no", "no_such_module:read", "nowhere"):
        output = invoke_command("check", "reader", target, status=2).output
        assert "module:function or file.py:function" in output


@pytest.mark.slow
def test_check_reader_of_a_written_folder(tmp_path: Path) -> None:
    release, out = tmp_path / "release", tmp_path / "out"
    output = invoke_command("check", "reader", release, "--write-release").output
    assert f"wrote {release}" in output
    assert DeepAccident(dataroot=release, verbose=False).scenario[0]["num_frames"] == 2

    namespace: dict[str, object] = {}
    exec(READER, namespace)  # noqa: S102
    rows = namespace["read"](release)  # type: ignore[operator]
    out.mkdir()
    (out / "rows.json").write_text(json.dumps(rows))
    result = json.loads(invoke_command("check", "reader", out, "--json", status=1).stdout)
    assert [finding["kind"] for finding in result["findings"]] == ["misread"]
    assert result["tables"]["keys"][2] == ["rows/*/x", "column 2 of the labels", "200 of 200", ""]
