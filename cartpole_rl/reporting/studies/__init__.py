"""Studies: questions that are answered by agents of several arms and seeds, and their results."""
