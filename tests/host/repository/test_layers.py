"""The packages of jaxslam lie in layers: each imports only those before it, and nothing lies beside them."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
LAYERS = [
    "errors",
    "io",
    "config",
    "runtime",
    "geometry",
    "sensors",
    "trajectory",
    "dynamics",
    "semantics",
    "datasets",
    "worlds",
    "tracking",
    "learning",
    "features",
    "masks",
    "map",
    "loop_closing",
    "mapping",
    "dense",
    "slam",
    "calibration",
    "visualization",
    "results",
    "benchmark",
    "cli",
]
"""In the order of dependence: the kernels come before all of them."""


def package_of(module: str) -> str:
    """The package of jaxslam that a module is in; `jaxslam_kernels` for a kernel, `jaxslam` for its index."""
    first, *rest = module.split(".")
    return rest[0] if first == "jaxslam" and rest else first


def imports() -> Iterator[tuple[str, str, str]]:
    """Every import of a module of ours: where it stands, from which package, and of which."""
    for base, name in ((ROOT / "jaxslam", "jaxslam"), (ROOT / "kernels" / "jaxslam_kernels", "jaxslam_kernels")):
        for path in sorted(base.rglob("*.py")):
            source = package_of(".".join([name, *path.relative_to(base).with_suffix("").parts]))
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ImportFrom) and node.module:
                    modules = [
                        f"{node.module}.{alias.name}" if node.module == "jaxslam" else node.module
                        for alias in node.names
                    ]
                elif isinstance(node, ast.Import):
                    modules = [alias.name for alias in node.names]
                else:
                    continue
                for module in modules:
                    if module.split(".")[0] in {"jaxslam", "jaxslam_kernels"}:
                        yield f"{path.relative_to(ROOT)}:{node.lineno}", source, package_of(module)


def test_every_package_has_its_layer() -> None:
    here = {
        path.stem for path in (ROOT / "jaxslam").iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert here == {"__init__", "__main__", *LAYERS}


def test_imports_go_down_only() -> None:
    found = list(imports())
    assert len(found) > 1000
    order = {
        name: place for place, name in enumerate(["jaxslam_kernels", "__version__", *LAYERS, "__init__", "__main__"])
    }
    assert not [(place, source, of) for place, source, of in found if order[of] > order[source]]


@pytest.mark.parametrize("folder", ["jaxslam", "kernels/jaxslam_kernels"])
def test_a_package_says_what_it_is(folder: str) -> None:
    """An index holds a docstring and names, no code: that is in modules one can look up."""
    for path in (ROOT / folder).rglob("__init__.py"):
        if path.parent.name == "adapters":  # its table of adapters
            continue
        body = ast.parse(path.read_text(encoding="utf-8")).body
        assert ast.get_docstring(ast.Module(body, [])), path
        assert not [node for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)], path
