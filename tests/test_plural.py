"""Counts in words."""

import pytest

from lidarsynth.files.fields import dropped_points
from lidarsynth.lidar.plural import plural, was


@pytest.mark.parametrize(("count", "text"), [(0, "0 scans were"), (1, "1 scan was"), (2, "2 scans were")])
def test_nouns_and_verbs_agree_with_their_number(count: int, text: str):
    assert f"{plural(count, 'scan')} {was(count)}" == text


def test_points_that_were_dropped():
    assert dropped_points(1) == "1 point without a return or not finite was dropped"
    assert dropped_points(2) == "2 points without a return or not finite were dropped"
