"""A senseless call is refused before anything is written, and the message gives the reason."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import DeepAccidentError

BASELINE = "predict constant_velocity release --out out"
EVALUATE = "evaluate {} release --results results"
LABELS = "labels RELEASE --split train --out out"
RENDER = "render {} RELEASE --out a.png"
USELESS_OPTIONS = [
    (EVALUATE.format("motion") + " --overwrite", "--overwrite has no effect without --out"),
    (
        EVALUATE.format("motion") + " --include-results",
        "--include-results has no effect without --out",
    ),
    (
        EVALUATE.format("warning") + " --threshold-by quiet",
        "--threshold-by has no effect without --threshold-from",
    ),
    (
        EVALUATE.format("warning") + " --threshold-from runs/train --switch threshold=0.5",
        "--threshold-from and --switch threshold=… both set the threshold; give only one",
    ),
    (
        EVALUATE.format("warning") + " --protocol field --resamples 100",
        "--resamples has no effect with --protocol field, which has no confidence intervals",
    ),
    (
        EVALUATE.format("warning") + " --protocol field --prevented",
        (
            "--prevented needs scores of whole recordings, and --protocol field has none; "
            "use --protocol clean"
        ),
    ),
    (
        EVALUATE.format("detection") + " --samples all --horizon 3",
        "--horizon has no effect with --samples all",
    ),
    (
        EVALUATE.format("forecasting") + " --horizon 3",
        "--horizon has no effect with --samples all, as the protocol sets",
    ),
    ("check results results --split val", "--split has no effect without --dataroot"),
    ("check results results --on-error raise", "--on-error has no effect without --dataroot"),
    (BASELINE + " --latency 0.2", "--latency has no effect with --agents single"),
    (BASELINE + " --budget 1000", "--budget has no effect with --agents single"),
    (
        "predict tiny release --out out --agents single --budget 1000",
        "--budget has no effect with --agents single",
    ),
    (
        BASELINE + " --agents all --budget 1000 --seed 3",
        "--seed has no effect without --pose-noise or --packet-loss",
    ),
    (
        "predict constant_velocity release --out out --agents all --seed 3",
        "--seed has no effect without --pose-noise",
    ),
    (
        "predict constant_velocity release --out out --samples all --scope all",
        "--scope has no effect with --samples all",
    ),
    (
        "render bev release --out a.png --pose-noise 0.3",
        "--pose-noise has no effect without --agents",
    ),
    (
        "render bev release --out a.png --agents all --seed 3",
        "--seed has no effect without --pose-noise",
    ),
    (
        "export mcap release --out a.mcap --channels Camera_Front --points 3",
        "--points has no effect without the cha",
    ),
    (
        EVALUATE.format("motion") + " --protocol clean",
        (
            "'clean' is a label protocol; choose the labels with the switch "
            "labels='clean' (--switch labels=clean)"
        ),
    ),
    (EVALUATE.format("accident") + " --protocol fiery", "'fiery' is a label protocol"),
    (
        "labels release --split train --out out --preset clean",
        "'clean' is a protocol of labels: give protocol='clean'",
    ),
    ("validate release --json --all", "--all has no effect with --json"),
    ("validate release --files --deep", "--deep has no effect with --files, which opens no file"),
    ("study v2x out --device cpu", "--device has no effect with a recipe that trains no model"),
    ("check reader out --write-release --json", "--json has no effect with --write-release"),
    (
        "split release --seed 3 --out mine.txt",
        "--seed has no effect with --where or a split file",
    ),
    ("split release --overwrite", "--overwrite has no effect without --out"),
    ("info release --out out", "--out has no effect without --statistics"),
    (
        "synth out --design mine.yaml --unplanned 0.5",
        "--unplanned has no effect with a scenario file or --view",
    ),
    (
        "predict tiny release --out out --horizon 3",
        "--horizon has no effect with a trained model",
    ),
    (BASELINE + " --device cpu", "--device has no effect with a baseline"),
    (
        "results RELEASE/train.txt release --out out --method me",
        "--method has no effect without --truth",
    ),
    (
        "results RELEASE/train.txt release --truth RELEASE/train.txt --out out",
        "give DATAROOT for detections on a nuScenes",
    ),
    (
        "safety describe release --out .",
        "--out: . is a folder; give a file, such as ./stories.jsonl",
    ),
    ("safety twins release --replays 3", "--replays has no effect with twins"),
    ("safety report release --json", "--json has no effect with report"),
]
"""Words with an option that has no effect → message."""
WRONG_CALLS = [
    ("info", "Missing argument"),
    ("dance", "No such command 'dance'"),
    ("--all", "--all"),
    ("rendr out", "No such command 'rendr'. Did you mean 'render'?"),
    ("compare out", "'compare'. Did you mean 'deepaccident evaluate compare'?"),
    (
        "accident out",
        "Did you mean 'deepaccident evaluate accident' or 'deepaccident render accident'?",
    ),
    ("info RELEASE --where town=Twon03", "found 'Twon03'; did you mean 'Town03'?"),
    ("info RELEASE --statistics --out ''", "expected a folder to write to, found an empty path"),
    ("info RELEASE --statistics --out RELEASE/train.txt", "train.txt is a file; give a folder"),
    (
        "info RELEASE --statistics --out RELEASE/train.txt/new/folder",
        "train.txt is a file; give a folder",
    ),
    (
        "info RELEASE --statistics --out /proc/nowhere",
        "no file can be written there; give a folder that you can write to",
    ),
    ("check splits RELEASE/train.txt", "expected at least two FILES, found only"),
    ("check scores RELEASE RELEASE/train.txt", "train.txt: has no token with a score"),
    ("check scores RELEASE", "Missing argument 'FILE'"),
    ("study linx out", ", or a .yaml file, found 'linx'"),
    ("study RELEASE/no.yaml out", "no.yaml: cannot be read"),
    ("study v2x RELEASE/train.txt", "train.txt is a file; give a folder"),
    ("split RELEASE --where wether=Clear", "no field 'wether' to find scenarios by"),
    ("split RELEASE --where split=train --out mine", "mine"),
    (
        f"{LABELS} --agents ego_vehicle,pole",
        "--agents: expected one of ego_vehicle, ego_vehicle_behind,",
    ),
    (f"{LABELS} --agents ''", "found ''"),
    (f"{LABELS} --agents ego_vehicle,", "found ''"),
    (
        f"{LABELS} --switch half_cell_shift",
        "--switch: expected NAME=VALUE, found 'half_cell_shift'",
    ),
    (
        f"{LABELS} --switch half_cell_shift=maybe",
        "--switch: expected yes or no for one of own_box_moved_twice,",
    ),
    (f"{LABELS} --switch warp=exact", "found warp=exact"),
    (f"{LABELS} --preset lift-splat", "'lift-splat' is not one of"),
    (f"{LABELS} --seen-by nobody", "'nobody' is not one of"),
    (f"{LABELS} --samples some", "'some' is not one of"),
    (f"{LABELS} --workers 0", "0 is not in the range"),
    (
        "labels RELEASE --split tset --out out",
        "split: expected one of train, val, test, train_mini, val_mini, all, or a split file",
    ),
    ("labels RELEASE --split mine.txt --out out", "mine.txt: "),
    (f"{LABELS} --names lss", "'lss' is not one of 'fiery', 'beverse', 'deepaccident'"),
    (
        "labels RELEASE --split train --out ''",
        "expected a folder of motion labels, found an empty path; give '.' for",
    ),
    ("labels RELEASE --split train --out /proc/nowhere", "cannot be written"),
    ("labels RELEASE --split train --out RELEASE/train.txt", "train.txt: is a file; give a folder"),
    (
        f"{RENDER.format('frame')} --frame-range 3..1",
        "expected frame numbers, such as 20..40, found '3..1'",
    ),
    (
        f"{RENDER.format('frame')} --size big",
        "expected WIDTHxHEIGHT, such as 480x270, found 'big'",
    ),
    (
        f"{RENDER.format('accident')} --frame-range 1..3",
        "--frame-range has no effect, as a whole scenario is rendered",
    ),
    (
        "render frame RELEASE a/b/003 --frame-range 1..3 --out a",
        "--frame-range needs scenarios, and a/b/003 is in the table frame; give its scenario",
    ),
    (
        f"{RENDER.format('accident')} --seconds soon",
        "expected seconds, such as 2,1,0, found 'soon'",
    ),
    (
        "render frame RELEASE a/b/003 a/b/004 --out a.png",
        "2 pictures need a folder, found the file",
    ),
    (f"{RENDER.format('frame')} --color-by depth", "'depth' is not 'class'"),
    (f"{RENDER.format('labels')} --color-by depth", "No such option"),
    (f"{RENDER.format('frame')} --dpi 0", "0.0 is not in the range x>=1"),
    (
        f"{RENDER.format('visibility')} --style table --view-range 9",
        "--view-range has no effect with --style table",
    ),
    (
        f"{RENDER.format('sample-data')} --color-by agent --layers ids",
        "--layers has no effect with --color-by",
    ),
    (
        "render frame RELEASE --out a.bmp",
        "expected a folder, or a file that ends in .png, .pdf, .svg, .jpg, .webp",
    ),
    ("render video RELEASE --out a.png", "a.png: expected a file that ends in .mp4, .gif, .webp"),
    (f"{RENDER.format('frame')} --layers label", "layers: expected one of "),
    (f"{RENDER.format('frame')} --frame-range 2..999", "--frame-range: expected frames from 1 to"),
    (f"{RENDER.format('bev')} --view-range -5", "view_range: expected metres above 0, found -5.0"),
    (f"{RENDER.format('frame')} --agents pole", "--agents: expected one of "),
    ("render frame RELEASE no/such --out a.png", "no token 'no/such'"),
    (f"{RENDER.format('link')} --latency 0.25", "latency"),
    (f"{RENDER.format('accident')} --seconds 9", "seconds: expected values from 0 to 0.5"),
    ("predict constant_velocty release --out out", "did you mean 'constant_velocity'"),
    (
        "predict constant_velocity release --out out --agents all --budget 0",
        "0 is not in the range x>=1",
    ),
    (
        "evaluate compare RELEASE RELEASE --out numbers.txt",
        "--out: expected a file that ends in .csv, .json, .png",
    ),
    ("safety report release", "Missing option '--out'"),
    ("safety raport release", "'raport' is not one of"),
    ("safety lead-time release a/b", "SCENARIO has no effect with lead-time"),
    ("safety report RELEASE --out out --replays -1", "expected a number, all or none, found '-1'"),
    ("safety report RELEASE --out out --where length=1000..2000", "no scenario matches --where"),
    ("export town-maps RELEASE --out out --where length=900..999", "no scenario matches --where"),
    ("synth", "Missing argument 'OUT'"),
    *(
        (f"synth out --size {size}", "expected WIDTHxHEIGHT, such as 480x270")
        for size in ("480x", "axb", "4x2x3")
    ),
    *(
        (f"synth out --for-released-code {words}", "remove one of the two")
        for words in ("--size 480x270", "--size 1600x901", "--layout B", "--unlabelled-test")
    ),
    (
        "synth out --design mine.yaml --design 1",
        "expected one scenario file, or numbers of designs",
    ),
    ("synth out --design 13", "13 is not in the range 1<=x<=12"),
    ("synth out --design your.yaml", "your.yaml: no such file"),
    ("synth out --show-design none", "'none' is not a valid integer"),
]
"""Other words → message; RELEASE stands for a release with all sensors."""


@pytest.mark.parametrize(("words", "message"), [*USELESS_OPTIONS, *WRONG_CALLS])
def test_a_senseless_call_is_refused(
    da: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    command = [word.replace("RELEASE", str(da.dataroot)).strip("'") for word in words.split()]
    result = CliRunner().invoke(deepaccident, command)
    output = " ".join(f"{result.output} {result.exception}".split())
    assert isinstance(result.exception, DeepAccidentError) or result.exit_code == 2, output
    assert message in output
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
