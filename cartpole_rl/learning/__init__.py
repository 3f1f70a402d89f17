"""Learning: replay, collection, updates, the training loop, and checkpoints."""
