"""Pictures of a cart, its pole and its track, and the colours that they share with the figures."""
