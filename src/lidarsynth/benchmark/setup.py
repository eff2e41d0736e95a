"""The setup of a benchmark, which all of its methods share: folder, models, networks that judge, progress."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from lidarsynth.benchmark.config import Generation, GenerationMethod, Upsampling, UpsamplingMethod, protocols_of
from lidarsynth.benchmark.store import Store, open_store
from lidarsynth.data.cache import sha256 as sha256_of_file
from lidarsynth.evaluation.accumulation import Loaded, OnImages, load_networks
from lidarsynth.evaluation.protocols import get_protocol
from lidarsynth.networks.rangenet_archive import read_rangenet
from lidarsynth.systems.fingerprint import fingerprint
from lidarsynth.systems.scan_model import ScanModel

Load = Callable[[str], ScanModel]
OnDone = Callable[[int], object] | None  # called with the number of scans that are there


@dataclass(frozen=True)
class Setup:
    """What all methods of one benchmark share.

    folder        where scans, streets and results go
    models        word of the benchmark's file -> the model
    fingerprints  word -> what its weights and settings are, 16 hex digits
    classes       a RangeNet of the user's own for the classes of pixels, or none
    batch_size    scans at once, where a GPU makes them
    """

    folder: Path
    models: Mapping[str, ScanModel]
    fingerprints: Mapping[str, str]
    classes: Loaded | None = None
    device: str = "cpu"
    batch_size: int = 1
    on_images: OnImages = None
    _judges: dict[tuple[str, int], Loaded] = field(default_factory=dict)
    _seen: dict[tuple[str, int], dict[int, np.ndarray]] = field(default_factory=dict)
    _weights: dict[tuple[str, int], dict[str, str]] = field(default_factory=dict)

    def model(self, word: str | None) -> ScanModel | None:
        """The model of a word, None for None."""
        return None if word is None else self.models[word]

    def settings(self, method: UpsamplingMethod | GenerationMethod, keys: Sequence[str]) -> dict[str, Any]:
        """What decides a method's scans: its own settings, the model, the device, the version of the program."""
        told = {key: vars(method)[key] for key in keys if vars(method)[key] not in (None, False)}
        if method.model is not None:
            told |= {"model": method.model, "fingerprint": self.fingerprints[method.model]}
        return told | {"device": self.device, "lidarsynth": version("lidarsynth")}

    def store(self, word: str, settings: Mapping[str, Any]) -> Store:
        """Where the scans of these settings are kept."""
        return open_store(self.folder / "scans", word, dict(settings))

    def progress(self, name: str, total: int) -> OnDone:
        """What to call with the number of scans that are there."""
        on_images = self.on_images
        return None if on_images is None else lambda done: on_images(name, done, total)

    def stepwise(self, name: str, total: int, calls: int) -> tuple[OnDone, Callable[..., None] | None]:
        """`progress` of a method of so many network steps a scan, and what to call after each, with the number of scans
        that it was for (1): where they are several, they are what is counted."""
        told, at = self.on_images, 0
        if told is None or calls < 2:
            return self.progress(name, total), None

        def on_done(done: int) -> None:
            nonlocal at
            at = done * calls
            told(f"{name}, steps", at, total * calls)

        def on_step(scans: int = 1) -> None:
            nonlocal at
            at = min(at + scans, total * calls)
            told(f"{name}, steps", at, total * calls)

        return on_done, on_step

    def judges(self, protocol: str, width: int) -> Loaded:
        """The networks of a protocol of pairs: the user's own RangeNet, or the official one where it is here."""
        if self.classes:
            return self.classes
        if (protocol, width) not in self._judges:
            self._judges[protocol, width] = self._loaded(protocol, width)
        return self._judges[protocol, width]

    def weights(self, protocol: str, width: int) -> dict[str, str]:
        """Kind -> SHA-256 of the networks that `evaluate` takes for a protocol of sets. Raises ValueError for a damaged
        file."""
        if (protocol, width) not in self._weights:
            loaded = load_networks(get_protocol(protocol), width, on_images=self.on_images)
            self._weights[protocol, width] = loaded.weights
        return self._weights[protocol, width]

    def seen(self, protocol: str, width: int) -> dict[int, np.ndarray]:
        """Where `Pairs` keeps the classes that these networks see in the truths, the same for all methods."""
        return self._seen.setdefault((protocol, width), {})

    def _loaded(self, protocol: str, width: int) -> Loaded:
        loaded = load_networks(get_protocol(protocol), width, self.device)
        return replace(loaded, missing={kind: f"no weights of {kind}: --classes names them" for kind in loaded.missing})


def open_setup(
    config: Upsampling | Generation,
    folder: Path,
    load: Load,
    classes: Path | None = None,
    device: str = "cpu",
    batch_size: int = 1,
    on_images: OnImages = None,
) -> Setup:
    """Load every model once, so that a word that is none is told before the first scan. Raises ValueError."""
    pairs = isinstance(config, Upsampling)
    for name in protocols_of(config):
        if get_protocol(name).pairs != pairs:
            raise ValueError(f"protocol: expected one that compares {'image by image' if pairs else 'sets'}, "
                             f"found {name}")  # fmt: skip
    words = dict.fromkeys(method.model for method in config.method if method.model)
    models = {word: load(word) for word in words}
    fingerprints = {word: fingerprint(model) for word, model in models.items()}
    judge = None if classes is None else read_classes(classes, device)
    return Setup(folder, models, fingerprints, judge, device, batch_size, on_images)


def read_classes(path: Path, device: str = "cpu") -> Loaded:
    """A RangeNet for the classes of pixels, and the SHA-256 of its file, or of a folder's files. Raises ValueError."""
    network = read_rangenet(path).to(device)
    files = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
    digest = sha256("".join(map(sha256_of_file, files)).encode()).hexdigest() if path.is_dir() else sha256_of_file(path)
    return Loaded({"rangenet": network}, {"rangenet": digest}, {})
