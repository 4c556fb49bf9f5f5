"""The board of a page: its log, progress, and the picture of an image."""

import threading
import time

import cv2
import numpy as np
import pytest

from uwlts.desk.shown_state import KEPT_LINES, Board, Picture

FULL = 255


# The log


def test_lines_are_numbered_and_sent_once():
    board = Board("test")
    assert board.lines() == []
    before = time.time()
    board.say("first")
    board.say("second", "warning")
    first, second = board.lines()
    assert [(line.number, line.kind, line.text) for line in (first, second)] == [
        (0, "note", "first"),
        (1, "warning", "second"),
    ]
    assert before <= first.time_s <= second.time_s <= time.time()
    board.say("third", "error")
    assert [line.text for line in board.lines(second.number)] == ["third"]
    assert board.lines(2) == []


def test_old_lines_are_forgotten_and_numbers_go_on():
    board = Board("test")
    for number in range(KEPT_LINES + 50):
        board.say(str(number))
    kept = board.lines()
    assert len(kept) == KEPT_LINES
    assert [line.number for line in kept] == list(range(50, KEPT_LINES + 50))
    assert all(line.text == str(line.number) for line in kept)
    # A late reader sees the remaining lines.
    assert board.lines(10) == kept and len(board.lines(KEPT_LINES)) == 49


def test_lines_of_several_threads_have_numbers_of_their_own():
    board = Board("test")

    def talk() -> None:
        for _ in range(100):
            board.say("word")

    talking = [threading.Thread(target=talk) for _ in range(5)]
    for thread in talking:
        thread.start()
    for thread in talking:
        thread.join()
    assert [line.number for line in board.lines()] == list(range(500))


# Progress


def test_the_remaining_time_follows_from_the_progress():
    board = Board("test")
    board.phase("recording")
    assert board.progress.phase == "recording" and board.progress.total is None and board.progress.left_s is None
    began = time.monotonic()
    time.sleep(0.2)
    board.count(2, 10)
    took = time.monotonic() - began
    progress = board.progress
    assert (progress.phase, progress.done, progress.total) == ("recording", 2, 10)
    # 8 further images at the rate of 2 in at least 0.2 s.
    assert 8 * 0.2 / 2 <= progress.left_s <= 8 * took / 2 + 1e-3


def test_progress_before_a_phase_does_not_count_for_its_pace():
    board = Board("test")
    board.phase("recording")
    began = time.monotonic()
    time.sleep(0.2)
    board.count(92, 100, before=90)
    took = time.monotonic() - began
    assert 8 * 0.2 / 2 <= board.progress.left_s <= 8 * took / 2 + 1e-3
    for done in (90, 89):
        board.count(done, 100, before=90)
        assert board.progress.left_s is None
    board.count(100, 100, before=90)
    assert board.progress.left_s == 0.0


def test_another_phase_begins_anew():
    board = Board("test")
    board.phase("recording")
    board.count(5, 10)
    board.phase("checking", busy=False)
    assert (board.progress.phase, board.progress.done, board.progress.total) == ("checking", 0, None)
    assert board.progress.left_s is None


# Pictures


def shown(image: np.ndarray, **options: object) -> np.ndarray:
    """The picture as a browser decodes it (H, W, 3): blue, green, red."""
    picture = Picture(image, full_dn=FULL, caption="test", **options)
    return cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_COLOR).astype(int)


def test_dark_images_are_brightened():
    image = np.repeat(np.array([0, 16, 64, 255], np.uint8), 40)[None].repeat(40, axis=0)
    grey = shown(image)[20, 20::40]
    # The square root of the fraction of full scale; a JPEG is accurate to some grey values.
    np.testing.assert_allclose(grey, np.array([[0], [63.9], [127.7], [255]]).repeat(3, axis=1), atol=3)


@pytest.mark.parametrize("full", [255, 4095])
def test_brighter_than_the_full_scale_is_white(full):
    image = np.full((32, 32), 60000, np.uint16)
    picture = Picture(image, full_dn=full, caption="test")
    assert cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).min() == 255


def test_the_stripe_is_marked_where_it_lies():
    image = np.zeros((200, 300), np.uint8)
    column = np.arange(300.0)
    stripe = np.column_stack([column, np.full(300, 80.4)])
    marked = shown(image, stripe=stripe)
    red = marked[..., 2] - marked[..., 0] > 60
    assert np.flatnonzero(red.any(axis=1)).tolist() and np.abs(np.flatnonzero(red.any(axis=1)) - 80).max() <= 2
    assert red[78:83].any(axis=0).all()
    assert not (shown(image)[..., 2] > 30).any()


def test_points_are_circled_where_they_lie():
    marked = shown(np.zeros((200, 300), np.uint8), points=np.array([[50.2, 60.0], [250.0, 140.3]]))
    green = marked[..., 1] - marked[..., 2] > 60
    for u, v in ((50, 60), (250, 140)):
        # Pixels around the point, not the point itself.
        assert green[v - 5 : v + 6, u - 5 : u + 6].any() and not green[v, u]
        green[v - 8 : v + 9, u - 8 : u + 9] = False
    assert not green.any()


def test_large_images_are_shown_smaller_with_marks_in_their_places():
    image = np.zeros((1500, 4000), np.uint16)
    edge = np.array([[3999.0, 1499.0], [0.0, 0.0], [4005.0, -3.0]])
    marked = shown(image, stripe=edge, points=np.array([[2000.0, 800.0]]))
    assert marked.shape == (375, 1000, 3)
    lit = marked.max(axis=2) > 30
    # Points beyond the edge are marked at the edge.
    assert lit[370:, 995:].any() and lit[:5, :5].any() and lit[:5, 995:].any() and not lit[370:, :5].any()
    green = marked[..., 1] - marked[..., 2] > 60
    assert np.abs(np.argwhere(green).mean(axis=0) - [200, 500]).max() < 2


def test_a_picture_without_found_points_is_no_error():
    empty = shown(np.zeros((20, 30), np.uint8), stripe=np.empty((0, 2)), points=np.empty((0, 2)))
    assert empty.shape == (20, 30, 3) and empty.max() < 10


def test_the_histogram_counts_shares():
    image = np.zeros((100, 100), np.uint8)
    image[:25] = 255
    image[25:50] = 128
    picture = Picture(image, full_dn=FULL, caption="counted", saturated=0.25)
    assert (picture.caption, picture.saturated) == ("counted", 0.25)
    assert len(picture.histogram) == 64 and picture.histogram.sum() == pytest.approx(1.0)
    assert picture.histogram[[0, 32, 63]].tolist() == [0.5, 0.25, 0.25]


def test_the_number_of_shown_pictures_is_counted():
    board, picture = Board("test"), Picture(np.zeros((8, 8), np.uint8), full_dn=FULL, caption="one")
    board.show(picture)
    board.show(picture)
    assert board.picture is picture and board.pictures == 2
