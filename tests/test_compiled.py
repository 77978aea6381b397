"""The kernel cache: what its entries depend on, and that nothing fails where they are damaged or can't be kept."""

import ast
import errno
import gc
import importlib
import pickle
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core import event

import khop_env.compiled as module
from khop_env.compiled import compiled

ROOT = Path(module.__file__).parents[1]


def kernel(x):
    return x + 1.0


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where the kernels of a test are kept."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "kernels"))
    module._announce.cache_clear()
    module._say.cache_clear()
    return tmp_path / "kernels"


def found() -> bool:
    """True if `kernel`, decorated anew as a new process does, is read from the cache; its result is right anyway."""
    function = compiled(kernel)
    assert function(1.0) == 2.0
    return sum(function.stats.cache_hits.values()) == 1


def entry(folder: Path) -> Path:
    """The one file that is kept."""
    (path,) = (path for path in folder.rglob("*") if path.is_file())
    return path


def test_a_kernel_is_compiled_once(folder, capsys):
    assert not found()
    assert capsys.readouterr().err == (
        "khop_env: compiling what is used for the first time on this machine (some seconds; the result is kept for "
        "later runs) ...\n"
    )
    assert found()
    compiled(kernel).recompile()
    assert capsys.readouterr().err == ""


def damages(whole: bytes) -> dict[str, bytes]:
    """A file that was cut off, overwritten, or comes from elsewhere."""
    middle = len(whole) // 2
    return {
        "empty": b"",
        "garbage": b"garbage" * 100,
        "pickled": pickle.dumps("0.0.0") + pickle.dumps((b"stamp", {})),
        "longer": whole + b"\0",
        "zeros": whole[:middle] + bytes(2000) + whole[middle + 2000 :],
        **{f"cut at {cut}": whole[:cut] for cut in (1, 31, 32, 33, 100, middle, len(whole) - 1)},
    }


def test_a_damaged_file_is_compiled_again_and_replaced(folder):
    found()
    path, whole = entry(folder), entry(folder).read_bytes()
    for name, damaged in damages(whole).items():
        path.write_bytes(damaged)
        assert not found(), name
        assert found(), name
        assert entry(folder) == path, name


def test_no_byte_of_a_file_can_be_missing_or_wrong(tmp_path):
    """Machine code with a wrong byte would give wrong numbers, or end the process."""
    files, key = module._Files(tmp_path, kernel), ("signature", "processor")
    files.save(key, list(range(300)))
    path, whole = entry(tmp_path), entry(tmp_path).read_bytes()
    for place, value in enumerate(whole):
        path.write_bytes(whole[:place])
        assert files.load(key) is None
        path.write_bytes(whole[:place] + bytes([value ^ 1]) + whole[place + 1 :])
        assert files.load(key) is None
    path.write_bytes(whole)
    assert files.load(key) == list(range(300))


@pytest.mark.parametrize("content", [pickle.dumps("no compiled code"), pickle.dumps(())[:-1], b""])
def test_content_that_cannot_be_used_is_compiled_again(folder, monkeypatch, content):
    """Even where its digest is right."""
    with monkeypatch.context() as patched:
        patched.setattr(module.pickle, "dumps", lambda data, protocol: content)
        found()
    assert entry(folder).read_bytes().endswith(content)
    assert not found()
    assert found()


@pytest.mark.parametrize("what", ["numba", "kernels", "file", "key"])
def test_entries_of_another_version_are_none(tmp_path, monkeypatch, what):
    files = module._Files(tmp_path, kernel)
    files.save("key", 1)
    assert files.load("key") == 1
    if what == "numba":
        monkeypatch.setattr(numba, "__version__", "0.0")
    elif what == "kernels":
        monkeypatch.setattr(module, "_text_of_kernels", lambda: b"another text")
    elif what == "file":
        monkeypatch.setattr(module, "_text_of", lambda path: b"another text")
    assert module._Files(tmp_path, kernel).load("another key" if what == "key" else "key") is None


def test_without_any_folder_kernels_still_compile(capsys):
    module._announce.cache_clear()
    namespace = {}
    exec("def kernel(x): return x + 1.0", namespace)  # Numba has no folder for what isn't in a file
    assert compiled(namespace["kernel"])(1.0) == 2.0
    assert compiled(namespace["kernel"])(1) == 2.0
    assert capsys.readouterr().err == (
        "khop_env: compiling what is used for the first time on this machine (some seconds, in every process, since no "
        "folder can be written) ...\n"
    )


def test_a_numba_with_other_names_inside_compiles_in_memory(folder, monkeypatch):
    """And not with its own cache, which doesn't know of other files."""
    monkeypatch.setattr("numba.core.caching.FunctionCache._cache_file", property(), raising=False)
    assert not found()
    assert not found()
    assert compiled(kernel).stats.cache_path is None


def test_a_full_disk_costs_time_and_not_the_result(folder, monkeypatch, capsys):
    def refuse(self, data):
        raise OSError(errno.ENOSPC, "No space left on device", str(self))

    monkeypatch.setattr(Path, "write_bytes", refuse)
    function = compiled(kernel)
    assert function(1.0) == function(np.float32(1.0)) == function(1) == 2.0
    _, warning = capsys.readouterr().err.splitlines()
    assert warning.startswith("khop_env: compiled code can't be kept, so that later runs compile again (No space left")
    assert not found()
    assert not [path for path in folder.rglob("*") if path.is_file()]


def test_a_folder_that_is_gone_costs_time_and_not_the_result(folder, capsys):
    function = compiled(kernel)
    shutil.rmtree(folder)
    folder.write_text("a file")
    assert function(1.0) == 2.0
    assert "compiled code can't be kept" in capsys.readouterr().err


USER = """
import sys
from package.second import call
print(call(1.0), sum(call.stats.cache_hits.values()))
"""


def test_a_change_in_another_file_is_seen(tmp_path):
    """A kernel pasted into another one, and the order of a named tuple's fields; two processes compile at once."""
    package = tmp_path / "package"
    package.mkdir()
    shutil.copy(module.__file__, package)
    (package / "__init__.py").touch()
    first = "from package.compiled import inlined\n@inlined\ndef add(x): return x + 1.0\n"
    fields = "from typing import NamedTuple\nclass Pair(NamedTuple):\n    a: float\n    b: float\n"
    second = (
        "from package.compiled import compiled\nfrom package.first import add\nfrom package.third import Pair\n"
        "@compiled\ndef inner(x, pair): return add(x) + 10.0 * pair.a\n"
        "def call(x): return inner(x, Pair(a=1.0, b=2.0))\ncall.stats = inner.stats\n"
    )
    for name, text in {"first": first, "second": second, "third": fields}.items():
        (package / f"{name}.py").write_text(text)

    def run(processes=1):
        started = [
            subprocess.Popen([sys.executable, "-c", USER], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
            for _ in range(processes)
        ]
        return [process.communicate()[0].split() for process in started]

    assert [value for value, _ in run(2)] == ["12.0", "12.0"]
    assert run() == [["12.0", "1"]]
    (package / "first.py").write_text(first.replace("1.0", "2.0"))
    assert run() == [["13.0", "0"]]
    (package / "third.py").write_text(re.sub("a: float(.*)b: float", r"b: float\1a: float", fields, flags=re.DOTALL))
    assert run() == [["13.0", "0"]]
    assert run() == [["13.0", "1"]]


def kernels(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    """Functions below one of the decorators."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            names = {decorator.id for decorator in node.decorator_list if isinstance(decorator, ast.Name)}
            if names & {"compiled", "inlined", "pasted"}:
                yield node


def test_kernels_take_no_constant_from_files_that_entries_do_not_depend_on():
    """Numba freezes a constant into the code that is kept, so the file that it comes from has to count."""
    texts = {path: path.read_bytes() for name in ("khop_env", "agents") for path in (ROOT / name).rglob("*.py")}
    counted = {path for path, text in texts.items() if any(mark in text for mark in module._MARKS)}
    seen = 0
    for path in counted:
        tree = ast.parse(texts[path])
        origin = {
            alias.asname or alias.name: (str(node.module), alias.name)
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith(("khop_env", "agents"))
            for alias in node.names
        }
        for kernel in kernels(tree):
            seen += 1
            for node in (node for part in kernel.body for node in ast.walk(part)):
                if isinstance(node, ast.Name) and node.id in origin:
                    room, name = origin[node.id]
                    is_kernel = hasattr(getattr(importlib.import_module(room), name), "py_func")
                    source = ROOT.joinpath(*room.split(".")).with_suffix(".py")
                    assert is_kernel or source in counted, f"{path.name}: {kernel.name} reads {name} from {room}"
    assert seen > 30


@pytest.mark.parametrize("function", [module.compiled, module.inlined, module.pasted])
def test_division_by_zero_is_ieee(function):
    @module.compiled
    def divide(a, b):
        return a / b

    assert divide(1.0, 0.0) == np.inf
    assert function(kernel)(1.0) == 2.0


def test_python_collects_no_garbage_while_kernels_compile():
    """And does again afterwards, where it did before, even if a kernel can't be compiled."""
    seen = []

    class Seen(event.Listener):
        def on_start(self, _):
            seen.append(gc.isenabled())

        on_end = on_start

    @compiled
    def inner(x):
        return x + 1.0

    @compiled
    def outer(x):
        return inner(x)

    @compiled
    def wrong(x):
        return inner(x).nothing

    with event.install_listener("numba:compile", Seen()):
        outer(1.0)
    assert seen
    assert not any(seen[:-1])  # both begin, then the inner one ends, unless an earlier run has kept it
    assert gc.isenabled()
    with pytest.raises(numba.TypingError):
        wrong(1)
    assert gc.isenabled()
    gc.disable()
    try:
        outer(1)
        assert not gc.isenabled()
    finally:
        gc.enable()
