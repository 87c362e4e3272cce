"""Print the lower bounds of what a user or the tests install, as requirements for pip.

Each `name>=1.2` in pyproject.toml becomes `name==1.2.*`; of several bounds of a name the largest
counts.

    pip install '.[test]' $(python .ci/tools/lower_bounds.py)
    pip install '.[synth]' $(python .ci/tools/lower_bounds.py synth)

Without an argument the extra is `test`.
"""

import re
import sys
from pathlib import Path

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10, to which pytest brings it
    import tomli as tomllib

with (Path(__file__).parents[2] / "pyproject.toml").open("rb") as file:
    project = tomllib.load(file)["project"]
extras = project["optional-dependencies"]
extra = extras[sys.argv[1] if len(sys.argv) > 1 else "test"]
requirements = [*project["dependencies"], *extra]
for requirement in extra:
    if requirement.startswith("deepaccident_devkit["):
        for name in re.findall(r"\w+", requirement)[1:]:
            requirements += extras[name]
bounds: dict[str, tuple[int, ...]] = {}
for requirement in requirements:
    match = re.match(r"([\w-]+)>=([\d.]+)", requirement)
    if match:
        name, version = match.groups()
        bound = tuple(map(int, version.split(".")))
        if len(bound) == 1:
            bound = (*bound, 0)
        bounds[name] = max(bounds.get(name, ()), bound)
for name, bound in bounds.items():
    print(f"{name}=={'.'.join(map(str, bound))}.*")
