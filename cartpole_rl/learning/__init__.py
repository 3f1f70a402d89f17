"""Learning: replay buffer, collection, updates, the training loop, and checkpoints."""
