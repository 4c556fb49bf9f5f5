"""Interrupts in callbacks and in libraries."""

import time
import weakref

import drjit as dr
import mitsuba as mi
import pytest

from uwlts.runtime.progress import preserve_interrupts


def test_an_interrupt_within_a_callback_is_not_lost(capsys: pytest.CaptureFixture):
    """Python only reports exceptions in callbacks of weak references; Ctrl-C may arrive in such a callback."""

    def callback(_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), preserve_interrupts():
        thing: set[int] = set()
        reference = weakref.ref(thing, callback)
        del thing
        time.sleep(1)
    assert reference() is None
    assert capsys.readouterr().err == ""


def test_an_interrupt_within_a_recorded_loop_is_not_lost():
    """Dr.Jit raises a RuntimeError for any exception in a loop's body."""

    def body(i: mi.UInt32) -> tuple[mi.UInt32]:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), preserve_interrupts():
        dr.while_loop((mi.UInt32([0, 1]),), lambda i: i < 3, body)


def test_an_error_within_a_recorded_loop_is_raised_unchanged():
    with pytest.raises(RuntimeError, match="encountered an exception"), preserve_interrupts():
        dr.while_loop((mi.UInt32([0, 1]),), lambda i: i < 3, lambda i: (i + [],))
