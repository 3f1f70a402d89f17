"""The commands: a row for each verb. `cartpole-train` and `cartpole train` run `VERBS["train"]`.

A new verb is a module of its own and a row here: a settings class, a function of its settings, and the page
that --help prints. The function may also take `folder`, the run folder, and `words`, the overrides as given;
it may return a score, which a sweep maximizes. `check` takes the same, and runs before the module of the
function is imported. conf/<verb>.yaml holds the values of the settings; without it, they are the defaults of
the class. An entry point in pyproject.toml gives the verb a program of its own.
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from cartpole_rl.scheduling import imported
from cartpole_rl.terminal import program

INTERRUPTED = 130  # exit code after Ctrl-C


class Verb(NamedTuple):
    """One row. Objects are given, or named by their places in this package: "module:name"."""

    settings: Any
    function: Any
    about: str  # after the name of the program
    pages: str  # in docs/
    examples: tuple[str, ...]  # after the name of the program
    check: Any = ""
    has_run_folder: bool = True

    @staticmethod
    def find(place: Any) -> Any:
        """Return the object at "module:name" of this package, or the object that is given."""
        if not isinstance(place, str):
            return place
        module, _, name = place.partition(":")
        return imported(f"cartpole_rl.{module}", name)


VERBS: dict[str, Verb] = {
    "train": Verb(
        "workflows.config:TrainConfig",
        "workflows.train:train",
        "trains an agent in randomized simulation. `tensorboard --logdir runs` shows its progress.",
        "learning randomization sweeps",
        (
            "pole=large randomization=friction_6 learning.transitions=2000000 seed=1",
            "-m randomization=friction_3,friction_6,friction_12 seed=0,1",
            "resume=runs/train/2026-11-21_12-00-00",
        ),
        "workflows.checks:check_training",
    ),
    "evaluate": Verb(
        "workflows.config:EvaluateConfig",
        "workflows.evaluate:evaluate",
        "runs whole episodes of a trained agent, in simulation or on a cart, and scores them.",
        "learning first-hour",
        (
            "run=pretrained/medium plant=emulated animation.simulation=true",
            "run=runs/train/2026-11-21_12-00-00 episodes=20 'parameters={cart_coulomb:0.8}'",
            "run=runs/train/2026-11-21_12-00-00 plant=serial plant.port=/dev/ttyUSB0 view=web",
        ),
        "workflows.checks:check_evaluation",
    ),
    "finetune": Verb(
        "workflows.config:FinetuneConfig",
        "workflows.finetune:finetune",
        "continues to train an agent on the cart that it drives, and keeps the better policy.\n"
        "learner=ray learner.address=<host>:6379 lets another machine learn; see docs/two-machines.md.",
        "fine-tuning two-machines",
        (
            "run=runs/train/2026-11-21_12-00-00 plant=serial plant.port=/dev/ttyUSB0 view=live",
            "run=runs/train/2026-11-21_12-00-00 plant=emulated emulator.cart_viscous=2 episodes=10",
            "resume=runs/finetune/2026-11-21_12-30-00    continues after Ctrl-C or a power cut",
        ),
        "workflows.checks:check_tuning",
    ),
    "identify": Verb(
        "workflows.config:IdentifyConfig",
        "workflows.identify:identify_cart",
        "measures the parameters of a cart in four minutes of experiments.\n"
        "It prints the command that trains on the result, with the friction models that it found:\n"
        "  cartpole-train cart=<run>/cart.yaml pole=<run>/pole.yaml "
        "randomization=<run>/randomization.yaml \\\n"
        "      cart_friction=stribeck pole_friction=bearing",
        "identification",
        (
            "plant=serial plant.port=/dev/ttyUSB0 pole=medium",
            "plant=emulated emulator.cart_viscous=2",
            "from=runs/identify/2026-11-21_12-00-00",
        ),
        "workflows.checks:check_identification",
    ),
    "model": Verb(
        "workflows.config:ModelConfig",
        "workflows.model:learn_model",
        "learns from recordings what the identified physics does not explain.\n"
        "Train on the result: cartpole-train plant=learned plant.model=<run>",
        "learned-model",
        (
            "from=runs/record/2026-11-21_12-00-00",
            "'from=[runs/record/2026-11-21_12-00-00,runs/record/2026-11-21_12-30-00]' seed=1",
            "from=runs/identify/2026-11-21_12-00-00 ensemble.members=3 ensemble.updates=100",
        ),
        "workflows.checks:check_modelling",
    ),
    "record": Verb(
        "workflows.config:RecordConfig",
        "workflows.record:record",
        "runs whole episodes of an agent on any cart and writes each to recordings/episode_000.csv.",
        "identification learned-model",
        (
            "run=runs/train/2026-11-21_12-00-00 plant=serial plant.port=/dev/ttyUSB0 episodes=5",
            "run=runs/train/2026-11-21_12-00-00 plant=emulated emulator.latency=0.02",
            "run=lqr pole=large      the baseline: energy swing-up and LQR",
        ),
        "workflows.checks:check_evaluation",
    ),
    "import": Verb(
        "identification.settings:ImportConfig",
        "workflows.import_logs:import_logs",
        "converts logs of any cart to recordings, and reports what is doubtful about them.\n"
        "A layout names the columns, their units and their signs.\n"
        "Recordings that cartpole-export wrote come back as they were.",
        "identification",
        (
            "from=logs/ layout=sensorsini_2022",
            "from=log.csv layout.time.name=t layout.angle.unit=deg layout.motor.full=255",
            "from=runs/export/2026-11-21_12-00-00/episode_000.mcap",
        ),
        "workflows.checks:check_import",
    ),
    "replay": Verb(
        "workflows.config:ReplayConfig",
        "workflows.replay:replay_recordings",
        "compares the simulated cart with recordings.\n"
        "It drives the cart with the recorded motor values and shows the deviations.",
        "identification",
        (
            "from=runs/record/2026-11-21_12-00-00",
            "from=runs/record/2026-11-21_12-00-00/recordings/episode_000.csv pole=large",
            "from=runs/record/2026-11-21_12-00-00 'parameters={cart_coulomb:0.8}' cart_friction=step",
        ),
        "workflows.checks:check_replay",
    ),
    "report": Verb(
        "workflows.config:ReportConfig",
        "workflows.report:make_report",
        "makes one HTML page from run folders.",
        "reports",
        (
            "runs=runs/train/2026-11-21_12-00-00_multirun",
            "'runs=\"runs/evaluate/2026-11-2*\"' measure=upright_fraction format=csv",
            "'runs=[runs/train/a,runs/train/b]' 'compare=\"runs/train/2026-11-22*\"'",
        ),
    ),
    "export": Verb(
        "workflows.config:ExportConfig",
        "workflows.export:export",
        "writes a trained agent or recordings for other programs, or a cart for its firmware.\n"
        "  format=weights    agent.npz: the weights and all that a program needs to drive a cart with them\n"
        "  format=onnx       agent.onnx, for an ONNX runtime\n"
        "  format=c          policy.h and policy.c, for a microcontroller\n"
        "  format=web        cart.html, a page where the agent drives a cart that you push\n"
        "  format=firmware   cart_rig.h, the numbers of cart= and pole=, which the firmware is built with\n"
        "  format=minari     recordings as a data set of Minari, for offline reinforcement learning\n"
        "  format=mcap       recordings as files that Foxglove opens",
        "exporting",
        (
            "run=pretrained/medium format=web",
            "format=firmware cart=ip02",
            "format=mcap from=runs/record/2026-11-21_12-00-00",
        ),
        "workflows.checks:check_export",
    ),
    "distill": Verb(
        "workflows.config:DistillConfig",
        "workflows.distill:distill",
        "trains a small network to drive like an agent, for a small processor.",
        "exporting",
        (
            "run=runs/train/2026-11-21_12-00-00",
            "run=pretrained/medium hidden=[16,16] distillation.updates=1000",
            "-m run=pretrained/medium seed=0,1,2",
        ),
        "workflows.checks:check_distillation",
    ),
    "preflight": Verb(
        "workflows.config:PreflightConfig",
        "workflows.preflight:check_cart",
        "checks a cart by small moves and refuses it if its wiring, limits or delays are wrong.\n"
        "The cart homes and then moves a few centimetres about the middle. Let the pole hang.",
        "first-hour my-cart safety",
        (
            "plant=serial plant.port=/dev/ttyUSB0",
            "plant=serial plant.port=auto      the only cart that is plugged in",
            "plant=emulated emulator.deadband_right=90",
        ),
        has_run_folder=False,
    ),
    "emulate": Verb(
        "workflows.emulate:EmulateConfig",
        "workflows.emulate:emulate",
        "runs the emulated cart until it is interrupted.\nIt prints one line of JSON with the port to open.",
        "emulator",
        (
            "emulator.clock=real",
            "emulator=large emulator.seed=3",
            "emulator.latency=0.02 emulator.cart_coulomb_left=0.8",
        ),
        has_run_folder=False,
    ),
    "find_port": Verb(
        "workflows.find_port:FindPortConfig",
        "workflows.find_port:find_port",
        "lists the USB serial ports and names the one that is probably the cart.",
        "first-hour",
        (
            "",
            "watch=true                unplug the cart or plug it in: names the port that changes",
            "watch=true timeout=120    waits two minutes for it",
        ),
        has_run_folder=False,
    ),
}


def run(verb: str) -> None:
    """Run a verb with the words of the command line."""
    try:
        from cartpole_rl.command import run_command  # imports Hydra

        run_command(verb, VERBS[verb])
    except KeyboardInterrupt:  # before `run_command` handles it
        sys.exit(INTERRUPTED)


def main() -> None:
    """Run `cartpole <verb> ...`; without a verb, list the verbs. Refuse another one in a line."""
    first = sys.argv[1] if len(sys.argv) > 1 else "--help"
    verb = first.replace("-", "_")
    if verb in VERBS:
        sys.argv[:2] = [program(verb)]
        run(verb)
        return
    if first not in ("--help", "-h"):
        from cartpole_rl.checking import nearest_choice  # imports pydantic

        verbs = [name.replace("_", "-") for name in VERBS]
        print(f"cartpole: {first}: there is no such verb; {nearest_choice(first, verbs)}", file=sys.stderr)
        sys.exit(2)
    lines = (f"  {name.replace('_', '-'):12}{row.about.splitlines()[0]}" for name, row in VERBS.items())
    print("cartpole <verb> ..., as `cartpole train --help`. The verbs:", *lines, sep="\n")


def __getattr__(verb: str) -> Callable[[], None]:
    """Return the program of a verb, for its entry point: `cartpole_rl.cli:train`, or `:import_`."""
    verb = verb.rstrip("_")
    if verb in VERBS:
        return partial(run, verb)
    raise AttributeError(f"module {__name__} has no attribute {verb!r}")


if __name__ == "__main__":
    main()
