"""Runs a verb of `cartpole_rl.cli`: from the command line to checked settings and the verb's function."""

import inspect
import logging
import os
import re
import shutil
import sys
import textwrap
import traceback
import warnings
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from io import TextIOWrapper
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from cartpole_rl import __version__
from cartpole_rl.checking import kinds, most_similar, similarity, validated
from cartpole_rl.choices import conf_folder, default_choices
from cartpole_rl.composition import as_mapping, hydra_overrides, is_completing, own_file_of, task_overrides
from cartpole_rl.errors import ConfigError
from cartpole_rl.exits import (
    EXPECTED,
    FAILED,
    Terminated,
    catch_signals,
    exit_after_signal,
    exit_with_message,
    job_signals,
    signal_behind,
)
from cartpole_rl.run_folder import CONFIG, RESUMABLE, has_ended, use_of
from cartpole_rl.settings import Settings
from cartpole_rl.sweeps import as_multirun, is_job, run_as_job, shown_jobs, sweep
from cartpole_rl.terminal import noting, program, shown, waiting

if TYPE_CHECKING:
    from cartpole_rl.cli import Verb

WHOLE_OPTIONS = ("help", "version", "cfg", "resolve", "package", "multirun", "info")
# Hydra's, each up to its first hyphen; without --run, which has no effect: a user means run=
HYDRA_OPTIONS = (*WHOLE_OPTIONS, "hydra", "shell", "config")
NEAR_OPTION = 0.7  # similarity from which an option is suggested; that of resume and resolve is 0.62
SHOWN = ("job", "hydra", "all")  # by --cfg


def run_command(name: str, verb: "Verb") -> None:
    """Run a verb with the words of the command line, and exit with a code after an error or a signal.

    The run folder is removed at the end if nothing was written to it.
    """
    given = [part for word in sys.argv[1:] for part in re.split("(?<=^--cfg)=", word)]
    schema: type[Settings] = verb.find(verb.settings)
    accept_all_characters()
    catch_signals()
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises its errors instead of printing them
    OmegaConf.register_new_resolver("help_page", partial(help_page, name, verb, schema), replace=True)
    try:
        if "--version" in given:
            print(f"cartpole_rl {__version__}")
            return
        if wrong := wrong_option(given):
            raise ConfigError(wrong)
        provide_config(name, schema)
        with hydra_overrides(name, as_multirun(given)) as (words, as_typed), sweep(name, schema):
            work = partial(run_job, name, verb, given, as_typed)
            for sys.argv[1:] in shown_jobs(name, words) or [words]:
                hydra.main(version_base="1.3", config_path=str(conf_folder()), config_name=name)(work)()
    except EXPECTED as error:
        exit_with_message(name, error, kinds(schema, "plant"))
    except ValueError as error:
        if not is_of_options(error):
            raise
        exit_with_message(name, ConfigError(str(error)))
    except (KeyboardInterrupt, Terminated) as signalled:
        exit_after_signal(name, signalled)


def run_job(
    name: str, verb: "Verb", given: Sequence[str], as_typed: dict[str, str], composed: DictConfig
) -> float | None:
    """Run a verb with composed settings, alone or as a job of a sweep; return its score."""
    sys.argv[1:] = given  # as typed, for provenance.json
    quieten()  # here, since a launcher may run the job in another process
    folder = Path(HydraConfig.get().runtime.output_dir)
    overrides = task_overrides(HydraConfig.get().overrides.task)
    words = [as_typed.get(word, word) for word in overrides if not is_completing(word)]

    def work() -> float | None:
        config = validated(verb.find(verb.settings), as_mapping(composed), partial(own_file_of, words=words))
        if verb.check:
            call(verb.find(verb.check), config=config, folder=folder, words=words)
        with waiting("starting"):  # PyTorch takes seconds to import
            function = verb.find(verb.function)
        return call(function, config=config, folder=folder, words=words)

    with job_signals(), noting(words):
        try:
            return run_as_job(name, folder, work) if is_job() else work()
        except (Exception, KeyboardInterrupt, Terminated) as raised:
            ended = raised if isinstance(raised, EXPECTED) else signal_behind(raised) or raised
            interrupted = isinstance(ended, (*FAILED, KeyboardInterrupt, Terminated))
            if interrupted and name in RESUMABLE and (folder / CONFIG).exists() and not has_ended(folder):
                ended.add_note(use_of(shown(folder), name))
            if isinstance(ended, EXPECTED) and not is_job():  # a sweep goes on, and names it at its end
                exit_with_message(name, ended)
            raise ended from None
        finally:
            remove_if_empty(folder, name)


def call(function: Any, **given: Any) -> Any:
    """Return the result of a function of some of these arguments."""
    taken = inspect.signature(function).parameters
    return function(**{name: value for name, value in given.items() if name in taken})


def provide_config(name: str, schema: type[Settings]) -> None:
    """Give Hydra the defaults of `schema` as the config of a verb without a file in conf/."""
    if not (conf_folder() / f"{name}.yaml").is_file() and f"{name}.yaml" not in ConfigStore.instance().repo:
        defaults = ["_self_", {"hydra/command": "any"}]
        ConfigStore.instance().store(name, {"defaults": defaults, **schema().model_dump(mode="json")})


def help_page(name: str, verb: "Verb", schema: type[Settings]) -> str:
    """Return the page of --help: what the verb does, examples, and the choices of the groups that it reads.

    Choices in folders of a user's own are listed too; plants that `schema` does not take are not.
    """
    pages = ", ".join(f"docs/{page}.md" for page in verb.pages.split())
    examples = [f"  {program(name)} {words}".rstrip() for words in verb.examples]
    parts = [f"{program(name)} {verb.about}\nRead {pages}.", "\n".join(["Examples", *examples])]
    loader = GlobalHydra.instance().config_loader()
    refused = {"plant": {*loader.get_group_options("plant")} - {*kinds(schema, "plant")}}
    lines = [
        f"  {group}: {', '.join(sorted({*loader.get_group_options(group)} - refused.get(group, set())))}"
        for group in sorted(default_choices(name))
    ]
    if lines:
        parts.append("\n".join(["Choices (group=choice)", *map(wrapped, lines)]))
    footer = f"{program(name)} --cfg job shows every setting and its value."
    if verb.has_run_folder:
        footer += "\n--config-dir adds a folder with your own choices. "
        footer += f"Results go to runs/{name}/,\nor to hydra.run.dir=<folder>."
    return "\n\n".join([*parts, f"{footer}\n"])


def wrapped(line: str) -> str:
    """Return a line of choices, wrapped where standard output is a narrow terminal."""
    if not sys.stdout.isatty():
        return line
    width = max(40, shutil.get_terminal_size().columns - 1)
    return textwrap.fill(line, width, subsequent_indent="    ", break_on_hyphens=False)


def wrong_option(words: Sequence[str]) -> str | None:
    """Return the message about the first word with dashes that Hydra does not take; None without one.

    It is a misspelt option, --cfg without its value, or a setting, like `--seed=1` or `--seed 1`; or a port.
    """
    for word, following in pairwise([*words, ""]):
        if word in ("--cfg", "-c") and following not in SHOWN:
            return f"{word}: give {word} job"
        name = word.partition("=")[0]
        if name == "--port" or (name in ("-p", "--package") and {"-c", "--cfg"}.isdisjoint(words)):
            return f"{word}: a port is given as plant=serial plant.port=/dev/ttyUSB0"
        dashed = re.fullmatch(r"--?([A-Za-z_.-]+)=.*|--([A-Za-z_.-]+)", word)
        name = dashed[1] or dashed[2] if dashed else ""
        if any(option.startswith(name) for option in HYDRA_OPTIONS):
            continue
        near = most_similar(name, WHOLE_OPTIONS)
        if similarity(name, near)[0] >= NEAR_OPTION:
            return f"{word}: did you mean --{near}?"
        if "-" not in name:  # as --config-dir has
            setting = word.lstrip("-")
            if "=" not in word:
                setting += "=..." if re.search("=|^--|^$", following) else f"={following}"
            return f"{word}: settings are given without dashes: {setting}"
    return None


def is_of_options(error: ValueError) -> bool:
    """Return True for what Hydra raises for options that exclude or need each other, as in -m --info."""
    return Path(traceback.extract_tb(error.__traceback__)[-1].filename).is_relative_to(
        Path(hydra.__file__).parent
    )


def accept_all_characters() -> None:
    """Let the output replace characters that its encoding lacks, as on a pipe of Windows."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


def quieten() -> None:
    """Silence messages of libraries that a user can do nothing about."""
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # read when TorchRL is imported
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # if it is imported already
    logging.getLogger("torch.utils.cpp_extension").setLevel(logging.ERROR)  # no CUDA compiler
    # tensordict 0.14 reads a setting that torch 2.15 deprecates
    warnings.filterwarnings("ignore", r"torch\._dynamo\.config\.inline_inbuilt_nn_modules", FutureWarning)


def remove_if_empty(folder: Path, name: str) -> None:
    """Remove a run folder if nothing was written to it, then runs/<name>/ and runs/ if they are empty."""
    if folder == Path.cwd():
        return
    runs = Path.cwd() / "runs"
    above = (runs / name, runs) if folder.parent == runs / name else ()
    with suppress(OSError):  # one is not empty
        for each in (folder, *above):
            each.rmdir()
