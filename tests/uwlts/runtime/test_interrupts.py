"""Interrupts that fall into callbacks."""

import time
import weakref

import pytest

from uwlts.runtime.interrupts import interrupts_kept


def test_an_interrupt_within_a_callback_is_not_lost(capsys: pytest.CaptureFixture):
    """Python reports and drops what a weak reference's callback raises; Ctrl-C may fall into one at any time."""

    def callback(_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), interrupts_kept():
        thing: set[int] = set()
        reference = weakref.ref(thing, callback)
        del thing
        time.sleep(1)
    assert reference() is None
    assert capsys.readouterr().err == ""
