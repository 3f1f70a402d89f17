"""A cart on a serial port, as a plant: the port, the link, the cart, and what readies it for an episode."""
