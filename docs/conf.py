"""The documentation site: `make docs` builds it with Sphinx, without a network.

The root of the repository is the source folder, so a link leads to the same file on the site as in the repository. A
link to a file that is no page, such as a JSON or a notebook's script, is a download on the site.
"""

import inspect
import json
import re
import sys
from pathlib import Path

from sphinx.errors import ExtensionError

import tdf_jax

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import executed_notebooks  # noqa: E402  # it stands beside this file, which the line above makes known

project = "tdf_jax"
author = "The tdf_jax authors"
version = release = tdf_jax.__version__
copyright = author  # Sphinx's name

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
root_doc = "docs/index"
include_patterns = ["docs/**", "notebooks/*.ipynb", "weights/*.md", "CONTRIBUTING.md", "CHANGELOG.md"]
exclude_patterns = [".*", "**/.*", "tdf_jax", "tests", "bench", "build", "dist", "runs", "docs/results/runs"]
exclude_patterns += ["docs/training.md"]  # for readers of the weights' records, which name it

html_theme = "furo"
html_title = f"tdf_jax {release}"
html_static_path = ["site/static"]
html_css_files = ["tdf.css"]
html_extra_path = ["site/root"]  # leads from the top of the site to the index
html_copy_source = False
html_theme_options = {"sidebar_hide_name": False}

myst_heading_anchors = 4  # as GitHub makes them
myst_enable_extensions = ["dollarmath", "attrs_block"]
nb_execution_mode = "off"  # `executed_notebooks` gives them with their outputs
nb_merge_streams = True
FAST = "The outputs on this site are those of the fast mode, with few starts and query points: yours are better."

add_module_names = False
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints = "none"  # the docstrings have shapes, units and frames
default_role = "py:obj"  # single backticks of docstrings; names of the library become links
napoleon_attr_annotations = False
napoleon_use_ivar = True
napoleon_use_rtype = False


def names_of(package: str) -> list[str]:
    """Public names that a package defines, in the order of the alphabet."""
    values = {name: getattr(tdf_jax, name) for name in tdf_jax.__all__}
    homes = {name: value.__name__ if inspect.ismodule(value) else value.__module__ for name, value in values.items()}
    return [name for name, home in homes.items() if home.split(".")[1] == package]


def reference(package: str) -> str:
    """Directives that document the public names of a package."""
    lines = ["```{eval-rst}", ".. currentmodule:: tdf_jax", ""]
    for name in names_of(package):
        value = getattr(tdf_jax, name)
        if inspect.ismodule(value):
            lines += [f".. automodule:: tdf_jax.{name}", "   :members:", ""]
        elif inspect.isclass(value):
            lines += [f".. autoclass:: {name}", "   :members:", ""]
        else:
            lines += [f".. autofunction:: {name}", ""]
    return "\n".join([*lines, "```"])


def sidebar(index: str) -> str:
    """Tables of contents, one of the pages that each section of the index links to."""
    tables = []
    for section in re.split(r"^## ", index, flags=re.MULTILINE)[1:]:
        links = re.findall(r"\[([^\]]+)\]\(([^)#:\s]+\.(?:md|ipynb))\)", section)
        if links:
            caption = section.partition("\n")[0]
            head = ["```{toctree}", ":hidden:", f":caption: {caption}", ""]
            tables.append("\n".join([*head, *(f"{name[0].upper()}{name[1:]} <{page}>" for name, page in links), "```"]))
    return "\n\n".join(tables)


def complete(app, page: str, source: list[str]) -> None:
    """Add what is written elsewhere: the sidebar, the reference of a package, the outputs of a notebook."""
    if page == root_doc:
        source[0] += "\n" + sidebar(source[0])
    if page.startswith("notebooks/"):
        notebook = json.loads(executed_notebooks.executed(HERE.parent / f"{page}.ipynb"))
        goal = notebook["cells"][0]
        goal["source"] = "".join(goal["source"]) + f"\n\n*{FAST}*"
        source[0] = json.dumps(notebook)
    source[0] = re.sub(r"^```\{public\} (\w+)\n```$", lambda found: reference(found[1]), source[0], flags=re.MULTILINE)


def written_for_sphinx(app, what: str, name: str, value, options, lines: list[str]) -> None:
    """Docstrings are plain English: an asterisk is no markup, and a page of the documentation becomes a link."""
    for number, line in enumerate(lines):
        line = line.replace("*", r"\*")
        lines[number] = re.sub(r"`?docs/((?:guide|results|api)/\w+)\.md(?:#\w+)?`?", r":doc:`/docs/\1`", line)


def check_names(app, error: Exception | None) -> None:
    """End the build with an error if a public name is not in the reference."""
    documented = app.env.domaindata["py"]["objects"]
    missing = [name for name in tdf_jax.__all__ if f"tdf_jax.{name}" not in documented]
    if error is None and missing:
        raise ExtensionError(f"no page of docs/api/packages documents {', '.join(missing)}")


def setup(app) -> None:
    """Sphinx calls this."""
    app.connect("source-read", complete)
    app.connect("autodoc-process-docstring", written_for_sphinx, priority=100)  # before napoleon
    app.connect("build-finished", check_names)
