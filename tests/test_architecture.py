"""docs/architecture.md against the code: what it names exists, and the layers are those of the import contract."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs/architecture.md").read_text()
# names with a package in front: `input.load.load_photos`
NAMED = sorted(set(re.findall(r"`((?:[a-z_]+\.){1,3}[A-Za-z_]\w*(?:\.\w+)?)`", PAGE)))


@pytest.mark.parametrize("name", [name for name in NAMED if not re.search(r"\.(md|py|json|html|toml)$", name)])
def test_what_the_page_names_exists(name):
    parts = ("rsundistort_" + name if name.startswith("cli.") else "rsundistort." + name).split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            fields = getattr(found, "__dataclass_fields__", {})
            found = fields[part] if part in fields else getattr(found, part)
        return
    pytest.fail(f"nothing of {name} can be imported")


def test_rooms_are_the_packages_in_the_order_of_the_import_contract():
    rooms = re.findall(r"`(\w+)`", "".join(line.split("|")[1] for line in PAGE.splitlines() if line.startswith("| `")))
    packages = {path.parent.name for path in ROOT.glob("rsundistort/*/__init__.py")} - {"pipeline"}
    assert set(rooms) - {"cli", "testing"} == packages
    contract = re.search(r"layers = \[(.*?)\n\]", (ROOT / "pyproject.toml").read_text(), re.DOTALL)
    layers = [re.findall(r"rsundistort[._](\w+)", line) for line in contract[1].splitlines() if line.strip()]
    rank = {name: k for k, names in enumerate(layers) for name in names}
    ranks = [rank[name] for name in rooms]
    assert ranks == sorted(ranks)


def test_a_photo_passes_each_room_once():
    way = PAGE.split("## The way of a photo")[1].split("##")[0]
    rooms = re.findall(r"^\d+\. `([\w.]+)\.\w+`", way, re.MULTILINE)
    assert len(rooms) == len(set(rooms)) <= 9


def test_files_functions_and_commands_are_short():
    for path in [*ROOT.glob("rsundistort/**/*.py"), *ROOT.glob("cli/*.py")]:
        text = path.read_text(encoding="utf-8")
        assert text.count("\n") <= 600, path
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                # of a command its options count, too
                first = min([node.lineno, *(each.lineno for each in node.decorator_list)])
                assert node.end_lineno - first <= 80, f"{path.name}: {node.name}"


def test_names_of_modules_occur_once_but_for_kernels_and_commands():
    names = [path.name for path in (ROOT / "rsundistort").rglob("*.py") if path.parent.name != "_kernels"]
    assert sorted(name for name in set(names) if names.count(name) > 1) == ["__init__.py"]


def test_lines_of_markdown_are_short_but_for_tables():
    for path in [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("sample_scenes/**/*.md")]:
        for line in path.read_text(encoding="utf-8").splitlines():
            assert len(line) <= 120 or line.startswith("|"), f"{path.name}: {line}"
