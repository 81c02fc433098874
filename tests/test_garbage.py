"""Python's garbage collection during imports and compilations."""

import gc

import pytest

from bounce_mjx.garbage import no_garbage_collection
from bounce_mjx.interrupt import interruptible_imports


@pytest.mark.parametrize("suspended", [no_garbage_collection, interruptible_imports])
def test_the_search_for_garbage_goes_on_afterwards_if_it_was_on(suspended):
    assert gc.isenabled()
    with pytest.raises(ImportError), suspended():
        assert not gc.isenabled()
        with suspended():
            pass
        assert not gc.isenabled()
        raise ImportError
    assert gc.isenabled()
    gc.disable()
    try:
        with suspended():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
