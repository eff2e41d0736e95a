"""Returns that a sensor loses for reasons that nobody has modelled: what training takes away from streets at random.

Recorded scans lack returns in dashes along a ring, in patches, from whole bands of beams, of one material, beyond some
range. Which of these a sensor does, a network can see in what is known of the scan, once it has met all of them (domain
randomisation, Tobin et al. 2017).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lidarsynth.lidar.scan import RangeImage

MOST = 0.8  # of the returns may be lost
TURN = 1024  # columns of the turn that lengths along a ring are said of


def losing(image: RangeImage, rng: np.random.Generator) -> RangeImage:
    """The image (H, W) without some of its returns, lost in about two of eight ways at once; as it is where most would
    be. Its surfaces and labels stay."""
    lost = np.zeros(image.shape, bool)
    for chance, way in WAYS:
        if rng.random() < chance:
            lost |= way(image, rng)
    lost &= image.range > 0
    if lost.sum() > MOST * np.count_nonzero(image.range):
        return image
    metres, shade = (np.where(lost, np.float32(0), part) for part in (image.range, image.reflectance))
    return replace(image, range=metres, reflectance=shade, mask=image.mask & ~lost)


def _speckle(image: RangeImage, rng: np.random.Generator) -> np.ndarray:
    return rng.random(image.shape) < _share(rng, 0.002, 0.15)


def _dashes(image: RangeImage, rng: np.random.Generator) -> np.ndarray:
    """Runs along single rings."""
    return _highest(_noise(image.shape, 0, rng.uniform(0.7, 6), rng), _share(rng))


def _patches(image: RangeImage, rng: np.random.Generator) -> np.ndarray:
    return _highest(_noise(image.shape, rng.uniform(0.5, 3), rng.uniform(2, 20), rng), _share(rng))


def _weak(image: RangeImage, rng: np.random.Generator) -> np.ndarray:
    """What reflects least, and is far; some beams see worse than others."""
    signal = np.log(image.reflectance + 0.03) - rng.uniform(0, 2) * np.log(image.range + 1)
    signal += rng.uniform(0, 0.4) * rng.standard_normal((len(signal), 1))
    signal += rng.uniform(0, 0.5) * _noise(image.shape, 0, rng.uniform(0, 4), rng)
    there = signal[image.range > 0]
    return signal < np.quantile(there, _share(rng)) if there.size else np.zeros(image.shape, bool)


def _bands(image: RangeImage, rng: np.random.Generator) -> np.ndarray:
    """Of up to four bands of beams, in an arc, at times between two ranges alone."""
    (height, width), lost = image.shape, np.zeros(image.shape, bool)
    for _ in range(int(rng.integers(1, 5))):
        top = int(rng.integers(height))
        rows = slice(top, top + int(rng.integers(1, max(2, height // 12) + 1)))
        arc = (np.arange(width) - rng.integers(width)) % width < rng.uniform(0.1, 1.3) * width
        near, far = sorted(rng.uniform(0, 60, 2)) if rng.random() < 0.6 else (0.0, np.inf)
        metres = image.range[rows]
        part = _highest(_noise(metres.shape, 0, rng.uniform(1, 30), rng), 1 - rng.uniform(0, 0.6))
        lost[rows] |= part & arc & (metres > near) & (metres < far)
    return lost


def _columns(image: RangeImage, rng: np.random.Generator) -> np.ndarray:
    """Of some columns, those of a run of beams."""
    height, width = image.shape
    some, rows = rng.random(width) < _share(rng, 0.002, 0.05), np.arange(height)
    top = int(rng.integers(height))
    return some & ((rows >= top) & (rows < top + int(rng.integers(height // 4 + 1, height + 1))))[:, None]


def _classes(image: RangeImage, rng: np.random.Generator) -> np.ndarray:
    """Some of what is of one class or two."""
    if image.label is None or not image.mask.any():
        return np.zeros(image.shape, bool)
    names = np.unique(image.label[image.mask])
    chosen = rng.choice(names, min(len(names), int(rng.integers(1, 3))), replace=False)
    noise = _noise(image.shape, rng.uniform(0, 1.5), rng.uniform(0.5, 8), rng)
    return np.isin(image.label, chosen) & _highest(noise, rng.uniform(0.1, 0.9))


def _far(image: RangeImage, rng: np.random.Generator) -> np.ndarray:
    """What is farther than some range, which is not the same everywhere."""
    edge, soft = np.exp(rng.uniform(np.log(15), np.log(120))), rng.uniform(0.02, 0.5)
    noise = _noise(image.shape, 0, rng.uniform(0, 5), rng)
    return np.log(image.range + 1e-3) + soft * noise > np.log(edge)


Way = Callable[[RangeImage, np.random.Generator], np.ndarray]  # (H, W) bool: what is lost, of returns and all else
WAYS: tuple[tuple[float, Way], ...] = (
    (0.35, _speckle), (0.4, _dashes), (0.25, _patches), (0.35, _weak), (0.2, _bands), (0.12, _columns), (0.2, _classes),
    (0.25, _far),
)  # fmt: skip


def _share(rng: np.random.Generator, low: float = 0.004, high: float = 0.3) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _highest(noise: np.ndarray, share: float) -> np.ndarray:
    """(H, W) bool: where noise is among its highest values, a share of all."""
    return noise > np.quantile(noise, 1 - share)


def _noise(shape: tuple[int, int], down: float, along: float, rng: np.random.Generator) -> np.ndarray:
    """(H, W) Gaussians that are alike within so many rows and, around the turn, so many columns of TURN, of unit size;
    the rows go around too, which nobody sees."""
    (height, width), spectrum = shape, np.fft.rfft2(rng.standard_normal(shape).astype(np.float32))
    rows, columns = np.fft.fftfreq(height)[:, None] * down, np.fft.rfftfreq(width) * along * width / TURN
    noise = np.fft.irfft2(spectrum * np.exp(-2 * np.pi**2 * (rows**2 + columns**2)), s=shape).astype(np.float32)
    return noise / max(float(noise.std()), 1e-6)
