"""The search for the best score on a simulated cart, with full knowledge of it; see reference.py."""
