"""What a training step sees: which images of a cache or of endless synthetic streets, read by worker processes."""

from __future__ import annotations

import atexit
import ctypes
import signal
import sys
from collections.abc import Generator
from functools import lru_cache, partial
from multiprocessing import active_children
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import TracebackType
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from lidarsynth.data.dataset import CachedImages, SeveralCaches
from lidarsynth.data.frames import Name
from lidarsynth.experiment.record import Experiment, Training
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.depth import to_x_0
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.training.task import Draw

PARENT_DEATH = 1  # PR_SET_PDEATHSIG of prctl(2)
SYNTHETIC = "synthetic"  # the word that stands for streets cast on the fly
VIRTUAL = "virtual"  # the same, by virtual sensors that are drawn too
VARIED = "varied"  # by virtual sensors too, in worlds of many densities
INTERIORS = "interiors"  # by virtual sensors on robots, inside buildings
RECORDINGS = "recordings"  # the same, by KITTI's sensor as it is on other days
OF_ANY = frozenset((VIRTUAL, VARIED, INTERIORS))  # sensors
CASCADE = "cascade"  # the network that knows any
ENDLESS = (SYNTHETIC, VIRTUAL, VARIED, INTERIORS, RECORDINGS)


class Streets:
    """Endless synthetic streets of one seed, cast when asked for; no two steps see the same scan.

    word  of ENDLESS, or several with commas between them, in turn world by world: seen by `sensor`, by ones drawn from
          the seed (`VirtualStreets`, `VariedStreets`, `interiors`), or by KITTI's on many days (`RecordedStreets`)

    Raises ImportError naming the extra when the ray caster is missing.
    """

    def __init__(self, seed: int, sensor: Sensor, word: str = SYNTHETIC):
        from lidarsynth.streets.raycast import embree

        embree()
        self.seed = seed
        self.sensor = sensor
        self.words = words_of(word)
        self.source = {"name": ",".join(self.words), "seed": seed}
        self._readers: dict[tuple[int, str], Any] = {}

    def indices(self, step: int, batch_size: int) -> list[int]:
        """The scans of a step, each from another world; steps in a row go through the places of their worlds."""
        from lidarsynth.streets.world import POSES

        return [(step // POSES * batch_size + p) * POSES + step % POSES for p in range(batch_size)]

    def name(self, i: int) -> Name:
        """What scan i is called."""
        return Name(self._word(i), f"seed {self.seed}", str(i))

    def take(self, indices: list[int]) -> list[RangeImage]:
        """Scans as images, with labels."""
        images = []
        for slot, index in enumerate(indices):  # a reader per slot, because a reader remembers only two worlds
            key = (slot, self._word(index))
            if key not in self._readers:
                self._readers[key] = self._reader(key[1])
            images.append(self._readers[key].image(index))
        return images

    def _word(self, index: int) -> str:
        """Where scan `index` is from."""
        from lidarsynth.streets.world import POSES

        return self.words[index // POSES % len(self.words)]

    def _reader(self, word: str) -> Any:
        from lidarsynth.streets.interiors import interiors
        from lidarsynth.streets.reader import SyntheticStreets
        from lidarsynth.streets.recordings import RecordedStreets
        from lidarsynth.streets.varied import VariedStreets
        from lidarsynth.streets.virtual import VirtualStreets

        if word == SYNTHETIC:
            return SyntheticStreets(self.seed, 1 << 62, self.sensor)
        drawn = {VIRTUAL: VirtualStreets, VARIED: VariedStreets, INTERIORS: interiors, RECORDINGS: RecordedStreets}
        return drawn[word](self.seed, 1 << 62)

    def x_0(self, indices: list[int], codec: str = "log") -> Tensor:
        """(B, 2, H, W) float32 in [-1, 1]."""
        return torch.stack([to_x_0(image, codec) for image in self.take(indices)])


TrainingImages = CachedImages | SeveralCaches | Streets  # what a network can learn from


def open_images(data: str | Path, experiment: Experiment, seed: int | None = None) -> TrainingImages:
    """The images of a cache folder, or streets of `seed` (default the experiment's) for a word of ENDLESS.

    Several folders or words, with commas between them, are seen equally often. Raises ValueError for one of no cache,
    and for streets of many sensors where the network knows one alone.
    """
    if words := words_of(data):
        if experiment.model.network != CASCADE and (other := OF_ANY.intersection(words)):
            raise ValueError(f"{data}: expected streets of one sensor, such as {SYNTHETIC}, for the network "
                             f"{experiment.model.network}, found {min(other)}, of many")  # fmt: skip
        seed = experiment.training.seed if seed is None else seed
        return Streets(seed, build_sensor(experiment), ",".join(words))
    folders = folders_of(data)
    return CachedImages(data) if len(folders) == 1 else SeveralCaches(folders)


def words_of(data: str | Path) -> tuple[str, ...]:
    """The words of ENDLESS that are named with commas between them; () for folders. Raises ValueError for both."""
    words = tuple(word.strip() for word in str(data).split(","))
    others = [word for word in words if word not in ENDLESS]
    if others and len(others) < len(words) and not Path(data).exists():
        raise ValueError(f"{data}: expected words of {', '.join(ENDLESS)} alone, or caches alone, found {others[0]!r}")
    return () if others else words


def folders_of(data: str | Path) -> list[str]:
    """The folders of caches that are named with commas between them; a folder of such a name is one."""
    return [str(data)] if Path(data).exists() else str(data).split(",")


@lru_cache(maxsize=4)
def epoch_order(seed: int, epoch: int, length: int) -> Tensor:
    """(length,) permutation of the data of one epoch, a function of the seed and the epoch only."""
    return torch.randperm(length, generator=torch.Generator().manual_seed(seed * 1_000_003 + epoch))


def batch_indices(training: Training, step: int, images: TrainingImages) -> list[int]:
    """Which images the global batch of step `step` holds: each epoch visits every image of a cache once."""
    if isinstance(images, Streets):
        return images.indices(step, training.batch_size)
    length = len(images)
    positions = range(step * training.batch_size, (step + 1) * training.batch_size)
    return [int(epoch_order(training.seed, p // length, length)[p % length]) for p in positions]


def share_of(experiment: Experiment, parts: int) -> int:
    """Samples of each of `parts` equal parts of a batch. Raises ValueError unless there are such."""
    size = experiment.training.batch_size
    if size % parts:
        raise ValueError(f"expected a batch size that {parts} processes x passes share equally, found {size}")
    return size // parts


class Examples(Dataset):
    """`examples[step, part] -> a batch`: part of `parts` equal parts of a step's global batch, interleaved.

    `parts` is processes times passes of gradient accumulation. Raises ValueError unless it divides the batch size.
    """

    def __init__(self, experiment: Experiment, images: TrainingImages, parts: int, draw: Draw):
        share_of(experiment, parts)
        self.experiment = experiment
        self.images = images
        self.parts = parts
        self.draw = draw

    def names(self, step: int) -> str:
        """The scans of a step, as a person looks for them."""
        indices = batch_indices(self.experiment.training, step, self.images)
        return ", ".join("/".join(filter(None, self.images.name(i))) for i in indices)

    def __getitem__(self, key: tuple[int, int]) -> Any:
        step, part = key
        training = self.experiment.training
        indices = batch_indices(training, step, self.images)
        positions = list(range(part, training.batch_size, self.parts))
        return self.draw(self.experiment, self.images, [indices[p] for p in positions], step, positions)


def load_batches(
    examples: Examples, first: int, parts: range, workers: int = 0, pinned: bool = False
) -> Generator[Any, None, None]:
    """The batches of the steps from `first` to the last, for each step those of `parts` in turn.

    The order does not depend on `workers`, the number of processes that read ahead; they end when it is closed.
    """
    others = set(active_children())
    batches = iter(
        DataLoader(
            examples,
            batch_size=None,
            sampler=((step, part) for step in range(first, examples.experiment.training.steps) for part in parts),
            num_workers=workers,
            pin_memory=pinned,
            worker_init_fn=_leave_endings if workers else None,
            prefetch_factor=4 if workers else None,
            generator=torch.Generator(),  # leaves the global one alone
        )
    )
    end = partial(_end, set(active_children()) - others)
    atexit.register(end)  # whatever the caller dies of: they ignore the signal by which Python ends its processes
    try:
        yield from batches
    finally:
        if workers:
            batches._shutdown_workers()  # type: ignore[attr-defined]  # a traceback may hold it, and so would keep them
        del batches
        atexit.unregister(end)


def _end(processes: set[BaseProcess]) -> None:
    for process in processes:
        if process.is_alive():
            process.kill()


def _leave_endings(worker: int) -> None:
    # a stop is for the main process, which saves first and then ends its workers
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)
    sys.excepthook = _say_unless_left
    if sys.platform == "linux":  # they hold the run's lock, and would for seconds where the main process is killed
        ctypes.CDLL(None).prctl(PARENT_DEATH, signal.SIGKILL)


def _say_unless_left(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    # the thread that hands batches over says here that the main process let go of one, as it does where it ends
    if not isinstance(error, ConnectionError | EOFError):
        sys.__excepthook__(kind, error, trace)
