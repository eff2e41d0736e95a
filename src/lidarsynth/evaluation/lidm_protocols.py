"""LiDAR-Diffusion's metrics, and what R2Flow and R3DPA call so: three FRIDs, two JSDs, three MMDs of the same names."""

from __future__ import annotations

from dataclasses import replace

from lidarsynth.evaluation.formulas import FRECHET, FSVD, JSD, KERNEL, MATCHING, MMD, OCCUPANCY
from lidarsynth.evaluation.protocol import Bev, Clouds, EvaluationProtocol, Network, Row

RANGENET_LIDM = Network(
    "lidm-rangenet",
    ((0, "rangenet21_lidm.tar.gz"),),
    "decoder output, mean over 16 bands of 4 rows, of LiDM's own image: raw metres, -1 where empty",
    512,
    layers=21,
)
MINKOWSKI = Network(
    "minkowskinet", ((0, "minkowskinet_lidm.tar.gz"),), "before the classifier, means of 16 shells", 768
)
SPVCNN = Network("spvcnn", ((0, "spvcnn_lidm.tar.gz"),), "points before the classifier, means of 16 shells", 768)

_FRID = Row("FRID", "frechet", FRECHET, "lidm-rangenet", digits=1)
_FSVD = Row("FSVD", "frechet", f"{FSVD}; {FRECHET}", "minkowskinet", digits=2)
_FPVD = Row("FPVD", "frechet", f"{FSVD}; {FRECHET}", "spvcnn", digits=2)
_OWN_WEIGHTS = (
    "a folder of LiDM's own pretrained_weights serves as well: put it in place of the archive, without .tar.gz"
)
_REDRAWN = (
    "real scans are drawn into LiDM's image and come back through its range code, as its reference does; points of "
    "samples are judged as they are, and for the FRID drawn into that image (a real scan is so drawn twice)"
)
_NO_EPSILON = "the Frechet distance has no epsilon: the official program adds 1e-6 only where its root is not finite"

LIDM = EvaluationProtocol(
    "lidm-2024",
    1,
    "Ran et al., CVPR 2024 (LiDAR-Diffusion), table of 64 beams and the official evaluation program",
    (
        _FRID,
        _FSVD,
        _FPVD,
        Row("JSD", "cloud-jsd", OCCUPANCY),
        Row("MMD x1e4", "cloud-mmd", MATCHING + ", 0.5 m cells", scale=1e4),
    ),
    (RANGENET_LIDM, MINKOWSKI, SPVCNN),
    near=1.0,
    far=56.0,
    gated=(),
    samples=2000,
    samples_bev=2000,
    real_bev=None,
    sequences=("0003_sync",),
    sequences_bev=("0003_sync",),
    clouds=Clouds(),
    notes=(
        "the reference is sequence 03 of KITTI-360, on which R2DM and R2Flow train",
        _REDRAWN,
        _NO_EPSILON,
        _OWN_WEIGHTS,
        "of samples that are images the points of their pixels are taken",
    ),
)

R3DPA = replace(
    LIDM,
    name="r3dpa-2026",
    source="R3DPA, 2026, and the official evaluation program",
    rows=(
        _FSVD,
        _FPVD,
        Row("JSD x1e2", "cloud-jsd", OCCUPANCY, scale=1e2),
        Row("MMD x1e5", "cloud-mmd", MATCHING + ", 5 cm cells", scale=1e5),
        Row("TV", "cloud-tv", "sum of |p - q| over the grids of the JSD"),
    ),
    networks=(MINKOWSKI, SPVCNN),
    samples=10_000,
    samples_bev=None,
    sequences=(),
    sequences_bev=(),
    clouds=Clouds(gated=True, matching=0.05, samples=2000, real=1000),
    absent=(
        ("FRID", "R3DPA's FRID is of a RangeViT, which is not here; lidm-2024 has LiDM's"),
        ("FLD", "the network LIP-Loc is not here"),
    ),
    notes=(
        "the reference is sequences 03, 04, 05, 06, 07, 09, 10 and 00, 02; the program also takes the last two alone",
        "MMD: 1,000 real scans after Random(0).shuffle (the program draws them unseeded, from 00 and 02) against the "
        "first 2,000 samples",
        *LIDM.notes[1:],
    ),
)

R2FLOW = EvaluationProtocol(
    "r2flow-2025",
    1,
    "Nakashima et al., ICRA 2025 (R2Flow), and the official evaluation program",
    (
        _FRID,
        _FSVD,
        _FPVD,
        Row("MMD x1e4", "bev-mmd", MMD, scale=1e4),
        Row("JSD x1e2", "bev-jsd", JSD, scale=1e2),
        Row("FRID squared MMD", "kernel", KERNEL, "lidm-rangenet"),
        Row("FSVD squared MMD", "kernel", KERNEL, "minkowskinet"),
        Row("FPVD squared MMD", "kernel", KERNEL, "spvcnn"),
    ),
    (
        replace(
            RANGENET_LIDM, layer="decoder output, mean over 16 bands of 4 rows, of the normalised image, empty = 0"
        ),
        MINKOWSKI,
        SPVCNN,
    ),
    Bev(),
    samples=None,
    samples_bev=None,
    measured=True,
    notes=(
        "all samples; the published guide asks for 10,000",
        "the same weights as lidm-2024, another preprocessing: another FRID, and 0.5 to 63 m in FSVD and FPVD",
        "all real images for FRID, FSVD and FPVD; BEV takes 10,000 of them after Random(0).shuffle",
        _OWN_WEIGHTS,
    ),
)

LIDM_RECONSTRUCTION = EvaluationProtocol(
    "lidm-reconstruction-2024",
    2,
    "Ran et al., CVPR 2024 (LiDAR-Diffusion), table of the autoencoder",
    (
        Row(
            "CD",
            "chamfer",
            "half the sum of both mean squared distances to the nearest point, mean of pairs",
            unit="m2",
        ),
    ),
    (),
    near=1.0,
    far=56.0,
    samples=None,
    pairs=True,
    clouds=Clouds(gated=True),
    absent=(("EMD", "the official program's auction of the first 1,024 k points is not here"),),
    notes=(
        _REDRAWN,
        "sample i against reference i, points of 1 to 56 m; rFRID, rFSVD and rFPVD are those of lidm-2024",
    ),
)
