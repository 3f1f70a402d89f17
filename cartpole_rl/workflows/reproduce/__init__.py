"""Reproduction of studies: every run of a study in its folder, resumable, several at a time."""
