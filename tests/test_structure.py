"""The package's shape: import rules, unique names, docstrings, and how long things get.

Which package may import which, and where a third party may be imported, is said in the contracts of
``pyproject.toml``; import-linter reads them.
That the documented tree is the real one is asked by ``test_docs.py``: it is made from the files.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "madviz"
FILES = sorted(PACKAGE.rglob("*.py"))
MODULES = {".".join(p.relative_to(PACKAGE).with_suffix("").parts): p for p in FILES}
MODULES |= {f"benchmarks.{p.stem}": p for p in sorted((ROOT / "benchmarks").glob("*.py"))}
TREES = {name: ast.parse(path.read_text()) for name, path in MODULES.items()}


def imports(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """(module, name) of everything that a file imports, also inside functions; the name is empty
    where a whole module is imported."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import of {node.module}"
            yield from ((node.module or "", alias.name) for alias in node.names)


def test_imports_keep_the_contracts() -> None:
    program = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    words = [sys.executable, "-c", program, "--no-cache"]
    found = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout + found.stderr


def test_at_most_eight_files_at_the_top() -> None:
    assert len(list(PACKAGE.glob("*.py"))) <= 8


def test_every_third_party_is_declared() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"].values()
    lines = [*project["dependencies"], *(line for extra in extras for line in extra)]
    declared = {re.split(r"[^\w-]", line)[0].lower().replace("_", "-") for line in lines}
    outside = {module.split(".")[0] for tree in TREES.values() for module, _ in imports(tree)}
    providers = packages_distributions()
    for name in outside - set(sys.stdlib_module_names) - {"benchmarks", "madviz"}:
        owners = {owner.lower().replace("_", "-") for owner in providers.get(name, [name])}
        assert owners & declared, f"pyproject.toml does not declare {owners}, which has {name}"


def test_no_class_name_twice() -> None:
    named = Counter(
        node.name
        for tree in TREES.values()
        for node in ast.walk(tree)
        if type(node) is ast.ClassDef
    )
    assert [name for name, count in named.items() if count > 1] == []


def used_elsewhere() -> Iterator[tuple[str, str]]:
    """(module, name) of what another package of madviz imports."""
    for user, tree in TREES.items():
        for module, name in imports(tree):
            module = module.removeprefix("madviz.")
            if module in TREES and name and module.split(".")[0] != user.split(".")[0]:
                yield module, name


def test_what_other_packages_use_has_a_docstring() -> None:
    missing = set()
    for module, name in set(used_elsewhere()):
        for node in TREES[module].body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
                if not ast.get_docstring(node):
                    missing.add(f"{module}.{name}")
    assert sorted(missing) == []


@pytest.mark.parametrize("module", MODULES)
def test_files_and_functions_stay_short(module: str) -> None:
    assert len(MODULES[module].read_text().splitlines()) <= 400
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = (node.end_lineno or 0) - node.lineno + 1
            assert length <= 60, f"{module}.{node.name} has {length} lines"


def test_literals_are_not_packed() -> None:
    """``*("a", 1)`` and ``**{"a": 1}`` save a line and cost the reader: they are plain arguments.
    A dict that is spread for a key that is no identifier has no other spelling."""
    packed = []
    for path in (*MODULES.values(), *sorted((ROOT / "tests").rglob("*.py"))):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.expr):
                continue
            starred = isinstance(node, ast.Starred) and isinstance(
                node.value, ast.Tuple | ast.List | ast.Set
            )
            spread = (
                isinstance(node, ast.Call)
                and any(
                    word.arg is None
                    and isinstance(word.value, ast.Dict)
                    and all(
                        isinstance(key, ast.Constant) and str(key.value).isidentifier()
                        for key in word.value.keys
                    )
                    for word in node.keywords
                )
            ) or (
                isinstance(node, ast.Dict)
                and any(
                    key is None and isinstance(value, ast.Dict)
                    for key, value in zip(node.keys, node.values, strict=True)
                )
            )
            if starred or spread:
                packed.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert packed == []


def test_docstrings_have_a_subject() -> None:
    """A docstring that begins with *Of* or *What* leaves its subject to the reader."""
    lines = [
        f"madviz/{module.replace('.', '/')}.py:{node.lineno}"
        for module, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and str(node.value.value).strip().startswith(("Of ", "What "))
    ]
    assert lines == []


def test_assignments_are_not_packed() -> None:
    """``self.a, self.b = a, b`` saves a line and costs the reader. A swap needs it, and so does
    every assignment whose values read what it has already assigned."""
    lines = [
        f"madviz/{module.replace('.', '/')}.py:{node.lineno}"
        for module, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and is_packed(node)
    ]
    assert lines == []


@pytest.mark.parametrize(
    ("line", "packed"),
    [
        ("self.a, self.b = a, b", True),
        ("a, b = 1, f(c)", True),
        ("a, b = b, a", False),
        ("a, b = b, a + b", False),
        ("a, b = f()", False),
        ("a, *b = 1, 2", False),
        ("a[0], a[1] = 1, 2", False),
    ],
)
def test_a_packed_assignment_is_recognised(line: str, packed: bool) -> None:
    (node,) = ast.parse(line).body
    assert isinstance(node, ast.Assign) and is_packed(node) is packed


def is_packed(node: ast.Assign) -> bool:
    """Whether ``node`` is several assignments in one, which could as well be a line each."""
    targets = node.targets[0]
    if not (isinstance(targets, ast.Tuple) and isinstance(node.value, ast.Tuple)):
        return False
    values = node.value.elts
    plain = [target for target in targets.elts if isinstance(target, ast.Name | ast.Attribute)]
    if len(plain) < 2 or len(values) != len(targets.elts):
        return False
    if any(isinstance(part, ast.Starred) for part in (*targets.elts, *values)):
        return False
    for i, value in enumerate(values):
        assigned = {ast.unparse(target) for target in targets.elts[:i]}
        if assigned & {ast.unparse(part) for part in ast.walk(value) if isinstance(part, ast.expr)}:
            return False
    return True


def test_importing_madviz_loads_neither_torch_nor_viser() -> None:
    heavy = {"torch", "viser", "mujoco", "tyro", "sapien", "ray", "matplotlib"}
    program = f"import madviz, sys; print(*{heavy} & set(sys.modules))"
    loaded = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert loaded.stdout.split() == []
