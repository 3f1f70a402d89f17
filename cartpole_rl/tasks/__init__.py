"""The tasks: features, rewards, scores and endings, as pure tensor functions."""
