"""Modules of JavaScript are joined in the order of their imports, or an error explains why they
cannot be.
"""

from pathlib import Path

import pytest

from deepaccident_devkit.support.scripts import bundled

MODULES = {
    "page": """import { add } from "./sums.js";
import {
  ONE,
  Two,
} from "./numbers.js";

add(ONE, new Two());
""",
    "sums": """// Sums.
import { ONE } from "./numbers.js";
/** @import { Two } from "./numbers.js" */

/**
 * Add numbers.
 * @param {number} a
 */
export function add(a, b) {
  /** @type {number} */
  return a +
    /** @type {number} */ (b) + ONE;
}
""",
    "numbers": """const zero = 0;
export const ONE = zero + 1;
export class Two {}
export async function wait() {}
""",
}
BUNDLE = """(() => {
"use strict";
const module_numbers = (() => {
const zero = 0;
const ONE = zero + 1;
class Two {}
async function wait() {}
return { ONE, Two, wait };
})();
const module_sums = (() => {
// Sums.
const { ONE } = module_numbers;

function add(a, b) {
  return a +
    /** @type {number} */ (b) + ONE;
}
return { add };
})();
const module_page = (() => {
const { add } = module_sums;
const {
  ONE,
  Two,
} = module_numbers;

add(ONE, new Two());
return {  };
})();
})();
"""


def bundle_modules(folder: Path, **modules: str) -> str:
    """Write modules into a folder and bundle them from the first one."""
    for name, text in modules.items():
        (folder / f"{name}.js").write_text(text, encoding="utf-8")
    first = next(iter(modules))
    return bundled(lambda name: (folder / name).read_text(encoding="utf-8"), first)


def test_each_module_stands_once_and_after_its_imports(tmp_path: Path) -> None:
    assert bundle_modules(tmp_path, **MODULES) == BUNDLE


@pytest.mark.parametrize(
    "line",
    [
        'import numbers from "./numbers.js";',
        'import * as numbers from "./numbers.js";',
        'import "./numbers.js";',
        'import { ONE as one } from "./numbers.js";',
        'import { ONE } from "../numbers.js";',
        'import { ONE } from "numbers";',
        "export default 1;",
        "export let count = 0;",
        "export { ONE };",
        'export * from "./numbers.js";',
    ],
)
def test_other_forms_of_imports_and_exports_are_refused(line: str, tmp_path: Path) -> None:
    message = r"page\.js: the bundler does not know this form: (import|export) "
    with pytest.raises(ValueError, match=message):
        bundle_modules(tmp_path, page=f"{line}\n", numbers=MODULES["numbers"])


def test_modules_that_import_each_other_are_refused(tmp_path: Path) -> None:
    import_line = 'import {{ a }} from "./{}.js";\n'.format
    message = "modules import each other: a imports b imports c imports a"
    with pytest.raises(ValueError, match=message):
        bundle_modules(tmp_path, a=import_line("b"), b=import_line("c"), c=import_line("a"))


def test_a_module_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"sums\.js"):
        bundle_modules(tmp_path, page=MODULES["page"])
