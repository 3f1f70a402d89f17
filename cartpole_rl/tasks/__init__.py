"""What is asked of a cart: features, rewards, scores, starts and endings, as pure tensor functions."""
