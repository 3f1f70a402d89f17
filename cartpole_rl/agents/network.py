"""Q-networks: multilayer perceptrons, with or without the mirror symmetry of cart and pole.

Either may have a recurrent input layer that reads the last frames.

Layer normalization after each hidden layer keeps a trained agent from forgetting the swing-up
(Gallici et al., "Simplifying deep temporal difference learning", 2024).
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.errors import ConfigError

# weight [outputs, inputs] and bias [outputs]; gain and shift [outputs] if the layer is normalized
PlainLayer = tuple[NDArray[np.float32], ...]


def q_network(
    settings: AgentSettings, mirror_signs: Sequence[int], actions: int, frames: Sequence[Sequence[int]]
) -> "QNetwork | MirrorQNetwork":
    """Return a new network from observations [..., K] to action values [..., A].

    `mirror_signs` [K] holds the factor, +1 or -1, of each number when left and right are swapped. `frames`
    [T, F] holds the indices of the frames that a recurrent network reads.
    """
    size = len(mirror_signs)
    reader = None if settings.recurrent is None else FrameReader(size, frames, settings.recurrent)
    layers = actions, settings.hidden, settings.layer_norm, reader
    return MirrorQNetwork(mirror_signs, *layers) if settings.mirrored else QNetwork(size, *layers)


class QNetwork(nn.Module):
    """A network from observations [..., K] float32 to action values [..., A], with an optional `reader`."""

    def __init__(
        self,
        observation_size: int,
        actions: int,
        hidden: Sequence[int],
        layer_norm: bool,
        reader: "FrameReader | None" = None,
    ) -> None:
        super().__init__()
        self.reader = reader or nn.Identity()
        layers: list[nn.Module] = []
        width = reader.width if reader else observation_size
        for size in hidden:
            layers.append(nn.Linear(width, size))
            if layer_norm:
                layers.append(nn.LayerNorm(size))
            layers.append(nn.ReLU())
            width = size
        self.layers = nn.Sequential(*layers, nn.Linear(width, actions))

    def forward(self, observation: Tensor) -> Tensor:
        """Return the action values."""
        return self.layers(self.reader(observation))

    def plain_layers(self) -> list[PlainLayer]:
        """Return the numbers of each layer. Raises ConfigError for a recurrent network."""
        _check_not_recurrent(self.reader)
        layers: list[list[Tensor]] = []
        for module in self.layers:
            if isinstance(module, nn.Linear):
                layers.append([module.weight, module.bias])
            elif isinstance(module, nn.LayerNorm):
                layers[-1] += [module.weight, module.bias]
        return [tuple(_doubles(each).astype(np.float32) for each in layer) for layer in layers]


class MirrorQNetwork(nn.Module):
    """A QNetwork that values an action as it values the mirrored action in the mirrored observation.

    Swapping left and right multiplies the numbers of an observation by `signs` [K], +1 or -1, and reverses
    the order of the actions. Experience on one side then counts on the other, with half the weights (van der
    Pol et al., "MDP homomorphic networks", 2020). Single carts may differ from left to right if the
    distribution of carts is symmetric.

    Half of a layer's units process the input and half, with the same weights, its mirror image. Their sum
    (even) and difference (odd) never mix in a linear layer, so each layer is two of half the width. A
    `reader` reads the observation, then its mirror image.
    """

    signs: Tensor

    def __init__(
        self,
        signs: Sequence[int],
        actions: int,
        hidden: Sequence[int],
        layer_norm: bool,
        reader: "FrameReader | None" = None,
    ) -> None:
        super().__init__()
        self.register_buffer("signs", torch.tensor(signs, dtype=torch.float32))
        self.reader = reader or nn.Identity()
        width = reader.width if reader else len(signs)
        layers: list[MirrorLayer] = []
        for size in hidden:
            layers.append(MirrorLayer(width, size // 2, layer_norm))
            width = size // 2
        self.layers = nn.ModuleList(layers)
        self.even_values = nn.Linear(width, actions)
        self.odd_values = nn.Linear(width, actions, bias=False)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the action values."""
        even, odd = halves(self.reader(observation), self.reader(observation * self.signs))
        for layer in self.layers:
            even, odd = layer(even, odd)
        same, opposite = self.even_values(even), self.odd_values(odd)
        return (same + same.flip(-1) + opposite - opposite.flip(-1)) / 2

    def plain_layers(self) -> list[PlainLayer]:
        """Return the numbers of each layer of an equal network without symmetry.

        Its layers have the features of the scene, then the features of its mirror image:

            even = (scene + image) / sqrt(2),  odd = (scene - image) / sqrt(2)
            W_even even + W_odd odd = A scene + B image
            A = (W_even + W_odd) / sqrt(2),    B = (W_even - W_odd) / sqrt(2)

        and B scene + A image for the mirror image. The sums are taken in float64. The two parts of a layer
        are normalized separately. Raises ConfigError for a recurrent network.
        """
        _check_not_recurrent(self.reader)
        layers, half = [], math.sqrt(0.5)
        for layer in self.layers:
            assert isinstance(layer, MirrorLayer)
            even, odd = half * _doubles(layer.even.weight), half * _doubles(layer.odd.weight)
            weight = np.block([[even + odd, even - odd], [even - odd, even + odd]])
            norm = [*layer.norm.parameters()]  # gain and shift
            layers.append([weight, *(np.tile(_doubles(each), 2) for each in (layer.even.bias, *norm))])
        even, odd = _doubles(self.even_values.weight), _doubles(self.odd_values.weight)
        bias = _doubles(self.even_values.bias)
        same, opposite = half / 2 * (even + even[::-1]), half / 2 * (odd - odd[::-1])
        layers.append([np.hstack((same + opposite, same - opposite)), (bias + bias[::-1]) / 2])
        of_scene, of_image = np.split(layers[0][0], 2, 1)  # the image is signs * observation
        layers[0][0] = of_scene + of_image * _doubles(self.signs)
        return [tuple(each.astype(np.float32) for each in layer) for layer in layers]


class FrameReader(nn.Module):
    """A gated recurrent unit that reads the last frames of an observation [..., K], oldest first.

    `frames` [T, F] holds the indices of the numbers of each frame. The state is zero before the oldest frame,
    so a policy carries nothing from step to step and the buffer holds all that a gradient needs (Hausknecht
    and Stone, "Deep recurrent Q-learning", 2015: random updates, T steps long). The output [..., width] is
    the last state and the numbers that are in no frame.
    """

    frames: Tensor
    rest: Tensor

    def __init__(self, observation_size: int, frames: Sequence[Sequence[int]], units: int) -> None:
        super().__init__()
        used = {place for frame in frames for place in frame}
        rest = [place for place in range(observation_size) if place not in used]
        self.register_buffer("frames", torch.tensor([list(frame) for frame in frames]))
        self.register_buffer("rest", torch.tensor(rest, dtype=torch.int64))
        self.cell = nn.GRUCell(len(frames[0]), units)
        self.width = units + len(rest)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the state after the newest frame, and the rest."""
        batch = observation.flatten(0, -2) if observation.ndim > 1 else observation.unsqueeze(0)
        state = batch.new_zeros(len(batch), self.cell.hidden_size)
        for frame in batch[:, self.frames].unbind(1):
            state = self.cell(frame, state)
        return torch.cat((state, batch[:, self.rest]), -1).reshape(*observation.shape[:-1], self.width)


class MirrorLayer(nn.Module):
    """A linear layer, layer normalization and ReLU on `units` units and on their mirror images."""

    def __init__(self, width: int, units: int, layer_norm: bool) -> None:
        super().__init__()
        self.even = nn.Linear(width, units)
        self.odd = nn.Linear(width, units, bias=False)
        self.norm = nn.LayerNorm(units) if layer_norm else nn.Identity()

    def forward(self, even: Tensor, odd: Tensor) -> tuple[Tensor, Tensor]:
        """Return the even and odd parts [..., units] from the parts of the previous layer, [..., width]."""
        same, opposite = self.even(even), self.odd(odd)
        scene = functional.relu(self.norm(same + opposite))
        image = functional.relu(self.norm(same - opposite))
        return halves(scene, image)


def halves(scene: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
    """Return sum and difference of features and their mirror image, scaled to keep the norm."""
    return (scene + image) * math.sqrt(0.5), (scene - image) * math.sqrt(0.5)


def _doubles(tensor: Tensor) -> NDArray[np.float64]:
    """Return the numbers of a tensor in float64."""
    return tensor.detach().cpu().double().numpy()


def _check_not_recurrent(reader: nn.Module) -> None:
    """Raise ConfigError for a network with a `FrameReader`."""
    if not isinstance(reader, nn.Identity):
        raise ConfigError("run: a recurrent agent (agent.recurrent) cannot be exported")
