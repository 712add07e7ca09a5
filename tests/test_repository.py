"""Rules that the whole tree keeps."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted((ROOT / "src" / "fieldstone").rglob("*.py"))
FORBIDDEN_NAMES = {"utils", "util", "helpers", "helper", "common", "misc"}


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_modules_are_short_and_named_after_what_they_hold(path):
    assert path.stem not in FORBIDDEN_NAMES
    assert len(path.read_text().splitlines()) <= 400, "one idea per file, under 400 lines"


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_public_functions_and_classes_have_docstrings(path):
    tree = ast.parse(path.read_text())
    assert ast.get_docstring(tree), "the module has no docstring"
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef) and not node.name.startswith("_")]
    bodies = [tree, *classes]
    for node in (child for body in bodies for child in body.body):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            assert ast.get_docstring(node), f"{node.name} has no docstring"


def test_every_cited_paper_is_in_the_references():
    keys = set(re.findall(r"@\w+\{([^,]+),", (ROOT / "docs" / "references.bib").read_text()))
    cited = set()
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef):
                continue
            doc = ast.get_docstring(node) or ""
            if "Source:" in doc:
                cited |= set(re.findall(r"`([a-z]+\d{4}[a-z]?)`", doc.split("Source:", 1)[1]))
    assert cited <= keys, f"not in docs/references.bib: {sorted(cited - keys)}"


def test_every_source_in_the_glossary_is_in_the_references():
    keys = re.findall(r"@\w+\{([^,]+),", (ROOT / "docs" / "references.bib").read_text())
    assert len(keys) == len(set(keys)), "a key is there twice"
    cited = set(re.findall(r"`([a-z]+\d{4}[a-z]?)`", (ROOT / "docs" / "glossary.md").read_text()))
    assert cited
    assert cited <= set(keys), f"not in docs/references.bib: {sorted(cited - set(keys))}"


def test_no_data_file_is_large():
    for path in (ROOT / "tests").rglob("*"):
        assert not path.is_file() or path.stat().st_size < 1_000_000, path


def test_no_kernel_may_reorder_its_sums():
    """A permit lets the last bits depend on which kernels came before, see `solve/algebra/block_sums_numba.py`."""
    assert not [path for path in SOURCES if "fastmath" in path.read_text()]
