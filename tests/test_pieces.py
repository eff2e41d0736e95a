"""Pieces of an image that hang together."""

import numpy as np

from lidarsynth.lidar.pieces import connected, pieces


def test_cells_are_connected_through_others():
    least = connected(np.array([5, 3, 8, 1]), np.array([3, 2, 9, 0]), 10)
    assert least.tolist() == [0, 0, 2, 2, 4, 2, 6, 7, 8, 8]
    chain = np.random.default_rng(0).permutation(999)
    assert not connected(chain, chain + 1, 1000).any()


def test_what_is_as_far_and_beside_is_of_one_piece():
    metres, among = np.full((4, 12), 10.0), np.zeros((4, 12), bool)
    among[1:3, 2:4], among[1, 5] = True, True  # two columns away from the first ones
    among[0, 8], among[1, 9], among[3, 9] = True, True, True  # the last one a beam too far down
    metres[2, 2] = 11.0
    of = pieces(metres, among)
    assert (of >= 0).tolist() == among.tolist()
    assert of[1, 2] == of[1, 3] == of[2, 3] == of[1, 5] != of[2, 2]
    assert of[0, 8] == of[1, 9] != of[3, 9]
    assert sorted(np.unique(of[among])) == list(range(of.max() + 1))


def test_a_piece_goes_on_around_the_turn_but_not_from_the_last_beam_to_the_first():
    metres, among = np.full((3, 8), 5.0), np.zeros((3, 8), bool)
    among[0, 0], among[0, 7], among[2, 7] = True, True, True
    of = pieces(metres, among)
    assert of[0, 0] == of[0, 7] != of[2, 7]


def test_of_nothing_there_is_no_piece():
    assert (pieces(np.ones((2, 4)), np.zeros((2, 4), bool)) == -1).all()
