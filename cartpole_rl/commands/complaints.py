"""What Hydra, OmegaConf and the operating system complain about, in one line with what would be right."""

import re
import sys
from collections.abc import Iterable

import hydra
from hydra.errors import HydraException, OverrideParseException
from omegaconf import OmegaConf

from cartpole_rl.checking import no_such_setting, setting_names
from cartpole_rl.choices import conf_folder

HYDRA_OPTIONS = ("--config-", "--package", "--info", "--cfg", "--experimental-rerun")


def in_one_line(error: Exception, command: str) -> str:
    """`error` as the user of cartpole-<command> should read it."""
    if isinstance(error, OverrideParseException):
        return f"{error.override}: settings are given as key=value, lists as [1,2], text with signs in quotes"
    if isinstance(error, HydraException):
        return hydra_complaint(" ".join(str(error).split()), command)
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}"
    return next(iter(str(error).splitlines()), type(error).__name__)


def hydra_complaint(text: str, command: str) -> str:
    """Hydra's message, put shorter where it is one of those that users meet."""
    if unknown := re.match(r"Could not override '([^']+)'", text):
        return no_such_setting(unknown[1], known_settings(command))
    if choice := re.search(r"Could not find '([^']+)' Available options in '([^']+)': (.*)", text):
        wrong = choice[1].removeprefix(f"{choice[2]}/")
        there_are = choice[3].split(" Config search")[0].split()
        return f"{choice[2]}={wrong}: there is no such choice; there are {', '.join(there_are)}"
    if several := re.match(r"Ambiguous value for argument '([^']+)'", text):
        return f"{several[1]}: -m runs each of several values; a list is one value if written [a,b]"
    return text


def known_settings(command: str) -> set[str]:
    """Settings of a command, with the choices on the command line as far as they can be composed."""
    groups = [word for word in sys.argv[1:] if re.fullmatch(r"\w+=[\w.-]+", word)]
    for overrides in (groups, []):
        try:
            with hydra.initialize_config_dir(version_base="1.3", config_dir=str(conf_folder())):
                return setting_names(OmegaConf.to_container(hydra.compose(command, overrides), resolve=False))
        except HydraException:
            continue
    return set()


def dashed_setting(words: Iterable[str]) -> str | None:
    """The first word that looks like `--seed=1`, which other programs take and Hydra does not."""
    dashed = (word for word in words if re.match(r"--?[A-Za-z_.]+=", word))
    return next((word for word in dashed if not word.startswith(HYDRA_OPTIONS)), None)
