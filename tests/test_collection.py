"""The garbage collector goes on after a pause, whatever happened in it."""

import gc

import pytest

from khop_env.collection import collection_paused


@collection_paused()
def fail():
    raise ValueError(f"running: {gc.isenabled()}")


def test_it_goes_on_after_an_error():
    with pytest.raises(ValueError, match="running: False"):
        fail()
    assert gc.isenabled()


def test_one_that_does_not_run_is_left_alone():
    gc.disable()
    try:
        with collection_paused():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
