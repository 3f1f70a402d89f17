"""The cart's physics: pure tensor functions of a state, a force and a batch of parameters."""
