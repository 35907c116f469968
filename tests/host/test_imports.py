"""What is imported when: nothing heavy by `import jaxslam` or `jaxslam --help`, nothing POSIX-only by any module."""

import ast
import json
import pkgutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import jaxslam

PACKAGE = Path(jaxslam.__file__).parent
HEAVY = ("jax", "numpy", "scipy", "matplotlib", "onnxruntime", "cv2", "equinox", "tyro", "rich")
LATE = ("scipy", "matplotlib", "onnxruntime")
POSIX_ONLY = ("fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty")


def loaded_after(code: str) -> set[str]:
    """The top-level modules that a new process has loaded after some code, which must warn of nothing."""
    code = f"{code}\nimport json, sys\nprint(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return set(json.loads(done.stdout.splitlines()[-1]))


def index() -> tuple[dict[str, str], dict[str, str]]:
    """The module of each public name, as type checkers read it from `__init__`, and as it is at run time."""
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (typed,) = (node for node in tree.body if isinstance(node, ast.If))
    of_types = {
        name.name: node.module or "" for node in typed.body if isinstance(node, ast.ImportFrom) for name in node.names
    }
    return of_types, {name: getattr(jaxslam, "_MODULE_OF")[name] for name in jaxslam.__all__}  # noqa: B009 - private


def test_importing_jaxslam_loads_nothing_heavy() -> None:
    assert not loaded_after("import jaxslam") & set(HEAVY)


def test_the_tracker_loads_late_what_is_used_late() -> None:
    assert not loaded_after("from jaxslam import Slam, track_step, load_config") & set(LATE)


CALL = """
import contextlib, io
from jaxslam.cli import main
said = io.StringIO()
with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), contextlib.suppress(SystemExit):
    main({words!r})
assert "usage: jaxslam" in said.getvalue() or "did you mean 'run'?" in said.getvalue()
"""


@pytest.mark.parametrize("words", [["--help"], ["models", "--help"], ["rnu"], []])
def test_listing_commands_loads_nothing_heavy(words: list[str]) -> None:
    assert not loaded_after(CALL.format(words=words)) & set(HEAVY)


@pytest.mark.parametrize(
    "name", ["demo", "run", "eval", "doctor", "export", "models list", "models get", "models check", "data list"]
)
def test_help_of_a_command_loads_no_jax(name: str) -> None:
    loaded = loaded_after(CALL.format(words=[*name.split(), "--help"]))
    assert "tyro" in loaded
    assert not loaded & {"jax", *LATE}


def test_public_names_are_the_same_for_type_checkers() -> None:
    of_types, at_run_time = index()
    assert of_types == at_run_time
    assert dir(jaxslam) == sorted([*of_types, "__version__"])


def test_no_submodule_hides_a_public_name() -> None:
    submodules = {module.name for module in pkgutil.iter_modules(jaxslam.__path__)}
    assert not submodules & set(jaxslam.__all__)


def test_unknown_name_is_said() -> None:
    with pytest.raises(AttributeError, match="module 'jaxslam' has no attribute 'Slim'"):
        _ = getattr(jaxslam, "Slim")  # noqa: B009 - type checkers know that it is not there


def test_works_without_modules_of_posix() -> None:
    """As on Windows: whatever of jaxslam asks for one of them gets none. Other packages look for themselves."""
    blocked = f"""
import builtins
real = builtins.__import__
def imported(name, globals=None, *rest, **more):
    if name in {POSIX_ONLY!r} and str((globals or {{}}).get("__name__")).startswith("jaxslam"):
        raise ModuleNotFoundError(f"No module named '{{name}}'", name=name)
    return real(name, globals, *rest, **more)
builtins.__import__ = imported
import jaxslam, jaxslam.cli, jaxslam.results, jaxslam.commands.run, jaxslam.commands.version
for name in jaxslam.__all__:
    getattr(jaxslam, name)
"""
    assert "jaxslam.machine" in loaded_after(blocked)


def imports_of_modules() -> Iterator[tuple[str, str]]:
    """Every file with every module that it imports when it is imported itself."""
    for file in sorted([*PACKAGE.rglob("*.py"), *(PACKAGE.parent / "kernels" / "jaxslam_kernels").rglob("*.py")]):
        waiting: list[ast.AST] = [ast.parse(file.read_text(encoding="utf-8"))]
        while waiting:
            node = waiting.pop()
            if isinstance(node, ast.Import):
                yield from ((file.name, name.name) for name in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module:
                yield file.name, node.module
            elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
                waiting += ast.iter_child_nodes(node)


def test_no_file_imports_a_module_of_posix() -> None:
    imports = list(imports_of_modules())
    assert ("cli.py", "logging") in imports
    assert not [found for found in imports if found[1].partition(".")[0] in POSIX_ONLY]
