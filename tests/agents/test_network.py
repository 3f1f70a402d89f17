"""The Q-networks: mirror symmetry, layers, and the recurrent layer that reads frames."""

import pytest
import torch
from torch import Tensor, nn

from cartpole_rl.agents.network import FrameReader, MirrorQNetwork, QNetwork


def frame_reader() -> FrameReader:
    """Three frames of two numbers, and one number beside them."""
    torch.manual_seed(0)
    return FrameReader(7, [[5, 6], [2, 4], [0, 1]], 16)


def fitted(network: nn.Module, inputs: Tensor, expected: Tensor, updates: int) -> float:
    """Fit a network; return its squared error as a share of the variance."""
    optimizer = torch.optim.Adam(network.parameters(), lr=2e-2)
    for _ in range(updates):
        error = (network(inputs) - expected).square().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
    return error.item() / expected.var().item()


@pytest.mark.parametrize("layer_norm", [True, False])
@pytest.mark.parametrize("actions", [2, 3, 9])
@pytest.mark.parametrize("recurrent", [False, True])
def test_a_mirrored_network_values_the_mirror_image_the_same(
    recurrent: bool, layer_norm: bool, actions: int
) -> None:
    torch.manual_seed(0)
    signs = torch.tensor([-1.0, 1.0, -1.0, 1.0, -1.0])
    reader = FrameReader(5, [[3, 4], [0, 1]], 4) if recurrent else None
    network = MirrorQNetwork(signs.tolist(), actions, (16, 8), layer_norm, reader)
    observation = torch.randn(50, 5)
    values = network(observation)
    assert values.shape == (50, actions)
    assert torch.allclose(network(observation * signs), values.flip(-1), atol=1e-6)
    assert values.std(-1).min() > 1e-4  # it is no constant
    assert not torch.allclose(values, values.flip(-1), atol=1e-2)


def test_a_mirrored_network_fits_what_is_odd_and_what_is_even() -> None:
    torch.manual_seed(0)
    x, y = torch.rand(2, 300) * 2 - 1
    reference = torch.stack((y - x**3, y * x**2, y + x**3), -1)
    network = MirrorQNetwork([-1, 1], 3, (64, 64), True)
    assert fitted(network, torch.stack((x, y), -1), reference, updates=200) < 3e-3


@pytest.mark.parametrize("layer_norm", [True, False])
def test_network_has_the_layers_asked_for(layer_norm: bool) -> None:
    network = QNetwork(5, 9, (16, 8), layer_norm)
    assert network(torch.randn(7, 5)).shape == (7, 9)
    norms = [layer for layer in network.layers if isinstance(layer, nn.LayerNorm)]
    assert [norm.normalized_shape for norm in norms] == ([(16,), (8,)] if layer_norm else [])


def test_frames_are_read_from_the_oldest_to_the_newest() -> None:
    reader = frame_reader()
    scene = torch.randn(5, 7)
    state = torch.zeros(5, 16)
    for frame in (scene[:, [5, 6]], scene[:, [2, 4]], scene[:, [0, 1]]):
        state = reader.cell(frame, state)
    expected = torch.cat((state, scene[:, 3:4]), -1)
    network = QNetwork(7, 3, (8,), True, reader)
    for function, values in ((reader, expected), (network, network.layers(expected))):
        torch.testing.assert_close(function(scene), values)
        torch.testing.assert_close(function(scene.view(5, 1, 7)), values.unsqueeze(1))
        torch.testing.assert_close(function(scene[0]), values[0])


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_recurrent_network_learns_a_velocity_from_positions(mirrored: bool) -> None:
    """The difference of two frames, of which each alone says nothing."""
    layers = 2, (8,), True, frame_reader()
    network = MirrorQNetwork([-1] * 7, *layers) if mirrored else QNetwork(7, *layers)
    scene = torch.randn(200, 7)
    velocity = scene[:, 0] - scene[:, 2]
    assert fitted(network, scene, torch.stack((velocity, -velocity), -1), updates=120) < 0.1
