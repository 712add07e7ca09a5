"""The import contract about torch covers every module of the fields that does without it."""

import ast
import configparser
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ROOT / "src"


def imports_torch(path: Path) -> bool:
    """Whether the module itself names torch."""
    for node in ast.walk(ast.parse(path.read_text())):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        if any(name.split(".")[0] == "torch" for name in names):
            return True
    return False


def test_modules_without_torch_are_under_the_contract():
    contracts = configparser.ConfigParser()
    contracts.read(ROOT / ".importlinter")
    covered = contracts["importlinter:contract:torch"]["source_modules"].split()
    left_out = []
    for path in sorted((SOURCES / "fieldstone" / "field").rglob("*.py")):
        module = ".".join(path.relative_to(SOURCES).with_suffix("").parts).removesuffix(".__init__")
        if imports_torch(path) or path.name == "__init__.py":
            continue
        if not any(module == name or module.startswith(f"{name}.") for name in covered):
            left_out.append(module)
    assert not left_out
