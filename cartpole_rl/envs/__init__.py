"""TorchRL environments over either plant: the hardware transform, and what puts the two together."""
