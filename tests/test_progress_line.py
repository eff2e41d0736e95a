"""The line of a training run: steps, and how long these take."""

import re
import time
from collections.abc import Iterator

import pytest

from lidarsynth.cli.terminal import progress_line
from lidarsynth.training.loop import Progress

STEP, PICTURE = 0.02, 0.8  # seconds


def run(pictures: int) -> Iterator[Progress]:
    """Ten steps from step 2 on, before the last of which pictures are drawn."""
    yield Progress(2, {}, 0.0, 0.0, note="where it stands")
    for step in range(3, 13):
        time.sleep(STEP)
        if step == 12:
            time.sleep(pictures * PICTURE)
        yield Progress(step, {"loss": 0.5}, 1.0, 1e-4, seconds=STEP)


@pytest.mark.parametrize("pictures", [0, 1])
def test_pictures_are_no_part_of_how_long_steps_take(pictures: int, capsys: pytest.CaptureFixture[str]):
    assert list(progress_line(run(pictures), 12)) == list(range(2, 13))
    said = capsys.readouterr().err
    assert "lidarsynth: where it stands" in said and "12/12" in said
    (speed,) = re.findall(r"([\d.]+)step/s", said.split("12/12")[-1])
    assert 0.4 / STEP < float(speed) < 1.5 / STEP
