"""TorchRL environments over any plant: the hardware transform, and `make_env`."""
