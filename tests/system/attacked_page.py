"""A page in a process of its own, with as many open files as systems usually allow."""

import resource
import sys

from uwlts.desk.guided_screen import BoardScreen
from uwlts.desk.laser_switch import LaserSwitch
from uwlts.desk.server import DeskServer
from uwlts.desk.shown_state import Board
from uwlts.hardware.grbl import GrblStage

USUAL_FILES = 1024


def serve_page(port: str) -> None:
    """Serve a page with the stage at a port until a line arrives, and print the lines of its board after another."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (USUAL_FILES, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    board = Board("attacked")
    screen = BoardScreen(board, LaserSwitch(board, lambda: screen.laser_off()))
    with DeskServer(board, port=0, switch=screen.switch) as server:
        with GrblStage(port) as stage:
            screen.set_stage(stage)
            print(server.address, server.operator_address, screen.switch._process.pid, flush=True)
            sys.stdin.readline()
            screen.set_stage(None)
        print("closed", flush=True)
        sys.stdin.readline()
    print(*(line.text for line in board.lines()), sep="\n", flush=True)
