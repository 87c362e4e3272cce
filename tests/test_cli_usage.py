"""A call that cannot be meant is refused before anything is written, and the message says why."""

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
UNUSED = [
    (EVALUATE.format("motion") + " --overwrite", "--overwrite changes nothing without --out"),
    (
        EVALUATE.format("motion") + " --include-results",
        "--include-results changes nothing without --out",
    ),
    (
        EVALUATE.format("warning") + " --threshold-by quiet",
        "--threshold-by changes nothing without --threshold-from",
    ),
    (
        EVALUATE.format("warning") + " --threshold-from runs/train --switch threshold=0.5",
        "--threshold-from sets the threshold that --switch threshold=… sets; give one of them",
    ),
    (
        EVALUATE.format("warning") + " --protocol field --resamples 100",
        "--resamples changes nothing with --protocol field, which has no intervals",
    ),
    (
        EVALUATE.format("warning") + " --protocol field --prevented",
        (
            "--prevented needs the scores of whole recordings, which --protocol field "
            "does not have; give --protocol clean"
        ),
    ),
    (
        EVALUATE.format("detection") + " --samples all --horizon 3",
        "--horizon changes nothing with --samples all",
    ),
    (
        EVALUATE.format("forecasting") + " --horizon 3",
        "--horizon changes nothing with --samples all: the protocol has",
    ),
    ("check results results --split val", "--split changes nothing without --dataroot"),
    ("check results results --on-error raise", "--on-error changes nothing without --dataroot"),
    (BASELINE + " --latency 0.2", "--latency changes nothing with --agents single"),
    (BASELINE + " --budget 1000", "--budget changes nothing with --agents single"),
    (
        "predict tiny release --out out --agents single --budget 1000",
        "--budget changes nothing with --agents single",
    ),
    (
        BASELINE + " --agents all --budget 1000 --seed 3",
        "--seed changes nothing without --pose-noise or --packet-loss",
    ),
    (
        "predict constant_velocity release --out out --agents all --seed 3",
        "--seed changes nothing without --pose-noise",
    ),
    (
        "predict constant_velocity release --out out --samples all --scope all",
        "--scope changes nothing with --samples all",
    ),
    (
        "render bev release --out a.png --pose-noise 0.3",
        "--pose-noise changes nothing without --agents",
    ),
    (
        "render bev release --out a.png --agents all --seed 3",
        "--seed changes nothing without --pose-noise",
    ),
    (
        "export mcap release --out a.mcap --channels Camera_Front --points 3",
        "--points changes nothing without the cha",
    ),
    (
        EVALUATE.format("motion") + " --protocol clean",
        (
            "'clean' is a protocol of labels; choose the labels by the switch "
            "labels='clean' (--switch labels=clean)"
        ),
    ),
    (EVALUATE.format("accident") + " --protocol fiery", "'fiery' is a protocol of labels"),
    (
        "labels release --split train --out out --preset clean",
        "'clean' is a protocol of labels: give protocol='clean'",
    ),
    ("validate release --json --all", "--all changes nothing with --json"),
    ("validate release --files --deep", "--deep changes nothing with --files, which opens no file"),
    ("study v2x out --device cpu", "--device changes nothing with a recipe without weights"),
    ("check reader out --write-release --json", "--json changes nothing with --write-release"),
    (
        "split release --seed 3 --out mine.txt",
        "--seed changes nothing with --where or a split file",
    ),
    ("split release --overwrite", "--overwrite changes nothing without --out"),
    ("info release --out out", "--out changes nothing without --statistics"),
    (
        "synth out --design mine.yaml --unplanned 0.5",
        "--unplanned changes nothing with a scenario file or --view",
    ),
    (
        "predict tiny release --out out --horizon 3",
        "--horizon changes nothing with a trained model",
    ),
    (BASELINE + " --device cpu", "--device changes nothing with a baseline"),
    (
        "results RELEASE/train.txt release --out out --method me",
        "--method changes nothing without --truth",
    ),
    (
        "results RELEASE/train.txt release --truth RELEASE/train.txt --out out",
        "give DATAROOT for detections of a nuScenes",
    ),
    (
        "safety describe release --out .",
        "--out: . is a folder; give a file, such as ./stories.jsonl",
    ),
    ("safety twins release --replays 3", "--replays changes nothing with twins"),
    ("safety report release --json", "--json changes nothing with report"),
]
"""Words with an option that changes nothing → what is said."""
WRONG = [
    ("info", "Missing argument"),
    ("dance", "No such command 'dance'"),
    ("--all", "--all"),
    ("rendr out", "No such command 'rendr'. Did you mean 'render'?"),
    ("info RELEASE --where town=Twon03", "Town10HD; did you mean 'Town03'?"),
    ("info RELEASE --statistics --out ''", "expected a folder to write to, found an empty path"),
    ("info RELEASE --statistics --out RELEASE/train.txt", "train.txt is a file; give a folder"),
    (
        "info RELEASE --statistics --out RELEASE/train.txt/new/folder",
        "train.txt is a file; give a folder",
    ),
    (
        "info RELEASE --statistics --out /proc/nowhere",
        "no file can be written there; give a folder that you may",
    ),
    ("check splits RELEASE/train.txt", "expected two sides or more, found 1"),
    ("check scores RELEASE RELEASE/train.txt", "train.txt: has no token with a score"),
    ("check scores RELEASE", "Missing argument 'FILE'"),
    ("study linx out", "RECIPE, which is no file .yaml: expected one of"),
    ("study RELEASE/no.yaml out", "no.yaml: cannot be read"),
    ("study v2x RELEASE/train.txt", "train.txt is a file; give a folder"),
    ("split RELEASE --where wether=Clear", "scenarios cannot be found by 'wether'"),
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
        "expected frame numbers such as 20..40, found '3..1'",
    ),
    (
        f"{RENDER.format('frame')} --size big",
        "expected width x height such as 480x270, found 'big'",
    ),
    (
        f"{RENDER.format('accident')} --frame-range 1..3",
        "--frame-range is for moments; a whole scenario is rendered",
    ),
    (
        "render frame RELEASE a/b/003 --frame-range 1..3 --out a",
        "--frame-range is for scenarios; a/b/003 is a frame",
    ),
    (f"{RENDER.format('accident')} --seconds soon", "expected seconds such as 2,1,0, found 'soon'"),
    (
        "render frame RELEASE a/b/003 a/b/004 --out a.png",
        "2 pictures need a folder, found the file",
    ),
    (f"{RENDER.format('frame')} --color-by depth", "'depth' is not 'class'"),
    (f"{RENDER.format('labels')} --color-by depth", "No such option"),
    (f"{RENDER.format('frame')} --dpi 0", "0.0 is not in the range x>=1"),
    (
        f"{RENDER.format('visibility')} --style table --view-range 9",
        "--view-range changes nothing with --style table",
    ),
    (
        f"{RENDER.format('sample-data')} --color-by agent --layers ids",
        "--layers changes nothing with --color-by",
    ),
    (
        "render frame RELEASE --out a.bmp",
        "expected a folder, or a file that ends in .png, .pdf, .svg, .jpg, .webp",
    ),
    ("render video RELEASE --out a.png", "path: expected a file that ends in .mp4, .gif, .webp"),
    (f"{RENDER.format('frame')} --layers label", "layers: expected one of "),
    (f"{RENDER.format('frame')} --frame-range 2..999", "--frame-range: expected frames from 1 to"),
    (f"{RENDER.format('bev')} --view-range -5", "view_range: expected metres above 0, found -5.0"),
    (f"{RENDER.format('frame')} --agents pole", "--agents: expected one of "),
    ("render frame RELEASE no/such --out a.png", "no token 'no/such'"),
    (f"{RENDER.format('link')} --latency 0.25", "latency"),
    (f"{RENDER.format('accident')} --seconds 9", "seconds: expected some from 0 to 0.5"),
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
    ("safety lead-time release a/b", "SCENARIO changes nothing with lead-time"),
    ("safety report RELEASE --out out --replays -1", "expected a number, all or none, found '-1'"),
    ("safety report RELEASE --out out --where length=1000..2000", "no scenario matches --where"),
    ("export town-maps RELEASE --out out --where length=900..999", "no scenario matches --where"),
    ("synth", "Missing argument 'OUT'"),
    *(
        (f"synth out --size {size}", "expected width x height such as 480x270")
        for size in ("480x", "axb", "4x2x3")
    ),
    *(
        (f"synth out --for-released-code {words}", "leave one of the two out")
        for words in ("--size 480x270", "--size 1600x901", "--layout B", "--unlabelled-test")
    ),
    ("synth out --design mine.yaml --design 1", "give one scenario file, or numbers of designs"),
    ("synth out --design 13", "13 is not in the range 1<=x<=12"),
    ("synth out --design your.yaml", "your.yaml: no such file"),
    ("synth out --show-design none", "'none' is not a valid integer"),
]
"""Other words → what is said; RELEASE is one with all sensors."""


@pytest.mark.parametrize(("words", "told"), [*UNUSED, *WRONG])
def test_what_cannot_be_meant_is_refused(
    da: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, told: str
) -> None:
    monkeypatch.chdir(tmp_path)
    made = [word.replace("RELEASE", str(da.dataroot)).strip("'") for word in words.split()]
    result = CliRunner().invoke(deepaccident, made)
    said = " ".join(f"{result.output} {result.exception}".split())
    assert isinstance(result.exception, DeepAccidentError) or result.exit_code == 2, said
    assert told in said
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
