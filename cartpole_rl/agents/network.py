"""Q-networks: multilayer perceptrons, with or without the mirror symmetry of cart and pole.

Either may have a recurrent input layer that reads the last frames.

Layer normalization after each hidden layer keeps a trained agent from forgetting the swing-up
(Gallici et al., "Simplifying deep temporal difference learning", 2024).
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from cartpole_rl.agents.settings import AgentSettings


def q_network(
    settings: AgentSettings, mirror_signs: Sequence[int], actions: int, frames: Sequence[Sequence[int]]
) -> "QNetwork | MirrorQNetwork":
    """Return a new network of `settings` for observations of K numbers.

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


class MirrorQNetwork(nn.Module):
    """A QNetwork whose value of an action equals that of the mirrored action in the mirrored observation.

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
        """Return even and odd parts [..., units] of those of the previous layer, [..., width]."""
        same, opposite = self.even(even), self.odd(odd)
        scene = functional.relu(self.norm(same + opposite))
        image = functional.relu(self.norm(same - opposite))
        return halves(scene, image)


def halves(scene: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
    """Return sum and difference of features and their mirror image, scaled to keep the norm."""
    return (scene + image) * math.sqrt(0.5), (scene - image) * math.sqrt(0.5)
