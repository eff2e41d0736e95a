"""The line of a training run: steps, and how long these take; of other work, the passes of slow models."""

import io
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import tqdm
from test_first_and_last import Clock
from test_upsampling_model import image, model_of  # noqa: F401, a fixture

from lidarsynth.benchmark.run import benchmark
from lidarsynth.cli import terminal
from lidarsynth.cli.main import main
from lidarsynth.cli.terminal import progress_line
from lidarsynth.data.dataset import write_cache
from lidarsynth.files.formats import write
from lidarsynth.lidar.scan import RangeImage
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


@pytest.mark.parametrize("verb", ["complete", "upsample"])
@pytest.mark.parametrize("count", [1, 2])
def test_every_pass_moves_the_line(verb: str, count: int, image: RangeImage, tmp_path: Path, monkeypatch):  # noqa: F811
    """Of one scan and of several."""
    monkeypatch.chdir(tmp_path)
    model_of("lidar-sr").save("model")
    Path("in").mkdir()
    for number in range(count):
        write(f"in/{number}.npz", image)
    log = io.StringIO()
    monkeypatch.setattr(sys, "stderr", log)
    monkeypatch.setattr(tqdm.std, "time", Clock())
    monkeypatch.setattr(terminal, "_seconds", lambda: 0.1)
    words = ["--corrupt", "beams:4"] if verb == "complete" else []
    where = ["in/0.npz", "--out", "o.ply"] if count == 1 else ["in", "--out", "out"]
    main([verb, *where, "--model", "model", "--steps", "30", "--no-picture", *words])
    for step in (13, 14, 15, *((43, 44, 45) if count == 2 else ())):
        assert f" {step}/{30 * count} " in log.getvalue()
    assert ("1 scan of 2 done" in log.getvalue()) == (count == 2)


def test_every_pass_of_a_benchmark_is_told(image: RangeImage, tmp_path: Path):  # noqa: F811
    list(write_cache(tmp_path / "data", lambda i: image, 2, image.sensor, {"name": "walls"}))
    config, told = tmp_path / "b.toml", []
    row = f'data = "{tmp_path / "data"}"\n[[method]]\nname = "slow"\nmodel = "lidar-sr"\nsteps = 3\n'
    config.write_text(row + '[[method]]\nname = "quick"\ninterpolation = "nearest"\n')
    call = "upsampling", config, tmp_path / "out", model_of
    benchmark(*call, on_images=lambda *line: told.append(line))
    slow = [done for what, done, total in told if (what, total) == ("slow, steps", 6)]
    assert slow == [0, 1, 2, 3, 3, 4, 5, 6, 6]
    assert [line for line in told if line[0] == "quick"] == [("quick", i, 2) for i in range(3)]
    next((tmp_path / "out" / "scans").glob("lidar-sr-*/000001.npz")).unlink()
    told.clear()
    benchmark(*call, on_images=lambda *line: told.append(line))  # goes on where it was
    assert [done for what, done, _ in told if what == "slow, steps"] == [3, 4, 5, 6, 6]
