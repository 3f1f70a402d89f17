"""The tasks: features, rewards, scores, starts and endings, as pure tensor functions."""
