"""Write docs/validation.md from the table of findings: `python docs/make_validation_page.py`."""

from pathlib import Path

from deepaccident_devkit.validation import CODES

PAGE = Path(__file__).parent / "validation.md"

_HEAD = """# What `deepaccident validate` looks for

For everybody who has downloaded a release: what `deepaccident validate` tests, and what each of its findings means. 11
minutes.

    deepaccident validate DATAROOT            # labels, calib, meta and the names of all files: a minute or two
    deepaccident validate DATAROOT --deep     # also decodes every image and array: hours for the whole release
    deepaccident validate DATAROOT --all      # lists all findings of a scenario, not only the first eight
    deepaccident validate DATAROOT --json     # one JSON document
    deepaccident validate DATAROOT --deep --parts found  # goes on where it was stopped

```python
from deepaccident_devkit import DeepAccident

da = DeepAccident(dataroot="deepaccident_demo/release")
da.findings(da.scenario[0]["token"])  # one scenario's, worst first
```

It reads the files and needs no index. Each finding says what is wrong, where, how bad it is and what to do:

- **error**: the scenario cannot be indexed, or what it says cannot be true.
- **warning**: probably wrong. The scenario can be opened.
- **note**: worth knowing; shown with `--all`.

Exit status: 0 if there are at most notes and known findings, 1 if there are errors or other warnings, 2 if the release
cannot be looked at.
What keeps a scenario from being indexed is found by the same code that indexes it; its meaning is only looked at if
there is nothing of that kind. Findings marked *known* are the real release's own, not your download's.

A sensor's folder or an agent that is completely absent is no fault, since most downloads are partial. The end of the
report counts the files that are here and missing; `--files` prints that alone, within seconds
([what is missing of a download](format.md#what-is-missing-of-a-download)).

[fault_table.md](fault_table.md) tells which of 200 planted faults it finds.

## The JSON document

One object: `dataroot`, `version`, `deep`; `scenarios` and `samples` that were looked at; `counts` by how bad;
`findings`, worst scenario first, each with `code`, `severity`, `scenario` (null for the release as a whole), `where`,
`what`, `remedy` and `known`; `files`, what is here and missing of each split, agent and kind of file (all that
`--files --json` prints); `velocity` with how many moving `boxes` were tried, how many each hypothesis `fits`, and the
`best` one.

## The findings

"""


def page() -> str:
    """The page's text."""
    lines = ["| finding | how bad | what it means | what to do |", "|---|---|---|---|"]
    for name, code in CODES.items():
        meaning = code.meaning + (f" Known: {code.known}." if code.known else "")
        depth = " (`--deep`)" if code.deep else ""
        lines.append(f"| `{name}` | {code.severity}{depth} | {meaning} | {code.remedy} |")
    return _HEAD + "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
