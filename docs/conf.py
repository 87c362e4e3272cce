"""The documentation site: the guides as they lie in the repository, and an API reference from the docstrings.

    pip install '.[docs]' && sphinx-build -W --keep-going -c docs . build/site

The repository's root is the source folder, so that links between docs/, schema/ and tutorials/ are the same on GitHub
and on the site. Nothing is fetched from a network.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from deepaccident_devkit import __version__

project = "DeepAccident devkit"
author = "The DeepAccident devkit developers"
project_copyright = "the DeepAccident devkit developers, Apache-2.0"
version = release = __version__

extensions = ["myst_parser", "markdown_docstrings", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "docs/index"
include_patterns = [
    "docs/*.md",
    "docs/api/*.md",
    "schema/**.md",
    "tutorials/*.md",
    "benchmarks/*.md",
    "CHANGELOG.md",
    "SECURITY.md",
]
templates_path = ["templates"]
html_theme = "furo"
html_title = project
html_static_path = ["static"]
html_css_files = ["code.css"]
html_additional_pages = {"index": "to_docs.html"}  # for those who open the folder
html_copy_source = False

myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_mock_imports = ["torch", "safetensors"]  # the adapter and the model are described without them
napoleon_numpy_docstring = False
napoleon_attr_annotations = False  # signatures have the types
napoleon_use_ivar = True  # attributes are a list below their class, not an entry each
