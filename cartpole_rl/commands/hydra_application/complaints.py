"""Rewrites errors of Hydra, OmegaConf and the operating system as one line with the remedy."""

import difflib
import re
import sys
from collections.abc import Iterable, Sequence

import hydra
from hydra.errors import HydraException, OverrideParseException
from omegaconf import OmegaConf

from cartpole_rl.checking import no_such_setting, setting_names
from cartpole_rl.choices import conf_folder

HYDRA_OPTIONS = ("--config-", "--package", "--info", "--cfg", "--experimental-rerun")


def in_one_line(error: Exception, command: str) -> str:
    """Return the message of `error` for the user of cartpole-<command>."""
    if isinstance(error, OverrideParseException):
        return f"{error.override}: settings are given as key=value, lists as [1,2], text with signs in quotes"
    if isinstance(error, HydraException):
        return hydra_complaint(" ".join(str(error).split()), command)
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}"
    return next(iter(str(error).splitlines()), type(error).__name__)


def hydra_complaint(text: str, command: str) -> str:
    """Return Hydra's message, shorter where it is a frequent one."""
    if unknown := re.match(r"Could not override '([^']+)'", text):
        return no_such_setting(unknown[1], known_settings(command))
    if choice := re.search(r"Could not find '([^']+)' Available options in '([^']+)': (.*)", text):
        wrong = choice[1].removeprefix(f"{choice[2]}/")
        remedy = nearest_choice(wrong, choice[3].split(" Config search")[0].split())
        return f"{choice[2]}={wrong}: there is no such choice; {remedy}"
    if several := re.match(r"Ambiguous value for argument '([^']+)'", text):
        return f"{several[1]}: -m runs each of several values; a list is one value if written [a,b]"
    return text


def nearest_choice(wrong: str, choices: Sequence[str]) -> str:
    """Return a hint: the choice that was probably meant, and all choices."""
    near = difflib.get_close_matches(wrong, choices, 1)
    return (f"did you mean {near[0]}? " if near else "") + f"there are {', '.join(choices)}"


def known_settings(command: str) -> set[str]:
    """Return the settings of a command, composed with the choices on the command line if that is possible."""
    groups = [word for word in sys.argv[1:] if re.fullmatch(r"\w+=[\w.-]+", word)]
    for overrides in (groups, []):
        try:
            with hydra.initialize_config_dir(version_base="1.3", config_dir=str(conf_folder())):
                return setting_names(OmegaConf.to_container(hydra.compose(command, overrides), resolve=False))
        except HydraException:
            continue
    return set()


def dashed_setting(words: Iterable[str]) -> str | None:
    """Return the first word like `--seed=1`, which Hydra does not take."""
    dashed = (word for word in words if re.match(r"--?[A-Za-z_.]+=", word))
    return next((word for word in dashed if not word.startswith(HYDRA_OPTIONS)), None)
