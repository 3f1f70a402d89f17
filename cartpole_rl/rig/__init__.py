"""The parameters and the hardware of a cart."""
