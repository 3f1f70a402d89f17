"""Figures, animations, pages, tables and TensorBoard events of a run."""
