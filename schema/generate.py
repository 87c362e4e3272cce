"""Write the JSON Schemas (also of results/) and the column tables of README.md anew: `python schema/generate.py`."""

import json
from pathlib import Path

from deepaccident_devkit.evaluation.results import RESULT_SCHEMAS
from deepaccident_devkit.interactions.table import interaction_specs
from deepaccident_devkit.tables.schema import columns_markdown, json_schemas

FOLDER = Path(__file__).parent
MARK = "<!-- generated below: python schema/generate.py -->"


def generated_files() -> dict[str, str]:
    """File name → what it should contain."""
    files = {
        f"{name}.json": json.dumps(schema, indent=2, ensure_ascii=False) + "\n"
        for name, schema in json_schemas(interaction_specs()).items()
    }
    prose = (FOLDER / "README.md").read_text(encoding="utf-8").partition(MARK)[0]
    return {**files, "README.md": f"{prose}{MARK}\n\n{columns_markdown(interaction_specs())}"}


def generated_results_files() -> dict[str, str]:
    """File name in results/ → what it should contain."""
    return {
        f"{task}.json": json.dumps(schema, indent=2, ensure_ascii=False) + "\n"
        for task, schema in RESULT_SCHEMAS.items()
    }


if __name__ == "__main__":
    for name, content in generated_files().items():
        (FOLDER / name).write_text(content, encoding="utf-8")
    for name, content in generated_results_files().items():
        (FOLDER / "results" / name).write_text(content, encoding="utf-8")
