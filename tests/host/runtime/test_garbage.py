"""Pauses of the garbage collector."""

import gc
import threading
import weakref

import jax.numpy as jnp
import pytest

from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.garbage import collector_paused, garbage_frozen


class _Cycle:
    """An object that only the collector frees."""

    def __init__(self) -> None:
        self.itself = self


@pytest.fixture(autouse=True)
def _enabled():
    was = gc.isenabled()
    gc.enable()
    yield
    (gc.enable if was else gc.disable)()


def test_collects_nothing_within_a_pause_and_goes_on_after_it():
    thresholds = gc.get_threshold()
    gc.set_threshold(10, 1, 1)
    try:
        with collector_paused():
            lost = weakref.ref(_Cycle())
            kept = [[] for _ in range(1000)]  # more than the threshold
            assert lost() is not None
        kept += [[] for _ in range(1000)]
        assert lost() is None
    finally:
        gc.set_threshold(*thresholds)


def test_goes_on_after_the_last_of_several_pauses():
    with collector_paused():
        with collector_paused():
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled()


def test_goes_on_after_an_error():
    with pytest.raises(ValueError, match="of the work"), collector_paused():
        raise ValueError("of the work")
    assert gc.isenabled()


def test_leaves_a_collector_that_was_disabled_so():
    gc.disable()
    with collector_paused():
        pass
    assert not gc.isenabled()


def test_pauses_of_threads_overlap():
    inside, leave = threading.Event(), threading.Event()

    def pause() -> None:
        with collector_paused():
            inside.set()
            leave.wait(10)

    thread = threading.Thread(target=pause)
    thread.start()
    assert inside.wait(10)
    with collector_paused():
        pass
    assert not gc.isenabled()  # the thread is in its pause still
    leave.set()
    thread.join(10)
    assert gc.isenabled()


def test_tracing_is_paused_and_calling_is_not():
    states = []

    @compiled(when="first use")
    def double(x):
        states.append(gc.isenabled())
        return 2 * x

    assert double(jnp.ones(3)).tolist() == [2, 2, 2]
    assert set(states) == {False}
    assert gc.isenabled()


class TestFrozen:
    @pytest.fixture(autouse=True)
    def _as_it_was(self):
        had = gc.get_freeze_count() > 0
        gc.unfreeze()
        yield
        gc.collect()
        (gc.freeze if had else gc.unfreeze)()

    def test_thaws_what_it_has_frozen(self):
        lost = _Cycle()
        with garbage_frozen():
            alive = weakref.ref(lost)
            del lost
            gc.collect()
            assert alive() is not None
        gc.collect()
        assert alive() is None

    def test_leaves_frozen_what_a_program_has_frozen(self):
        gc.collect()
        gc.freeze()
        before = gc.get_freeze_count()
        with garbage_frozen():
            pass
        assert gc.get_freeze_count() >= before
