"""TorchRL environments over any plant: the hardware transform, and `build` that puts them together."""
