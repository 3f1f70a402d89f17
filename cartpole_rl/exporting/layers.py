"""Q-networks as plain layers.

A mirrored network computes with the even and odd parts of each layer (`agents/network.py`). As plain layers,
it has the features of the scene, then those of its mirror image:

    even = (scene + image) / sqrt(2),  odd = (scene - image) / sqrt(2)
    W_even even + W_odd odd = A scene + B image
    A = (W_even + W_odd) / sqrt(2),    B = (W_even - W_odd) / sqrt(2)

and B scene + A image for the mirror image. The sums are taken in float64.
"""

import math

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from cartpole_rl.agents.network import MirrorLayer, MirrorQNetwork, QNetwork
from cartpole_rl.errors import ConfigError
from cartpole_rl.exporting.agent import Layer

Doubles = NDArray[np.float64]


def plain_layers(network: nn.Module) -> tuple[Layer, ...]:
    """Return the layers of a Q-network. Raises ConfigError for a recurrent one."""
    assert isinstance(network, QNetwork | MirrorQNetwork)
    if not isinstance(network.reader, nn.Identity):
        raise ConfigError("run: a recurrent agent (agent.recurrent) cannot be exported")
    return mirrored_layers(network) if isinstance(network, MirrorQNetwork) else layers_in_turn(network)


def layers_in_turn(network: QNetwork) -> tuple[Layer, ...]:
    """Return the layers of a network without mirror symmetry."""
    layers: list[Layer] = []
    for module in network.layers:
        if isinstance(module, nn.Linear):
            layers.append(layer(numbers(module.weight), numbers(module.bias)))
        elif isinstance(module, nn.LayerNorm):
            layers[-1] = normalized(layers[-1], module, 1)
    return tuple(layers)


def mirrored_layers(network: MirrorQNetwork) -> tuple[Layer, ...]:
    """Return the layers of a mirrored network, with both halves of the units."""
    signs, half = numbers(network.signs), math.sqrt(0.5)
    hidden = [module for module in network.layers if isinstance(module, MirrorLayer)]
    weights, biases = [], []
    for module in hidden:
        even, odd = half * numbers(module.even.weight), half * numbers(module.odd.weight)
        weights.append(np.block([[even + odd, even - odd], [even - odd, even + odd]]))
        biases.append(np.tile(numbers(module.even.bias), 2))
    even, odd = numbers(network.even_values.weight), numbers(network.odd_values.weight)
    bias = numbers(network.even_values.bias)
    same, opposite = half / 2 * (even + even[::-1]), half / 2 * (odd - odd[::-1])
    weights.append(np.hstack((same + opposite, same - opposite)))
    biases.append((bias + bias[::-1]) / 2)
    of_scene, of_image = np.split(weights[0], 2, 1)  # the image of the observation is signs * observation
    weights[0] = of_scene + of_image * signs
    layers = [layer(*each) for each in zip(weights, biases, strict=True)]
    for number, module in enumerate(hidden):
        if isinstance(module.norm, nn.LayerNorm):
            layers[number] = normalized(layers[number], module.norm, 2)
    return tuple(layers)


def layer(weight: Doubles, bias: Doubles) -> Layer:
    """Return a layer in float32."""
    return Layer(weight.astype(np.float32), bias.astype(np.float32))


def normalized(plain: Layer, norm: nn.LayerNorm, groups: int) -> Layer:
    """Return the layer with layer normalization of each of `groups` parts."""
    gain, shift = (np.tile(numbers(each), groups).astype(np.float32) for each in (norm.weight, norm.bias))
    return plain._replace(gain=gain, shift=shift)


def numbers(tensor: Tensor) -> Doubles:
    """Return the numbers of a tensor in float64."""
    return tensor.detach().cpu().double().numpy()
