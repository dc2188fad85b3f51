"""Imports point one way: from the scripts down to geometry, data, config and structs, and never in a circle."""

import ast
from collections.abc import Collection
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TOP = {
    "align",
    "registration",
    "export",
    "evaluation",
    "baselines",
    "parity",
    "report",
    "configs",
    "bench",
    "experiments",
    "train",
    "evaluate",
    "cmig_jax",
}
BELOW = {
    "allocator": set(),
    "compilation": {"allocator"},
    "config": set(),
    "structs": set(),
    "data": {"config"},
    "geometry": {"structs"},
    "nn": {"structs", "geometry"},
    "losses": {"structs", "geometry", "config"},
    "metrics": {"structs", "geometry"},
    "weights": {"config"},
    "training": {"compilation", "config", "structs", "data", "geometry", "nn", "losses", "metrics"},
}
EVERYTHING = set(BELOW) | TOP
FORBIDDEN = {"config": {"jax", "flax"}, "data": {"jax", "flax"}, "geometry": {"flax"}}


def modules() -> dict[str, Path]:
    """Name every file of ours; a folder's `__init__` is the folder."""
    paths = [path for folder in ("cmig_jax", "configs", "bench") for path in (ROOT / folder).rglob("*.py")]
    paths += [ROOT / name for name in ("train.py", "evaluate.py") if (ROOT / name).exists()]
    return {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in paths}


def imports(path: Path, ours: Collection[str]) -> set[str]:
    """List the modules that a file imports, anywhere in it; `from package import module` is that module."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in ours or name == "flax.nnx" else str(node.module) for name in names}
    return found


def room(module: str) -> str:
    """Return the part of the house a module belongs to."""
    return module.removeprefix("cmig_jax.").split(".")[0]


MODULES = modules()
IMPORTS = {module: imports(path, MODULES) for module, path in MODULES.items()}
OURS = {module: names & set(MODULES) for module, names in IMPORTS.items()}


@pytest.mark.parametrize("module", sorted(IMPORTS))
def test_direction(module):
    allowed = BELOW.get(room(module), EVERYTHING) | {room(module)} | ({"config"} if module == "cmig_jax.nn.build" else set())
    assert {room(name) for name in OURS[module]} <= allowed
    outside = {name.split(".")[0] for name in IMPORTS[module]}
    assert not outside & FORBIDDEN.get(room(module), set())
    assert room(module) in EVERYTHING, "a new room: say here what it may import"
    assert room(module) == "parity" or "torch" not in outside
    assert not any(name.startswith("flax.nnx") for name in IMPORTS[module])


def test_no_circles():
    left = dict(OURS)
    while ready := [module for module, needs in left.items() if not needs & set(left)]:
        left = {module: needs for module, needs in left.items() if module not in ready}
    assert not left, f"modules that import each other, or stand on such: {sorted(left)}"
