"""What imports what: as docs/architecture.md draws it, and never in a circle, also inside of functions."""

import ast
import re
import textwrap
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PLACES = {"vecpsmbpo": ROOT / "vecpsmbpo", "vecpsmbpo.envs": ROOT / "envs"}


def modules() -> dict[str, Path]:
    """Every module's file, by the name that it is imported by."""
    found = {}
    for package, folder in PLACES.items():
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            found[".".join((package, *(part for part in parts if part != "__init__")))] = path
    return found


def imported(path: Path, known: set[str]) -> set[str]:
    """Modules of this package that a file imports, but not to annotate types alone."""
    names = set()
    tree = ast.parse(path.read_text())
    skipped = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            whole = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name if name in known else node.module for name in whole}
    return names & known


@pytest.fixture(scope="module")
def graph() -> dict[str, set[str]]:
    files = modules()
    return {name: imported(path, set(files)) - {name} for name, path in files.items()}


def test_no_module_imports_itself_by_way_of_others(graph):
    left = dict(graph)
    while free := [name for name, needs in left.items() if not needs & set(left)]:
        for name in free:
            del left[name]
    circle = [name for name in left if any(name in needs for needs in left.values())]
    assert not circle, f"they import one another: {circle}"


def test_modules_import_what_stands_to_their_left(graph):
    text = (ROOT / "docs/architecture.md").read_text()
    drawn = re.search(r"## What imports what\n.*?\n\n((?:    [^\n]*\n)+)", text, re.S)[1]
    order = [re.findall(r"\w+", part) for part in drawn.split("←")]
    rank = {f"vecpsmbpo.{name}": place for place, names in enumerate(order) for name in names}
    # Its table of names and its settings stand lower, as the text says.
    lower = re.compile(r"vecpsmbpo\.algorithms(\.catalogue|\.\w+\.settings|)$")
    ranked = {
        name: 0
        if lower.match(name)
        else next((rank[package] for package in rank if name == package or name.startswith(f"{package}.")), None)
        for name in graph
    }
    wrong = [
        f"{name} imports {other}"
        for name, needs in graph.items()
        for other in needs
        if ranked.get(name) is not None and ranked.get(other) is not None and ranked[other] > ranked[name]
    ]
    assert not wrong
    assert {place for place in ranked.values() if place is not None} == set(range(len(order)))


def test_python_in_the_documents_can_be_read():
    """Blocks that import the package; so many, that none was joined to the text around it."""
    found = 0
    for path in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        for block in re.findall(r"(?:^    [^\n]*\n|^\n(?=    ))+", path.read_text(), re.M):
            if "import vecpsmbpo" in block or "vecpsmbpo.load(" in block:
                ast.parse(textwrap.dedent(block).strip("\n") + "\n")
                found += 1
    assert found >= 4
