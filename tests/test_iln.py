"""ILN and LIIF: parity at the published width, and what an interpolation by weights guarantees."""

import json
import shutil

import pytest
import torch
from oracle import assert_close, largest
from procedural_weights import upsampling_weights
from torch import Tensor

from lidarsynth.networks.iln import ILN, LIIF, SHIFTS, RingConv, angle_queries, from_official, neighbours, pixel_centres

DEPTHS = {"iln_0d_full": 0, "iln_1d_full": 1}
FIXTURES = [*DEPTHS, "iln_liif_full"]
COUNTS = {0: 1_219_649, 1: 1_244_673, 2: 1_269_697}


@pytest.fixture(scope="module")
def network_of(reference):
    """Name of a fixture -> its network, in evaluation mode."""

    def build(name: str) -> ILN | LIIF:
        path = reference / "fixtures" / f"{name}.json"
        if not path.is_file():
            pytest.skip(f"reference values are not here: {path}")
        seed = json.loads(path.read_text())["procedural"]["seed"]
        with torch.device("meta"):
            network = ILN(DEPTHS[name]) if name in DEPTHS else LIIF()
        network.load_state_dict(upsampling_weights(network, seed), assign=True)
        return network.eval()

    return build


def tolerance(name: str, expected: Tensor) -> float:
    return 1e-5 if name in DEPTHS else 2e-5 * largest(expected)


@pytest.mark.parametrize("name", FIXTURES)
@torch.no_grad()
def test_outputs_equal_the_reference(fixture_tensors, network_of, name):
    expected, network = fixture_tensors(name), network_of(name)
    features = network.encode(expected["input"])
    scale = max(1.0, largest(expected["inter.encoder_feature"]))
    assert_close(features[:, :8], expected["inter.encoder_feature"], atol=1e-5 * scale, rtol=0)
    grids = [key.removesuffix(".queries") for key in expected if key.endswith(".queries")]
    assert len(grids) >= 2
    for grid in grids:
        found, output = network.decode(expected["input"], features, expected[f"{grid}.queries"]), f"{grid}.output"
        assert_close(found, expected[output][..., 0], atol=tolerance(name, expected[output]), rtol=0)


@pytest.mark.parametrize("name", DEPTHS)
@torch.no_grad()
def test_weights_and_places_equal_the_reference(fixture_tensors, network_of, name):
    expected, network = fixture_tensors(name), network_of(name)
    assert isinstance(network, ILN)
    low = expected["input"]
    near, places, _ = neighbours(network.encode(low), low, expected["random.queries"])
    assert_close(places, expected["random.rel_coords"], atol=1e-5, rtol=0)
    assert_close(network.attention(near, places), expected["random.weights"], atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", DEPTHS)
def test_gradients_equal_the_reference(fixture_tensors, network_of, name):
    expected, network = fixture_tensors(name), network_of(name)  # dropout is off, as in the reference's step
    loss = (network(expected["input"], expected["random.queries"]) - expected["train.target"][..., 0]).abs().mean()
    loss.backward()
    torch.testing.assert_close(loss, expected["train.loss"])
    gradients = {key: value for key, value in expected.items() if key.startswith("train.grad.")}
    assert len(gradients) == 3
    for key, gradient in gradients.items():
        found = network.get_parameter(key.removeprefix("train.grad.")).grad
        assert_close(found, gradient, atol=1e-4 * largest(gradient), rtol=0)


@pytest.mark.parametrize("name", FIXTURES)
@torch.no_grad()
def test_queries_from_angles_are_the_references(fixture_tensors, network_of, reference, name):
    expected, network = fixture_tensors(name), network_of(name)
    spec = json.loads((reference / "fixtures" / f"{name}.json").read_text())["lidar_spec"]
    low = expected["input"]
    for grid in {key.split(".")[0] for key in expected if key.startswith("grid_")}:
        angles = expected[f"{grid}.angles_v"], expected[f"{grid}.angles_h"]
        found = angle_queries(*angles, (low.shape[2], low.shape[3]), spec["min_v"], spec["max_v"])
        # two roundings apart at most; the 1e-6 that decides about neighbours is larger, so these are the same
        torch.testing.assert_close(found, expected[f"{grid}.queries"][0], atol=3e-7, rtol=0)
        ours, theirs = (neighbours(low, low, queries)[2] for queries in (found[None], expected[f"{grid}.queries"]))
        assert torch.equal(ours, theirs)
        if name in DEPTHS:  # at the border LIIF's areas are a ratio of roundings, so that its answer hangs on them
            assert_close(network(low, found[None]), expected[f"{grid}.output"][..., 0], atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", ["iln_0d", "iln_1d", "iln_2d", "liif"])
def test_names_shapes_and_counts_are_the_published_ones(reference, name):
    facts = json.loads((reference / "facts" / "upsampling_state_dict_shapes.json").read_text())[name]
    with torch.device("meta"):
        network = LIIF() if name == "liif" else ILN(int(name[4]))
    found = [(key, list(value.shape)) for key, value in network.state_dict().items()]
    assert found == [(key, entry["shape"]) for key, entry in facts.items()]
    if name != "liif":
        assert sum(parameter.numel() for parameter in network.parameters()) == COUNTS[int(name[4])]


@torch.no_grad()
def test_a_prediction_lies_between_its_neighbours():
    torch.manual_seed(0)
    network, low = ILN(depth=1, heads=2, channels=8).eval(), torch.rand(2, 1, 6, 12) * 2 - 1
    queries = torch.rand(2, 200, 2) * 2.2 - 1.1
    ranges = neighbours(network.encode(low), low, queries)[2]
    found = network(low, queries)
    assert (found >= ranges.amin(-1) - 1e-6).all() and (found <= ranges.amax(-1) + 1e-6).all()
    torch.testing.assert_close(network(low * 0 + 0.3, queries), torch.full((2, 200), 0.3))


def test_neighbours_surround_a_query_and_end_at_the_border():
    low = torch.arange(24.0).view(1, 1, 4, 6)
    between = torch.tensor([[[0.0, 0.0], [-1.0, -1.0], [1.0, 1.0]]])  # centre of the image, two corners
    _, places, ranges = neighbours(low, low, between)
    assert ranges[0].tolist() == [[8, 9, 14, 15], [0, 0, 0, 0], [23, 23, 23, 23]]
    torch.testing.assert_close(places[0, 0], torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]]))
    torch.testing.assert_close(places[0, 1:, 0], torch.tensor([[-1.0, -1.0], [1.0, 1.0]]))


def test_angles_of_the_image_itself_are_its_pixel_centres():
    elevation, azimuth = torch.linspace(-0.3, 0.3, 16), torch.linspace(-torch.pi, torch.pi, 65)[:-1]
    found = angle_queries(elevation, azimuth, (16, 64), -0.3, 0.3)
    torch.testing.assert_close(found.T.view(2, 16, 64), pixel_centres(16, 64), atol=1e-6, rtol=0)


def answered(network: LIIF, features: Tensor, query: Tensor) -> Tensor:
    """LIIF's range at a query (2,) from features (C,H,W), pixel by pixel, as the facts have it (upsampling.md 2.5)."""
    size, said, areas = features.shape[1:], [], []
    for sign in SHIFTS if network.ensemble else [None]:
        rows, place = [], []
        for axis in (0, 1):
            moved = float(query[axis]) + (sign[axis] / size[axis] + 1e-6 if sign else 0)
            index = int((min(max(moved, -1 + 1e-6), 1 - 1e-6) + 1) / 2 * size[axis])
            rows.append(index)
            place.append((float(query[axis]) - (-1 + (2 * index + 1) / size[axis])) * size[axis])
        if network.unfold:
            padded = torch.zeros(len(features), size[0] + 2, size[1] + 2)
            padded[:, 1:-1, 1:-1] = features
            near = torch.stack([p[rows[0] + i, rows[1] + j] for p in padded for i in range(3) for j in range(3)])
        else:
            near = features[:, rows[0], rows[1]]
        said.append(network.imnet(torch.cat([near, torch.tensor(place)])))
        areas.append(abs(place[0] * place[1]) + 1e-9)
    return sum(value * area for value, area in zip(said, reversed(areas), strict=True)) / sum(areas)


@pytest.mark.parametrize("unfold", [False, True])
@pytest.mark.parametrize("ensemble", [False, True])
@torch.no_grad()
def test_liif_of_other_arguments_is_what_the_facts_say(unfold, ensemble):
    torch.manual_seed(0)
    network, low = LIIF(4, 8, 1, unfold, ensemble).eval(), torch.rand(1, 1, 5, 7) * 2 - 1
    for parameter in network.parameters():
        parameter.mul_(3)  # else all answers are nearly the last bias
    queries = torch.cat([torch.rand(60, 2) * 2 - 1, torch.tensor([[-1.0, -1.0], [1.0, 1.0], [-1.0, 0.9]])])
    features = network.encoder(low)[0]
    expected = torch.cat([answered(network, features, query) for query in queries])
    torch.testing.assert_close(network(low, queries[None])[0], expected, atol=1e-5, rtol=1e-5)
    assert expected.std() > 0.01
    assert network.encode(low).shape == (1, 36 if unfold else 4, 5, 7)
    apart = LIIF(4, 8, 1, unfold, not ensemble)
    apart.load_state_dict(network.state_dict())
    assert (apart(low, queries[None])[0] - expected).abs().max() > 1e-3


def test_unfolded_liif_is_told_576_features_and_2_places():
    with torch.device("meta"):
        network = LIIF(unfold=True)
    assert network.get_parameter("imnet.layers.0.weight").shape == (256, 576 + 2)


@torch.no_grad()
def test_official_liif_of_other_arguments_loads():
    torch.manual_seed(0)
    for args in ({"feat_unfold": True}, {"local_ensemble": False}, {"feat_unfold": True, "local_ensemble": False}):
        theirs = LIIF(unfold="feat_unfold" in args, ensemble="local_ensemble" not in args).eval()
        checkpoint = {"model": {"name": "liif_lidar", "args": args, "state_dict": theirs.state_dict()}}
        asked = torch.rand(1, 1, 4, 8), torch.rand(1, 50, 2) * 2 - 1
        assert torch.equal(from_official(checkpoint, "liif_lidar")(*asked), theirs(*asked))
    checkpoint["model"]["args"] = {"local_ensemble": False}
    with pytest.raises(ValueError, match=r"imnet.layers.0.weight \(256, 66\), found \(256, 578\)"):
        from_official(checkpoint, "liif_lidar")


@torch.no_grad()
def test_official_checkpoints_load(fixture_tensors, network_of):
    for name, model in (("iln_1d_full", "iln"), ("iln_liif_full", "liif_lidar")):
        network, expected = network_of(name), fixture_tensors(name)
        checkpoint = {"epoch": 400, "model": {"name": model, "args": {}, "state_dict": network.state_dict()}}
        asked = expected["input"], expected["random.queries"]
        assert torch.equal(from_official(checkpoint, model)(*asked), network(*asked))


@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of modules that torch.compile brings
@pytest.mark.filterwarnings("ignore:Guards may run slower:RuntimeWarning")  # on Python 3.13.0
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a compiler")
def test_convolutions_can_be_compiled_for_training():
    """Torch 2.13 expects another layout of the gradient of its own padding that repeats rows."""
    torch.manual_seed(0)
    block, x = torch.nn.Sequential(RingConv(1, 8), RingConv(8, 8)), torch.randn(2, 1, 4, 64)
    block(x).square().sum().backward()
    expected = [parameter.grad for parameter in block.parameters()]
    block.zero_grad()
    torch.compile(block)(x).square().sum().backward()
    for parameter, gradient in zip(block.parameters(), expected, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-3, atol=1e-3)


def test_errors_say_both_sides():
    network = ILN(depth=0, heads=2, channels=4)
    with pytest.raises(ValueError, match=r"\(B, 1, H, W\) and \(B, Q, 2\), got \(1, 1, 4, 8\) and \(5, 2\)"):
        network(torch.zeros(1, 1, 4, 8), torch.zeros(5, 2))
    with pytest.raises(ValueError, match="heads must divide 64 channels, got 5"):
        ILN(heads=5)
    with pytest.raises(ValueError, match='"iln" or "liif_lidar", got \'lsr\''):
        from_official({}, "lsr")
    with pytest.raises(ValueError, match=r"expected a checkpoint of 'iln' .*, found a list"):
        from_official([])
    small = {"model": {"name": "iln", "state_dict": network.state_dict()}}
    with pytest.raises(ValueError, match=r"head.0.conv.weight \(64, 1, 3, 3\), found \(4, 1, 3, 3\); \d+ tensors"):
        from_official(small)
