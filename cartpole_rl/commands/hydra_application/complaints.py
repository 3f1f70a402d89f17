"""Rewrites errors of Hydra, OmegaConf and the operating system as one line with the remedy."""

import re
import sys
from collections.abc import Mapping, Sequence
from itertools import pairwise

import hydra
from hydra.errors import HydraException, OverrideParseException
from omegaconf import OmegaConf

from cartpole_rl.checking import (
    NEAR_VALUE,
    most_similar,
    no_such_setting,
    of_another_choice,
    setting_names,
    similarity,
)
from cartpole_rl.choices import conf_folder, default_choices, group_choices
from cartpole_rl.files import FULL

WHOLE_OPTIONS = ("help", "version", "cfg", "resolve", "package", "multirun", "info")
# Hydra's, each up to its first hyphen; without --run, which has no effect: a user means run=
HYDRA_OPTIONS = (*WHOLE_OPTIONS, "hydra", "shell", "config")
NEAR_OPTION = 0.7  # similarity from which an option is suggested; that of resume and resolve is 0.62
SHOWN = ("job", "hydra", "all")  # by --cfg
WHOLE = ("experiment", "sweep")  # groups without settings of their own: they change those of others
EXTRAS = {  # of the package, that bring launchers and a sweeper
    "hydra/launcher/joblib": "joblib",
    "hydra/launcher/submitit_local": "submitit",
    "hydra/launcher/submitit_slurm": "submitit",
    "hydra/launcher/ray": "ray",
    "hydra/sweeper/optuna": "optuna",
}


def in_one_line(error: Exception, command: str) -> str:
    """Return the message of `error` for the user of cartpole-<command>."""
    if isinstance(error, OverrideParseException):
        return (
            f"{error.override}: settings are given as key=value, lists as [1,2], "
            "text with special characters in quotes"
        )
    if isinstance(error, HydraException):
        return hydra_complaint(" ".join(str(error).split()), command)
    if isinstance(error, OSError):
        return file_complaint(error)
    return next(iter(str(error).splitlines()), type(error).__name__)


def file_complaint(error: OSError) -> str:
    """Return the file, what is wrong with it and, for a full disk, the remedy."""
    remedy = "; make room, or give hydra.run.dir= a folder on another disk" if error.errno in FULL else ""
    return f"{error.filename or 'a file was not written'}: {error.strerror}{remedy}"


def hydra_complaint(text: str, command: str) -> str:
    """Return Hydra's message, shorter where it is a frequent one."""
    if unknown := re.match(r"Could not override '([^']+)'", text):
        group, groups = unknown[1].partition(".")[0], default_choices(command)
        if group not in groups and (conf_folder() / group).is_dir():
            return f"{unknown[1]}: cartpole-{command.replace('_', '-')} does not read this group"
        if group in without_choice(groups):
            known = ", ".join(group_choices(group))
            return f"{unknown[1]}: {group} is not chosen, so it has no settings; give {group}= too: {known}"
        if owners := choices_with(unknown[1], command):
            return of_another_choice(unknown[1], owners)
        return no_such_setting(unknown[1], known_settings(command))
    if choice := re.search(r"Could not find '([^']+)' Available options in '([^']+)': (.*)", text):
        wrong = choice[1].removeprefix(f"{choice[2]}/")
        if extra := EXTRAS.get(choice[1]):
            return f'{choice[2]}={wrong} needs the extra {extra}: pip install "cartpole_rl[{extra}]"'
        remedy = nearest_choice(wrong, choice[3].split(" Config search")[0].split())
        return f"{choice[2]}={wrong}: there is no such choice; {remedy}"
    if several := re.match(r"Ambiguous value for argument '([^']+)'", text):
        return f"{several[1]}: -m runs each of several values; a list is one value if written [a,b]"
    return text


def without_choice(groups: Mapping[str, str | None]) -> set[str]:
    """Return those of `groups` that have settings of their own and are not chosen."""
    given = {word.partition("=")[0] for word in sys.argv[1:]}
    return {name for name, default in groups.items() if default is None} - given - {*WHOLE}


def nearest_choice(wrong: str, choices: Sequence[str]) -> str:
    """Return a hint: the choice that was probably meant, and all choices."""
    near = most_similar(wrong, choices)
    hint = f"did you mean {near}? " if similarity(wrong, near)[0] >= NEAR_VALUE else ""
    return f"{hint}there are {', '.join(choices)}"


def choices_with(setting: str, command: str) -> list[str]:
    """Return the choices of the setting's group with which a command has the setting."""
    group, _, rest = setting.partition(".")
    known = rest and group in default_choices(command) and group not in WHOLE
    choices = group_choices(group) if known else ()
    return [name for name in choices if setting in composed_settings(command, [f"{group}={name}"])]


def known_settings(command: str) -> set[str]:
    """Return the settings of a command, composed with the choices on the command line if that is possible."""
    groups = [word for word in sys.argv[1:] if re.fullmatch(r"\w+=[\w.-]+", word)]
    return composed_settings(command, groups) or composed_settings(command, [])


def composed_settings(command: str, overrides: list[str]) -> set[str]:
    """Return the settings of a command, composed with `overrides`; none if Hydra refuses one of them."""
    try:
        with hydra.initialize_config_dir(version_base="1.3", config_dir=str(conf_folder())):
            return setting_names(OmegaConf.to_container(hydra.compose(command, overrides), resolve=False))
    except HydraException:
        return set()


def wrong_option(words: Sequence[str]) -> str | None:
    """Return the message about a misspelt option of Hydra or --cfg without its value; None without one."""
    for word, following in pairwise([*words, ""]):
        if word in ("--cfg", "-c") and following not in SHOWN:
            return f"{word}: give {word} job"
        name = word.removeprefix("--")
        if name == word or any(option.startswith(name) for option in HYDRA_OPTIONS):
            continue
        near = most_similar(name, WHOLE_OPTIONS)
        if similarity(name, near)[0] >= NEAR_OPTION:
            return f"{word}: did you mean --{near}?"
    return None


def dashed_setting(words: Sequence[str]) -> str | None:
    """Return the message about the first word like `--seed=1` or `--seed 1`, which Hydra does not take."""
    for word, following in pairwise([*words, ""]):
        dashed = re.fullmatch(r"--?([A-Za-z_.]+)=.*", word) or re.fullmatch(r"--([A-Za-z_.]+)", word)
        if dashed and not any(option.startswith(dashed[1]) for option in HYDRA_OPTIONS):
            setting = word.lstrip("-")
            if "=" not in word:
                setting += "=..." if re.search("=|^--|^$", following) else f"={following}"
            return f"{word}: settings are given without dashes: {setting}"
    return None
