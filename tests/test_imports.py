"""Imports point one way, files stay short, and the rest of the package knows no network by name."""

import ast
import re
import sys
import tomllib
from collections.abc import Collection
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = (
    {"config", "files", "clouds", "transform", "cpu_memory", "compilation"},
    {"config_json", "structs"},
    {"devices", "geometry", "data"},
    {"ops"},
    {"nn"},
    {"models", "baselines"},
    {"inference"},
    {"registration"},
    {"evaluation"},
    {"training"},
    {"report"},
    {"experiments", "parity"},
    {"bench"},
    {"presets"},
    {"commands"},
    {"cli"},
    {"align", "export", "cmig_jax"},
)
"""The parts of the package: each imports from itself and from those above its line."""
RANK = {part: rank for rank, layer in enumerate(LAYERS) for part in layer}
WITHOUT_JAX = ("config", "config_json", "files", "clouds", "cpu_memory", "data", "cli", "presets")
LONGEST = 250
DISTRIBUTION = {
    "absl": "absl-py",
    "PIL": "pillow",
    "orbax": "orbax-checkpoint",
    "kiss_matcher": "kiss-matcher",
    "lzf": "python-neo-lzf",
    "mpl_toolkits": "matplotlib",
}


def modules() -> dict[str, Path]:
    """Name every file of the package; a folder's `__init__` is the folder, and `configs` is installed as `cmig_jax.presets`."""
    named = {}
    for path in [*(ROOT / "cmig_jax").rglob("*.py"), *(ROOT / "configs").rglob("*.py")]:
        parts = path.relative_to(ROOT).with_suffix("").parts
        parts = ("cmig_jax", "presets", *parts[1:]) if parts[0] == "configs" else parts
        named[".".join(parts).removesuffix(".__init__")] = path
    return named


def is_main_block(node: ast.stmt) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == "__name__ == '__main__'"


def imports(module: str, path: Path, ours: Collection[str]) -> set[str]:
    """List what a file imports, anywhere in it but for what only `python -m` runs; `from package import module` is that module."""
    found, package = set(), module if path.name == "__init__.py" else module.rpartition(".")[0]
    body = [] if path.name == "__main__.py" else [node for node in ast.parse(path.read_text()).body if not is_main_block(node)]
    for node in (inner for outer in body for inner in ast.walk(outer)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            origin = f"{package}.{node.module or ''}".rstrip(".") if node.level else str(node.module)
            names = {f"{origin}.{alias.name}" for alias in node.names}
            found |= {name if name in ours or name == "flax.nnx" else origin for name in names}
    return found


def part(module: str) -> str:
    return module.split(".")[1] if "." in module else module


MODULES = modules()
IMPORTS = {module: imports(module, path, MODULES) for module, path in MODULES.items()}
OURS = {module: {name for name in names if name in MODULES} for module, names in IMPORTS.items()}


@pytest.mark.parametrize("module", sorted(MODULES))
def test_imports_point_one_way(module):
    rank = RANK[part(module)]
    against = {name for name in OURS[module] if part(name) != part(module) and RANK[part(name)] >= rank}
    assert not against
    outside = {name.split(".")[0] for name in IMPORTS[module]}
    assert part(module) == "parity" or "torch" not in outside
    assert "flax.nnx" not in IMPORTS[module]
    if part(module) in WITHOUT_JAX or module.endswith(".flags"):
        assert not outside & {"jax", "flax", "optax"}


def test_no_file_imports_itself_through_others():
    left = dict(OURS)
    while ready := [module for module, needs in left.items() if not needs & set(left)]:
        left = {module: needs for module, needs in left.items() if module not in ready}
    assert not left, f"modules that import each other, or stand on such: {sorted(left)}"


@pytest.mark.parametrize("module", sorted(MODULES))
def test_files_are_short(module):
    if not module.endswith(".flags") and module != "cmig_jax.config":
        assert len(MODULES[module].read_text().splitlines()) <= LONGEST


def test_networks_are_named_in_their_own_folder_alone():
    """Besides, presets choose them, and comparisons and benchmarks against the PyTorch reference name them."""
    named = {m for m, path in MODULES.items() if any(n in path.read_text() for n in ("models.cmignet", "CMIGNetFlags"))}
    assert {part(m) for m in named - {"cmig_jax.commands.parity"}} <= {"models", "parity", "bench", "presets"}


def test_every_folder_is_installed():
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    assert listed == {m for m, path in MODULES.items() if path.name == "__init__.py"}


def test_every_library_is_declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = {re.split(r"[<>=;\[ ]", line)[0].lower() for line in project["dependencies"]}
    extras = {re.split(r"[<>=;\[ ]", line)[0].lower() for lines in project["optional-dependencies"].values() for line in lines}
    used = {name.split(".")[0] for names in IMPORTS.values() for name in names} - set(sys.stdlib_module_names) - {"cmig_jax", "configs"}
    packages = {DISTRIBUTION.get(name, name).lower() for name in used}
    assert packages <= declared | extras
    assert packages & extras <= {"torch", "safetensors", "open3d", "kiss-matcher", "laspy", "lxml", "networkx"}, (
        "imported where they are installed"
    )
