"""The commands: compose, check, call one workflow. Only this package imports Hydra."""
