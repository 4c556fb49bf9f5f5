"""The instrument behind the desk: live images with the laser need somebody who sees them."""

from contextlib import closing

from uwlts.desk import instrument
from uwlts.desk.instrument import Instrument
from uwlts.desk.shown_state import Board


def test_live_images_with_the_laser_end_without_an_operators_page(monkeypatch):
    board = Board("test")
    with closing(Instrument(board)) as device:
        monkeypatch.setattr(device, "_switches_laser", lambda: True)
        device.attend()
        device.light = "laser"
        device._show_preview()
        assert device.light == "laser"
        monkeypatch.setattr(instrument, "_UNATTENDED_S", -1.0)
        device._show_preview()
        assert device.light is None
        device.light = "lamp"
        device._show_preview()
        assert device.light == "lamp"
