"""The commands: compose, build, run, save. The only place that knows Hydra."""
