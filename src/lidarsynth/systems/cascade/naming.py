"""What returns are of: how the network of classes learns, and how it is asked."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.lidar.pieces import pieces
from lidarsynth.lidar.point_classes import class_of_points as class_of_points
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.lidar.surroundings import surroundings
from lidarsynth.networks.class_unet import ClassUNet, around_the_turn, class_inputs
from lidarsynth.networks.rays import Rays
from lidarsynth.systems.cascade.examples import CascadeBatch
from lidarsynth.systems.cascade.known import known_of, rays_told
from lidarsynth.systems.cascade.response import Response
from lidarsynth.systems.cascade.scores import SEAM, lovasz
from lidarsynth.training.randomness import sample_rng

NARROWEST = 32  # columns: of so few the network's coarsest map is narrower than what it looks at
JUDGED, NOBODY = 12_000, -1  # pixels of a batch that the Lovasz-softmax sees; the class of what is not judged
# Of a thousand returns of varied streets, how many are of each class, from unlabeled to traffic sign.
THOUSAND = (0, 62, 0.8, 1.7, 5.2, 1.6, 13.6, 0.2, 0.1, 237, 26.7, 102, 0, 252, 29.7, 161, 25.5, 66.8, 9.8, 3.8)


# How much of the logarithm of its weight in learning is taken off a class's logit: so rare ones are named less often
# than learned, and right more often (docs/classes.md).
FAIR = 0.5
# Of a network of the insides of buildings, what these weigh in learning; furniture is unlabeled.
INSIDE = {"unlabeled": 1.5, "car": 2.0, "person": 12.0, "other-ground": 1.2, "building": 1.2}
# What is only inside, floors and furniture, and only outside; share of the former in both, and of both in all returns,
# from which on a scan is of the inside of a building (docs/classes.md).
INDOORS = ("unlabeled", "other-ground")
OUTDOORS = ("road", "parking", "sidewalk", "fence", "vegetation", "trunk", "terrain", "pole", "traffic-sign")
MOSTLY, SOME = 0.5, 0.02
# Inside, people are told from furniture piece by piece: by the logarithm of their chance there, so much of what the
# network of streets says, and as much more as brings their IoU to most in held-out insides.
ALSO, PEOPLE, FAINT = 0.5, 2.0, 1e-4  # the last: of a chance, below which it no longer counts
# Logits that what grows gets where classes are named for the texture that they give: what is drawn has less of grass
# than streets have, and as much of leaves. Chosen by street-2 (docs/generation.md).
GROWING = {"vegetation": -0.1, "terrain": 1.6}
# Logits that these get from a network that has learned from scans in the making: layouts that are drawn suggest more
# people, lorries and parking, and less grass, than streets' own; so much more does greenery where rays look so many
# degrees up, or more, and none below the first of them: there it is taken for buildings (docs/generation.md).
SKETCHED = {"person": -0.7, "truck": -1.0, "parking": -0.4, "terrain": 0.6, "fence": 0.4, "building": 0.2,
            "pole": 0.2, "trunk": 0.15, "traffic-sign": 0.3, "vegetation": -0.1}  # fmt: skip
GREENER, ABOVE = 1.0, (2.0, 6.0)
# Logits that these get in generated scans, being so much rarer in the streets that layouts have learned than in those
# of the network of classes (docs/generation.md).
RARER = {"bicycle": -1.0, "motorcycle": -4.0, "truck": -1.5, "other-vehicle": -0.9, "person": -1.1,
         "bicyclist": -1.9, "motorcyclist": -2.2}  # fmt: skip
# Logits that these get in recorded scans, if streets alone taught the network: they have so few bicyclists that most
# were named motorcyclists (docs/classes.md).
RIDERS = {"bicyclist": 1.0}
# Rows and columns on either side whose chances count as much as a pixel's own, where they are as far to this share of
# the range: single pixels are of no class of their own (docs/classes.md).
BESIDE, AS_FAR = (1, 2), 0.02


def weights() -> np.ndarray:
    """(20,) of classes in learning, 1 on average over pixels; rare ones weigh more (Paszke et al. 2016)."""
    shares = np.array(THOUSAND) / 1000
    each = 1 / np.log(1.02 + shares)
    return each / (each * shares).sum()


def inside_weights() -> np.ndarray:
    """(20,) of classes in learning of what is inside buildings: as `weights`, but for what is there."""
    each = weights()
    each[[CLASS_NUMBER[word] for word in INSIDE]] = list(INSIDE.values())
    return each


class NamingObjective(nn.Module):
    """`objective(batch)` -> `named` (n,): cross-entropies by `weights`, and the Lovasz-softmax of the batch; the cuts'
    ends, beyond which their turns would go on, are not judged.

    inside  a network of the insides of buildings learns, `inside` (n,), by its own weights: that returns may be of none
    """

    def __init__(self, network: ClassUNet, inside: bool = False):
        super().__init__()
        self.network, self.inside = network, inside
        weight = inside_weights() if inside else weights()
        self.register_buffer("weights", torch.from_numpy(weight).float(), persistent=False)

    def forward(self, batch: CascadeBatch) -> dict[str, Tensor]:
        lessons = batch.lessons
        inputs, classes = lessons.inputs, lessons.classes[..., SEAM:-SEAM]
        judged = classes > 0
        if self.inside:  # of cuts that somebody has labelled at all
            judged = (inputs[:, 0, :, SEAM:-SEAM] > 0) & judged.flatten(1).any(1)[:, None, None]
        target = classes.masked_fill(~judged, NOBODY)
        logits = self.network(inputs)[..., SEAM:-SEAM].float()
        entropy = F.cross_entropy(logits, target, self.get_buffer("weights"), ignore_index=NOBODY, reduction="none")
        count, flat = judged.sum((1, 2)), target.flatten()
        some = torch.randint(len(flat), (JUDGED,), generator=sample_rng(lessons.seeds[0], 5, 0)).to(flat.device)
        some = some[flat[some] != NOBODY]
        overlap = lovasz(logits.permute(0, 2, 3, 1).flatten(0, 2)[some], flat[some])
        return {"inside" if self.inside else "named": entropy.sum((1, 2)) / count.clamp_min(1) + overlap}


@torch.inference_mode()
def named(
    network: ClassUNet,
    images: Sequence[RangeImage],
    response: Response,
    sensor: Sensor,
    precision: str = "fp32",
    least: float = 0.0,
    more: Mapping[str, float | np.ndarray] | None = None,
    alone: bool = False,
    inside: ClassUNet | None = None,
    indoors: ClassUNet | None = None,
) -> list[RangeImage]:
    """The images of one sensor, which reports as `response` says, with the class of each return, 1 to 19, and 0 where
    there is none, or where the network is less sure of it than `least`.

    more    is added to the logits of these classes, of each row (H,) or of all
    alone   each pixel by itself, instead of with those beside it on its surface
    inside  says of images of the insides of buildings what is there, furniture of class 0
    indoors  says which images are of such; `inside` does, if not given
    """
    if sensor.width <= NARROWEST:
        raise ValueError(f"sensor {sensor.name}: expected more than {NARROWEST} columns to name classes by, found "
                         f"{sensor.width}")  # fmt: skip
    off = np.tile(_fair(weights())[:, None], sensor.height)
    for word, logit in (more or {}).items():
        off[CLASS_NUMBER[word]] -= logit
    rays, device, labels = response.told(rays_told(sensor)), next(network.parameters()).device, []
    with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16"):
        for image in images:
            bright = response.unfaded(image)
            told = class_inputs_of(bright, response.even(bright.reflectance), rays, device)
            if inside is not None and _is_inside(indoors or inside, told, image):
                chances = _inside(inside, network, told, image)
            else:
                chances = _outside(network, told, image, off, alone)
            labels.append(_likeliest(chances, least) * image.mask)
    return [replace(image, label=label) for image, label in zip(images, labels, strict=True)]


def sketched(sensor: Sensor) -> dict[str, float | np.ndarray]:
    """Logits that classes get in scans in the making of a sensor, of all rows or of each (H,)."""
    up = np.interp(sensor.elevations, ABOVE, (0.0, GREENER))
    return SKETCHED | {"vegetation": SKETCHED["vegetation"] + up}


def _fair(weight: np.ndarray) -> np.ndarray:
    """(20,) what is taken off the logits of a network that has learned with these weights."""
    return FAIR * np.log(weight)


def _without(logits: Tensor, off: np.ndarray) -> Tensor:
    """Logits (20, H, W) less what is to be taken off, (20,) or (20, H)."""
    return logits - torch.from_numpy(off.reshape(len(off), -1, 1)).float()


def _outside(network: ClassUNet, told: Tensor, image: RangeImage, off: np.ndarray, alone: bool = False) -> Tensor:
    """(20, H, W) chances of the classes of streets, 0 of none."""
    logits = _without(_logits(network, told, image.shape), off)
    logits[0] = -math.inf  # 0 is no answer
    return logits.softmax(0) if alone else of_surfaces(logits.softmax(0), _metres(image))


def _is_inside(network: ClassUNet, told: Tensor, image: RangeImage) -> bool:
    """Whether the image is of the inside of a building, by what the network sees in it."""
    label = _inside_logits(network, told, image).numpy().argmax(0)
    count = np.bincount(label[image.mask], minlength=len(CLASS_NUMBER))
    within, without = (count[[CLASS_NUMBER[word] for word in words]].sum() for words in (INDOORS, OUTDOORS))
    telling = within + without
    return bool(telling > SOME * count.sum() and within > MOSTLY * telling)


def _inside(network: ClassUNet, streets: ClassUNet, told: Tensor, image: RangeImage) -> Tensor:
    """(20, H, W) chances of what is inside buildings, 0 being furniture.

    streets  the network of streets, which has its say on people
    """
    chances = of_surfaces(_inside_logits(network, told, image).softmax(0), _metres(image))
    return of_pieces(chances, _outside(streets, told, image, _fair(weights())), _metres(image))


def _inside_logits(network: ClassUNet, told: Tensor, image: RangeImage) -> Tensor:
    """(20, H, W) of a network of the insides of buildings."""
    return _without(_logits(network, told, image.shape), _fair(inside_weights()))


def _metres(image: RangeImage) -> Tensor:
    """(H, W) of the returns, 0 of none."""
    return torch.from_numpy(image.range * image.mask)


def _likeliest(chances: Tensor, least: float) -> np.ndarray:
    """(H, W) classes by chances (20, H, W); 0 where all are less likely than `least`."""
    most, label = chances.max(0)
    return (label * (most >= least)).numpy() if least > 0 else label.numpy()


def of_surfaces(chances: Tensor, metres: Tensor) -> Tensor:
    """(C, H, W): of each pixel the mean of its chances (C, H, W) and of those beside it around the turn that returned
    from as far; metres (H, W), 0 for no return, whose pixels keep their own."""
    (up, across), height = BESIDE, len(metres)
    total, count = chances.clone(), torch.ones_like(metres)
    for down in range(-up, up + 1):
        here, there = slice(max(down, 0), height + min(down, 0)), slice(max(-down, 0), height + min(-down, 0))
        for right in range(-across, across + 1):
            if not (down or right):
                continue
            near = metres[there].roll(right, 1)
            alike = (near > 0) & ((near - metres[here]).abs() < AS_FAR * metres[here])
            total[:, here].addcmul_(chances[:, there].roll(right, 2), alike.float())
            count[here] += alike
    return total / count


def of_pieces(chances: Tensor, streets: Tensor, metres: Tensor) -> Tensor:
    """(C, H, W) chances inside buildings, in which pieces of furniture and people are wholly the one or the other, as
    their pixels say on average; by chances (C, H, W) of the network of insides, and by those of streets, which has its
    say on people; metres (H, W), 0 for no return."""
    person = CLASS_NUMBER["person"]
    here = (chances[person].log() + ALSO * streets[person].log() + PEOPLE).exp()
    others = chances.index_fill(0, torch.tensor([0, person]), 0).amax(0)
    stands = (metres > 0) & (torch.maximum(here, chances[0]) >= others)
    of = pieces(metres.numpy(), stands.numpy())[stands.numpy()]
    odds = ((here + FAINT) / (chances[0] + FAINT)).log()[stands].numpy()
    mean = np.bincount(of, odds) / np.bincount(of)
    share = torch.zeros_like(metres)
    share[stands] = torch.from_numpy(mean[of]).float().sigmoid()
    both, whole = chances[0] + chances[person], chances.clone()
    whole[0] = torch.where(stands, both * (1 - share), chances[0])
    whole[person] = torch.where(stands, both * share, chances[person])
    return whole


def class_inputs_of(image: RangeImage, even: np.ndarray, rays: Rays, device: torch.device) -> Tensor:
    """(1, C, H', W') `class_inputs` of every ray, told reflectances (H, W) as the streets' sensor would report them."""
    size = rays.elevation.shape[2], rays.elevation.shape[3]
    known = known_of(image.range[None], even[None], image.mask[None], True, size)
    around = surroundings(_on_true_beams(image))[None][..., np.arange(size[1]) % image.shape[1]]
    around = np.pad(around, ((0, 0), (0, 0), (0, size[0] - len(image.range)), (0, 0)))
    parts = known.metres, known.reflectance, torch.from_numpy(around), *rays
    metres, shade, near, *told = (part.to(device) for part in parts)
    return around_the_turn(class_inputs(metres, shade, near, Rays(*told)))


def _logits(network: ClassUNet, told: Tensor, size: tuple[int, int]) -> Tensor:
    """(20, H, W) of an image of that size. One at a time: four at once take a quarter longer, and longer sums may round
    otherwise."""
    return network(told)[0, :, : size[0], : size[1]].float().cpu()


def _on_true_beams(image: RangeImage) -> RangeImage:
    """The image, what is filled in as high as the measured points around: beams look a little elsewhere than a sensor's
    record says, and a ground of both kinds would be rough."""
    if image.xyz is None:
        return image
    measured, rays = image.mask & np.any(image.xyz != 0, axis=-1), image.sensor.points(image.range)
    off = np.where(measured, _elevation(image.xyz) - _elevation(rays), np.nan)
    rows = np.flatnonzero(measured.any(1))
    if not len(rows):
        return image
    turned = np.interp(np.arange(len(off)), rows, np.nanmedian(off[rows], axis=1))[:, None]
    flat, z = np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2]
    shorter = np.cos(turned) - np.sin(turned) * z / np.maximum(flat, 1e-6)
    raised = np.stack([rays[..., 0] * shorter, rays[..., 1] * shorter, z * np.cos(turned) + flat * np.sin(turned)], -1)
    return replace(image, xyz=np.where(measured[..., None], image.xyz, raised).astype(np.float32))


def _elevation(xyz: np.ndarray) -> np.ndarray:
    return np.arctan2(xyz[..., 2], np.hypot(xyz[..., 0], xyz[..., 1]))
