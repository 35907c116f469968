"""What is imported when: nothing heavy by `import jaxslam` or `jaxslam --help`, nothing POSIX-only by any module."""

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

import jaxslam
from jaxslam.cli.command_table import COMMANDS

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


HELP_OF_ALL = """
import contextlib, io, json, sys
from jaxslam.cli import main
loaded, seen = {{}}, set()
for words in {commands!r}:
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        main([*words, "--help"])
    assert "usage: jaxslam " + " ".join(words) in " ".join(said.getvalue().split()), words
    loaded[" ".join(words)] = sorted(set(sys.modules).intersection({late!r}) - seen)
    seen.update(sys.modules)
print(json.dumps(loaded), file=sys.stderr)
"""


def test_help_of_a_command_loads_no_jax() -> None:
    """One process prints the help of all commands, and reports what each loads that those before it did not."""
    code = HELP_OF_ALL.format(commands=[command.words for command in COMMANDS], late=("jax", "tyro", *LATE))
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    loaded = json.loads(done.stderr)
    assert set(loaded) == {command.name for command in COMMANDS}
    assert {module for modules in loaded.values() for module in modules} == {"tyro"}, loaded


INDEXES = sorted(PACKAGE.rglob("__init__.pyi"))


def names_in(stub: Path) -> set[str]:
    """The names that an index promises to type checkers."""
    body = ast.parse(stub.read_text(encoding="utf-8")).body
    return {name.asname or name.name for node in body if isinstance(node, ast.ImportFrom) for name in node.names}


@pytest.mark.parametrize("stub", INDEXES, ids=lambda stub: stub.parent.name)
def test_index_holds_what_it_promises(stub: Path) -> None:
    """Every name is there, is what its module defines, and no submodule hides it."""
    package = import_module(".".join(["jaxslam", *stub.parent.relative_to(PACKAGE).parts]))
    assert set(dir(package)) == names_in(stub)
    for name in names_in(stub):
        assert not isinstance(getattr(package, name), ModuleType), name


def test_importing_a_package_loads_none_of_its_modules() -> None:
    packages = [".".join(["jaxslam", *stub.parent.relative_to(PACKAGE).parts]) for stub in INDEXES]
    assert "jaxslam.slam" in packages
    assert not loaded_after(f"import {', '.join(packages)}") & set(HEAVY)


def test_unknown_name_is_said() -> None:
    with pytest.raises(AttributeError, match="No jaxslam attribute Slim"):
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
import jaxslam, jaxslam.cli.entry_point, jaxslam.results.run_results, jaxslam.cli.run, jaxslam.cli.version
for name in jaxslam.__all__:
    getattr(jaxslam, name)
"""
    assert "jaxslam.runtime.machine" in loaded_after(blocked)


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
    assert ("entry_point.py", "logging") in imports
    assert not [found for found in imports if found[1].partition(".")[0] in POSIX_ONLY]
