"""Gives the tests of scripts/fuzz the fixture that runs a script."""

from bench_scripts import run as run
