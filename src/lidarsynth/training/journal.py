"""What a run leaves to look at: tables of every step and of what it is judged by, TensorBoard curves and pictures,
Weights & Biases if asked."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lidarsynth.lidar.whole_file import write_whole
from lidarsynth.pictures.render import save_png
from lidarsynth.training.loop import Progress

TABLE = "losses.csv"
JUDGED, LOOKED = "judged.csv", ("step", "number", "value")  # a line for each number of each look


class Journal:
    """Writes to folder `out`; entries behind `step`, of a run that was killed after its checkpoint, are dropped.

    parts    names of the parts of the loss
    project  of Weights & Biases, or None

    Raises ImportError when Weights & Biases is asked for and not installed. Without tensorboard, only the tables and
    the pictures are written.
    """

    def __init__(
        self,
        out: str | Path,
        step: int,
        batch_size: int,
        every: int = 50,
        project: str | None = None,
        parts: Sequence[str] = (),
    ):
        self.out = Path(out)
        self._columns = ("step", "loss", *parts, "grad_norm", "learning_rate")
        self._batch_size = batch_size
        self._every = every
        self._recent: dict[str, list[float]] = defaultdict(list)
        self._table = _continue_table(self.out / TABLE, step, self._columns)
        judged = self.out / JUDGED
        self._judged = _continue_table(judged, step, LOOKED) if judged.exists() else None
        self._board = _tensorboard(self.out / "tensorboard", step)
        self._wandb = _wandb(self.out, project) if project else None

    def step(self, progress: Progress) -> None:
        """A line of the table; every `every` steps, a point of each curve: means since the last one."""
        self._table.write(_row(progress, self._columns))
        self._table.flush()
        for name, value in {**progress.losses, "grad_norm": progress.grad_norm}.items():
            self._recent[name].append(value)
        self._recent["seconds"].append(progress.seconds)
        self._recent["waited"].append(progress.waited)
        if progress.step % self._every == 0:
            seconds, waited = (sum(self._recent.pop(key)) for key in ("seconds", "waited"))
            samples = self._batch_size * len(self._recent["loss"])
            curves = {f"train/{name}": sum(values) / len(values) for name, values in self._recent.items()}
            speed = {"speed/samples_per_second": samples / seconds, "speed/waiting_share": waited / seconds}
            self.curves(progress.step, {**curves, **speed, "train/learning_rate": progress.learning_rate})
            self._recent.clear()

    def judged(self, step: int, values: dict[str, float]) -> None:
        """A line of the second table for each number of a look at the averaged weights, and a point of each curve."""
        if self._judged is None:
            self._judged = _continue_table(self.out / JUDGED, step, LOOKED)
        self._judged.write("".join(f"{step},{name},{value!r}\n" for name, value in values.items()))
        self._judged.flush()
        self.curves(step, values)

    def looked(self, step: int) -> bool:
        """Whether the second table has what was seen at a step."""
        path = self.out / JUDGED
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()[1:] if path.exists() else []
        return any(_step_of(line) == step for line in lines)

    def curves(self, step: int, values: dict[str, float]) -> None:
        """A point of each named curve."""
        for name, value in values.items():
            if self._board:
                self._board.add_scalar(name, value, step)
        if self._wandb:
            self._wandb.log(values, step=step)

    def pictures(self, step: int, name: str, pictures: Iterable[np.ndarray]) -> None:
        """Pictures (H, W, 3) uint8: `pictures/NAME-STEP-I.png`, and beside the curves."""
        folder = self.out / "pictures"
        folder.mkdir(exist_ok=True)
        for i, picture in enumerate(pictures):
            save_png(folder / f"{name}-{step:08d}-{i}.png", picture)
            if self._board:
                self._board.add_image(f"{name}/{i}", picture, step, dataformats="HWC")

    def close(self) -> None:
        """Write what is still in memory."""
        self._table.close()
        if self._judged:
            self._judged.close()
        if self._board:
            self._board.close()
        if self._wandb:
            self._wandb.finish()


def _row(progress: Progress, columns: Sequence[str]) -> str:
    values = {**progress.losses, "grad_norm": progress.grad_norm, "learning_rate": progress.learning_rate}
    # repr is exact, so that two curves can be compared bit by bit
    return f"{progress.step}," + ",".join(repr(values[c]) if c in values else "" for c in columns[1:]) + "\n"


def _continue_table(path: Path, step: int, columns: Sequence[str]):
    """The open table with the rows up to `step`."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()[1:] if path.exists() else []
    kept = [line for line in lines if line.count(",") == len(columns) - 1 and _step_of(line) <= step]
    write_whole(path, "\n".join([",".join(columns), *kept]) + "\n")
    return path.open("a", encoding="utf-8")


def _step_of(line: str) -> float:
    """The number a row begins with; infinity for a row that was damaged."""
    word = line.partition(",")[0]
    return int(word) if word.isascii() and word.isdecimal() else math.inf


def _tensorboard(folder: Path, step: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder), purge_step=step + 1)


def _wandb(out: Path, project: str) -> Any:
    try:
        import wandb  # type: ignore[import-not-found]
    except ImportError:
        raise ImportError("--wandb needs Weights & Biases: pip install wandb") from None
    return wandb.init(project=project, dir=str(out), name=out.name, resume="allow")
