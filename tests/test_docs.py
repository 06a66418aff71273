"""Links, options and modules that the documentation names."""

import importlib.util
import inspect
import json
import pkgutil
import re
from pathlib import Path

import pytest
from test_layout import MAY_IMPORT

import tdf_jax
from tdf_jax.cli.main import COMMANDS, main

ROOT = Path(__file__).parent.parent
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *(ROOT / ".github").rglob("*.md"),
        *(ROOT / "docs").rglob("*.md"),
        *ROOT.glob("weights/*.md"),
        *ROOT.glob("notebooks/*.ipynb"),
    ]
)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def text(page: Path) -> str:
    """Markdown of a page, of a notebook's cells."""
    if page.suffix != ".ipynb":
        return page.read_text()
    cells = json.loads(page.read_text())["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    prose = re.sub(r"```.*?```", "", text(page), flags=re.DOTALL)
    headings = re.findall(r"^#+ +(.+?) *$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(page):
    prose = re.sub(r"```.*?```|`[^`\n]*`", "", text(page), flags=re.DOTALL)
    for link in LINK.findall(prose):
        if "://" in link or link.startswith("mailto:"):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.is_file(), f"{link}: no such file"  # a folder is no page of the site
        if anchor:
            assert anchor in anchors(target), f"{link}: no such heading"


def test_templates_of_issues_have_no_links_into_the_repository():
    """An issue is another page of the web than the file, so a relative link leads nowhere."""
    templates = [text(page) for page in (ROOT / ".github" / "ISSUE_TEMPLATE").iterdir()]
    assert templates and [link for one in templates for link in LINK.findall(one) if "://" not in link] == []


def test_every_picture_and_page_is_linked():
    linked = {
        (page.parent / link.partition("#")[0]).resolve()
        for page in PAGES
        for link in LINK.findall(text(page))
        if "://" not in link
    }
    files = {path for path in (ROOT / "docs").rglob("*") if path.suffix in {".md", ".png", ".svg"}}
    assert files - linked - {ROOT / "docs" / "training.md"} == set()


COMMAND = re.compile(r"\btdf (\w+)((?: [^`\n#]*)?)")
WRITTEN = [page for page in PAGES if page.parent.name not in {"notebooks"}]


@pytest.mark.parametrize("command", COMMANDS)
def test_options_in_the_documentation_exist(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        main([command, "--help"])
    known = set(re.findall(r"--[\w.-]+", capsys.readouterr().out))
    for page in WRITTEN:
        for name, rest in COMMAND.findall(text(page)):
            if name == command:
                options = set(re.findall(r"(?<=\s)--[a-z][\w.-]*", rest))
                assert options <= known, f"{page.relative_to(ROOT)}: {sorted(options - known)}"


def test_modules_run_by_the_documentation_exist():
    ours = re.compile(r"python -m ((?:tdf_jax|bench)[\w.]*)")
    for page in WRITTEN:
        for module in ours.findall(text(page)):
            assert importlib.util.find_spec(module), f"{page.relative_to(ROOT)}: {module}"


def test_the_contributing_guide_has_the_table_of_imports():
    rows = re.findall(r"^\| `(\w+)` \| [^|]+ \| ([^|]+) \|$", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE)
    listed = {name: tuple(re.findall(r"`(\w+)`", imports)) for name, imports in rows}
    assert listed == {name: tuple(imports) for name, imports in MAY_IMPORT.items()}


@pytest.mark.parametrize("page", [page for page in WRITTEN if page.name != "CHANGELOG.md"], ids=lambda page: page.name)
def test_names_in_the_documentation_exist(page):
    words = text(page)
    for name in set(re.findall(r"\btdf\.(\w+)", words)) - {"X"}:
        assert hasattr(tdf_jax, name), f"tdf.{name}"
    for path in set(re.findall(r"`(tdf_jax(?:\.\w+)+)", words)):
        pkgutil.resolve_name(path)


def test_every_public_name_is_in_the_reference_of_one_package():
    """`make docs` writes the reference of a package where its page has this block."""
    pages = sorted((ROOT / "docs" / "api" / "packages").glob("*.md"))
    packages = [package for page in pages for package in re.findall(r"^```\{public\} (\w+)$", text(page), re.MULTILINE)]
    assert len(packages) == len(set(packages)) == len(pages)
    values = [getattr(tdf_jax, name) for name in tdf_jax.__all__]
    homes = [value.__name__ if inspect.ismodule(value) else value.__module__ for value in values]
    assert {home.split(".")[1] for home in homes} == set(packages)
    index = text(ROOT / "docs" / "index.md")
    assert all(f"(api/packages/{page.name})" in index for page in pages)


def documented():
    """Docstrings of public names, and of the public methods of public classes, by their names."""
    for name in tdf_jax.__all__:
        value = getattr(tdf_jax, name)
        yield name, inspect.getdoc(value) or ""
        if inspect.isclass(value) or inspect.ismodule(value):
            inside = {one: part for one, part in vars(value).items() if not one.startswith("_") and callable(part)}
            yield from ((f"{name}.{one}", inspect.getdoc(part) or "") for one, part in inside.items())


def test_what_is_returned_reads_as_a_sentence_on_the_site():
    """Before a colon the site expects a type, and it shows what is indented further as a quotation."""
    found = {name: re.search(r"^Returns:\n((?: {4}.*\n?|\n)+)", text, re.MULTILINE) for name, text in documented()}
    returned = {name: match[1].rstrip().split("\n") for name, match in found.items() if match}
    assert len(returned) > 50
    assert [name for name, lines in returned.items() if re.search(r":(\s|$)", re.sub("`[^`]*`", "", lines[0]))] == []
    assert [name for name, lines in returned.items() if any(line.startswith(" " * 8) for line in lines)] == []


def test_the_version_is_the_same_everywhere():
    """The package has it; who cites and who reads of changes finds the same."""
    found = {
        "CITATION.cff": r"^version: (\S+)$",
        "docs/citing.md": r"^  version = \{(\S+)\},$",
        "CHANGELOG.md": r"^## (\d\S*)$",
    }
    for name, pattern in found.items():
        first = re.search(pattern, (ROOT / name).read_text(), re.MULTILINE)
        assert first and first[1] == tdf_jax.__version__, name


@pytest.mark.parametrize("page", sorted((ROOT / "docs" / "results").glob("*.md")), ids=lambda page: page.stem)
def test_every_page_of_results_says_what_it_does_not_show(page):
    """Pages of notes too: what they are no evidence for is said there as well."""
    (said,) = re.findall(r"^## What this does not show\n+(.*?)(?=^## |\Z)", text(page), re.MULTILINE | re.DOTALL)
    assert len(said.split()) > 20
