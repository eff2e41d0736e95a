"""Checkpoints: folders that appear whole or not at all, each a model that loads and a state that continues exactly.

    out/experiment.json, model.safetensors     the newest averaged weights: `lidarsynth generate --model out`
    out/checkpoints/step-00001000/             the same two files as of that step, and state.pt: everything of the run;
                                               checksums.json, the SHA-256 of each: a flipped byte is found
    out/checkpoints/latest                     link to the newest, where the disk has links
    out/start.json                             what the run began with: which images, from which weights

Nothing of the random generators or of the data order has to be kept: both follow from the step (`training.randomness`).
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import torch

from lidarsynth.experiment.folder import save
from lidarsynth.experiment.record import RECORD, WEIGHTS, Experiment
from lidarsynth.lidar.small_file import read_json
from lidarsynth.lidar.whole_file import sweep as sweep_parts
from lidarsynth.lidar.whole_file import whole_file, write_whole
from lidarsynth.training.loop import Run

FOLDER, LATEST, STATE, CHECKSUMS = "checkpoints", "latest", "state.pt", "checksums.json"
SCRATCH = ".saving-"


def save_run(path: str | Path, run: Run) -> None:
    """Write the run's state; the file is moved into place when complete, and survives a power cut from then on.

    Raises OSError.
    """
    with whole_file(path, durable=True) as scratch, scratch.open("wb") as file:
        try:
            torch.save(run.state_dict(), file)
        except RuntimeError as error:  # torch's own, of the archive that a full disk cut
            raise (error.__context__ if isinstance(error.__context__, OSError) else error) from None


def load_run(path: str | Path, run: Run) -> None:
    """Continue from a file of `save_run`. Raises ValueError when it is none, or of another network."""
    try:
        run.load_state_dict(torch.load(path, weights_only=True, map_location="cpu"))
    except Exception as error:  # a damaged pickle raises whatever it likes
        reason = " ".join(f"{error or type(error).__name__}".split())
        raise ValueError(f"{path}: expected a training state of this experiment, found {reason:.120}") from None


def damage_of(checkpoint: Path) -> str:
    """What is wrong with a checkpoint's files, or "" where all are as they were written (or from before checksums)."""
    try:
        expected = read_json(checkpoint / CHECKSUMS)
    except FileNotFoundError:
        empty = [name for name in (STATE, WEIGHTS, RECORD) if not _size(checkpoint / name)]
        return f"{empty[0]} is empty or missing" if empty else ""
    except (OSError, ValueError):
        return f"{CHECKSUMS} cannot be read"
    if not isinstance(expected, dict):
        return f"{CHECKSUMS} holds no table"
    for name, digest in expected.items():
        path = checkpoint / Path(name).name
        if not path.is_file():
            return f"{name} is missing"
        if _sha256(path) != digest:
            return f"{name} is not what was written"
    return ""


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()


def newest_whole(out: str | Path) -> tuple[Path | None, str]:
    """The newest checkpoint whose files are as they were written, and a line that names newer ones that are not.

    None where there is no checkpoint. Raises ValueError where all are damaged.
    """
    told: list[str] = []
    for checkpoint in reversed(found := checkpoints(out)):
        if not (damage := damage_of(checkpoint)):
            note = f"{'; '.join(told)}: going on from {checkpoint.name}" if told else ""
            return checkpoint, note
        told.append(f"{checkpoint} is damaged ({damage})")
    if found:
        raise ValueError(f"{out}: expected a checkpoint to go on from, found only damaged ones: {'; '.join(told)}; "
                         f"delete {Path(out) / FOLDER} and {WEIGHTS} to begin again, or name "
                         "another folder")  # fmt: skip
    return None, ""


def checkpoints(out: str | Path) -> list[Path]:
    """The checkpoint folders of a run, oldest first."""
    return sorted((Path(out) / FOLDER).glob("step-[0-9]*"), key=lambda path: int(path.name.removeprefix("step-")))


def save_checkpoint(out: str | Path, experiment: Experiment, run: Run, keep: int = 3) -> Path:
    """Write the checkpoint of the present step, point `latest` to it, drop all but the last `keep`.

    A full disk raises OSError that names the folder, and leaves the earlier checkpoints as they were.
    """
    try:
        return _save_checkpoint(Path(out), experiment, run, keep)
    except OSError as error:
        where = f"{out}: expected room for a checkpoint, found: {error.strerror or error}"
        raise OSError(f"{where}; make room, and the same command goes on from the last one") from None


def _save_checkpoint(out: Path, experiment: Experiment, run: Run, keep: int) -> Path:
    home = out / FOLDER / f"step-{run.step:08d}"
    home.parent.mkdir(parents=True, exist_ok=True)
    if not home.exists():
        _appear(home, lambda folder: _write(folder, experiment, run))
    link = home.parent / f"{SCRATCH}{LATEST}"
    with suppress(OSError):  # exFAT, Google Drive and Windows may have no links, and no run needs this one
        link.unlink(missing_ok=True)
        link.symlink_to(home.name)
        os.replace(link, home.parent / LATEST)
    save(out, experiment, run.ema)
    for old in checkpoints(out)[: -max(1, keep)]:
        # renamed first, so that no half-deleted folder looks like a checkpoint
        shutil.rmtree(old.rename(old.with_name(f"{SCRATCH}{old.name}")))
    return home


def _write(folder: Path, experiment: Experiment, run: Run) -> None:
    save(folder, experiment, run.ema)
    save_run(folder / STATE, run)
    digests = {name: _sha256(folder / name) for name in (STATE, WEIGHTS, RECORD)}
    write_whole(folder / CHECKSUMS, json.dumps(digests, indent=1) + "\n")


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
        sweep_parts(folder)
        for scratch in folder.glob(f"{SCRATCH}*"):
            scratch.unlink() if scratch.is_symlink() else shutil.rmtree(scratch, ignore_errors=True)
