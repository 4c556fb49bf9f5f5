"""A guided calibration of the desk in a process of its own: its log on standard output, answers on standard input."""

import sys
import threading
from contextlib import closing
from pathlib import Path

from uwlts.desk.guided_plan import load_guided_plan
from uwlts.desk.instrument import Instrument
from uwlts.desk.shown_state import Board


def guide_calibration(plan: str, out: str) -> None:
    """Carry out a plan, and print the log while it grows."""
    board, done, printed = Board("guided"), threading.Event(), -1
    with closing(Instrument(board)) as device:
        device.ask(device.calibrate, load_guided_plan(Path(plan)), Path(out), resume=False, overwrite=False)
        device.ask(done.set)
        threading.Thread(target=lambda: [device.answer(line.strip()) for line in sys.stdin], daemon=True).start()
        ended = False
        while not ended:
            ended = done.wait(0.05)
            for line in board.lines(printed):
                print(line.text, flush=True)
                printed = line.number
