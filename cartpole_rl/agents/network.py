"""The Q-network: a multilayer perceptron, with layer normalization or without."""

from collections.abc import Sequence

from torch import Tensor, nn


class QNetwork(nn.Module):
    """Observation [..., K] float32 to one value an action [..., A].

    Layer normalization after each hidden layer keeps a learned swing-up from being unlearned
    (Gallici et al., "Simplifying Deep Temporal Difference Learning", 2024).
    """

    def __init__(self, observation_size: int, actions: int, hidden: Sequence[int], layer_norm: bool) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width = observation_size
        for size in hidden:
            layers.append(nn.Linear(width, size))
            if layer_norm:
                layers.append(nn.LayerNorm(size))
            layers.append(nn.ReLU())
            width = size
        self.layers = nn.Sequential(*layers, nn.Linear(width, actions))

    def forward(self, observation: Tensor) -> Tensor:
        """Values of the actions."""
        return self.layers(observation)
