"""Checkpoints: folders that appear whole or not at all, each a model that loads and a state that continues exactly.

    out/experiment.json, model.safetensors     the newest averaged weights: `lidarsynth generate --model out`
    out/checkpoints/step-00001000/             the same two files as of that step, and state.pt: everything of the run
    out/checkpoints/latest                     link to the newest

Nothing of the random generators or of the data order has to be kept: both are functions of the step (`training.steps`).
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import torch

from lidarsynth.experiment.folder import save
from lidarsynth.experiment.record import Experiment
from lidarsynth.training.loop import Run

FOLDER, LATEST, STATE = "checkpoints", "latest", "state.pt"
SCRATCH = ".saving-"


def save_run(path: str | Path, run: Run) -> None:
    """Write the run's state; the file is moved into place when complete, and survives a power cut from then on."""
    path = Path(path)
    scratch = path.with_suffix(".tmp")
    with scratch.open("wb") as file:
        torch.save(run.state_dict(), file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(scratch, path)


def load_run(path: str | Path, run: Run) -> None:
    """Continue from a file of `save_run`. Raises ValueError when it is none, or of another network."""
    try:
        run.load_state_dict(torch.load(path, weights_only=True, map_location="cpu"))
    except Exception as error:  # a damaged pickle raises whatever it likes
        raise ValueError(f"{path}: expected a training state of this experiment, found {error!s:.120}") from None


def checkpoints(out: str | Path) -> list[Path]:
    """The checkpoint folders of a run, oldest first."""
    return sorted((Path(out) / FOLDER).glob("step-[0-9]*"), key=lambda path: int(path.name.removeprefix("step-")))


def save_checkpoint(out: str | Path, experiment: Experiment, run: Run, keep: int = 3) -> Path:
    """Write the checkpoint of the present step, point `latest` to it, drop all but the last `keep`.

    A full disk raises OSError and leaves the earlier checkpoints as they were.
    """
    out = Path(out)
    home = out / FOLDER / f"step-{run.step:08d}"
    home.parent.mkdir(parents=True, exist_ok=True)
    if not home.exists():
        _appear(home, lambda folder: (save(folder, experiment, run.ema), save_run(folder / STATE, run)))
    link = home.parent / f"{SCRATCH}{LATEST}"
    link.unlink(missing_ok=True)
    link.symlink_to(home.name)
    os.replace(link, home.parent / LATEST)
    save(out, experiment, run.ema)
    for old in checkpoints(out)[: -max(1, keep)]:
        # renamed first, so that no half-deleted folder looks like a checkpoint
        shutil.rmtree(old.rename(old.with_name(f"{SCRATCH}{old.name}")))
    return home


def _appear(home: Path, write: Callable[[Path], object]) -> None:
    scratch = home.with_name(f"{SCRATCH}{home.name}")
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    try:
        write(scratch)
        os.replace(scratch, home)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def sweep(out: str | Path) -> None:
    """Remove what a killed process left half-written."""
    for folder in (Path(out), Path(out) / FOLDER):
        for scratch in folder.glob(f"{SCRATCH}*"):
            scratch.unlink() if scratch.is_symlink() else shutil.rmtree(scratch, ignore_errors=True)
