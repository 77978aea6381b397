"""The kernel cache: what it is keyed by, and that nothing fails where it can't be kept."""

import numpy as np
import pytest

import khop_env.compiled as module
from khop_env.compiled import compiled


def kernel(x):
    return x + 1.0


def test_without_any_folder_kernels_still_compile(monkeypatch, capsys):
    def refuse(self, function):
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(module.FunctionCache, "__init__", refuse)
    module._announce.cache_clear()
    assert compiled(kernel)(1.0) == 2.0
    assert "compiling" in capsys.readouterr().err


def test_a_full_disk_costs_time_and_not_the_result(monkeypatch):
    def refuse(self, key, data):
        raise OSError("no space left on device")

    monkeypatch.setattr(module._KernelFile, "save", refuse)
    function = compiled(kernel)
    assert function(np.float32(1.0)) == 2.0
    assert not function._cache._enabled


def test_entries_depend_on_the_text_of_all_kernels(monkeypatch):
    before = compiled(kernel)._cache._cache_file._source_stamp
    monkeypatch.setattr(module, "_fingerprint", lambda: "another text")
    assert compiled(kernel)._cache._cache_file._source_stamp != before


@pytest.mark.parametrize("function", [module.compiled, module.inlined])
def test_division_by_zero_is_ieee(function):
    @module.compiled
    def divide(a, b):
        return a / b

    assert divide(1.0, 0.0) == np.inf
    assert function(kernel)(1.0) == 2.0
