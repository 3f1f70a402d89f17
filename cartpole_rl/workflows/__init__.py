"""The work of each command as functions of checked settings and a folder: the Python API, free of Hydra."""
