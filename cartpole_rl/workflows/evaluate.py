"""Drive whole episodes of a trained agent, in simulation or on a cart, and report their scores."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.evaluation.episodes import Policy, run_batch
from cartpole_rl.evaluation.metrics import same_as_host
from cartpole_rl.reporting.animation import side_by_side, write_animation
from cartpole_rl.reporting.episodes import report_episodes, summarized
from cartpole_rl.reporting.texts import count_text, cut_off, score_columns, score_table
from cartpole_rl.rig.hardware import nominal_hardware
from cartpole_rl.rig.parameters import PARAMETERS
from cartpole_rl.run_folder import (
    BASELINE,
    BESIDE_SIMULATION,
    FIGURES,
    METRICS,
    PRETRAINED,
    is_own_policy,
    program_of,
    write_config,
)
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.terminal import as_word, print_loop_time, print_results, shown, unless_closed, words_given
from cartpole_rl.workflows.config import EvaluateConfig
from cartpole_rl.workflows.episodes import Evaluation, Repetition, prepared
from cartpole_rl.workflows.poles import POLES, emulated_words, emulator_for, plant_words


def evaluate(config: EvaluateConfig, folder: Path) -> None:
    """Run episodes of the agent of `config.run`, in simulation or on a cart.

    Writes into `folder` config.yaml, provenance.json, metrics.json and figures/, also after an interruption,
    and prints the scores. Raises ConfigError and CheckpointError for settings, PlantError and LinkError for a
    cart that fails.
    """
    evaluation = prepared(config)
    episodes: list[Episode] = []
    onboard: list[Episode] = []
    try:
        with closing(evaluation.env):
            evaluation.print_notes("evaluate")
            evaluation.check_board()
            settings = evaluation.settings.model_dump(mode="json")
            content = {**evaluation.config.model_dump(mode="json"), "evaluated": settings}
            write_config(folder, "evaluate", content, agent=evaluation.agent_content)
            for episode in evaluation.episodes():
                episodes.append(episode)
            if config.drives_on_board:
                for episode in evaluation.onboard_episodes():
                    onboard.append(episode)
    except BaseException:  # after a broken link or Ctrl-C, the episodes until then are reported
        if episodes:
            with unless_closed():
                report_evaluation(evaluation, episodes, onboard, folder, next_command=None)
        raise
    report_evaluation(evaluation, episodes, onboard, folder, next_command(evaluation))


def report_evaluation(
    evaluation: Evaluation,
    episodes: Sequence[Episode],
    onboard: Sequence[Episode],
    folder: Path,
    next_command: str | None,
) -> None:
    """Print the scores, and write metrics.json and figures/; `onboard` are those that the board drove."""
    plant, settings = evaluation.config.plant.kind, evaluation.settings
    link = evaluation.env.plant.link_figures()
    mp4 = evaluation.config.animation.mp4
    heading = f"plant={plant}, {count_text(len(episodes))}"
    track = settings.nominal_cart["track_half_length"]
    summary, _ = summarized(episodes, track)
    try:
        report_episodes(
            folder, episodes, plant, settings.pole, settings.task, track, link, onboard=onboard, mp4=mp4
        )
    finally:  # figures can fail, and so can printing, which then hides no other error
        with unless_closed():
            if onboard:
                by_board, _ = summarized(onboard, track)
                print(score_columns({"this computer": summary, "on the board": by_board}, heading))
                print(same_motors(onboard))
            else:
                print(score_table(summary, heading))
    if settings.guard.active:
        print(f"track guard: {settings.guard.active}")
    for line in cut_off([*episodes, *onboard]):
        print(line)
    if evaluation.config.animation.simulation:
        print(draw_beside_simulation(evaluation, episodes[0], folder / FIGURES / BESIDE_SIMULATION))
    if evaluation.repetition:
        print(compared(evaluation.repetition, episodes[0]))
    print_loop_time(link.get("latency_override"))
    print_results(folder, f"{METRICS} and {FIGURES}/", next_command)


def same_motors(onboard: Sequence[Episode]) -> str:
    """Return a line that compares the motor values of the board with those of the agent here."""
    same, count = (sum(column) for column in zip(*map(same_as_host, onboard), strict=True))
    steps = sum(episode.steps for episode in onboard)
    line = f"on the board: {same} of {count} motor values are those that this computer would have sent"
    return f"{line}; {steps - count} more were not compared (docs/firmware.md)" if count < steps else line


def next_command(evaluation: Evaluation) -> str:
    """Return the command of docs/first-hour.md that follows, for the same cart."""
    config, known = evaluation.config, evaluation.known_poles
    run, plant = as_word("run", shown(config.run)), plant_words(config.plant, config.emulator, known)
    if config.run == BASELINE:
        of_cart = words_given("cart", "pole", "control_period")
        if evaluation.settings.hardware == nominal_hardware():
            return " ".join(["cartpole-train", *(of_cart or ["experiment=medium"])])
        pole = evaluation.settings.pole  # no ranges are known that hold this cart: it is measured
        of_cart += [] if words_given("pole") else [f"pole={emulator_for([pole]) or '<yours>.yaml'}"]
        if not config.plant.is_on_port:
            own = pole.name not in POLES
            plant = "plant=emulated emulator=<yours>.yaml" if own else emulated_words([pole])
        return " ".join(["cartpole-identify", *of_cart, plant])
    if is_own_policy(config.run):  # what a trained agent has from its checkpoint
        run = " ".join([run, *words_given("cart", "observation", "actions", "control_period")])
    if not config.plant.is_on_port:
        poles = known if config.pole is None and known else [evaluation.settings.pole]
        return f"cartpole-evaluate {run} {emulated_words(poles)}"
    if is_own_policy(config.run) or program_of(config.run) == "finetune":
        return f"cartpole-record {run} {plant}"
    if program_of(config.run) is not None or config.run.parts[0] != PRETRAINED:
        return f"cartpole-finetune {run} {plant}"
    if evaluation.settings.task.evaluation_start != evaluation.training.task.evaluation_start:
        return f"cartpole-evaluate {run} guard=careful {plant} episodes=1"
    on_cart, emulator = evaluation.settings.pole, config.emulator
    stated = config.pole is not None or config.plant.known_pole_length(emulator) is not None
    stated &= config.plant.own_pole(emulator, on_cart) is None  # an emulated cart has the agent's pole
    named = emulator_for([on_cart] if stated else known)
    return f"cartpole-identify {plant} pole={named or '<yours>.yaml'}"


def compared(again: Repetition, episode: Episode) -> str:
    """Return a line that compares the score with that of the repeated episode."""
    repeat, score = again.config.repeat, float(episode.score.sum())
    then = f"episode {repeat.episode} of {repeat.run} had score {again.score:.1f}"
    noises = (each.name for each in PARAMETERS.values() if each.noise)
    if by_chance := ", ".join(name for name in noises if again.origin.parameters[name] != 0):
        return f"{then}, now {score:.1f}: {by_chance} is random, so the episode cannot be repeated exactly"
    return f"{then}, now {'exactly the same' if score == again.score else f'{score:.1f}'}"


def draw_beside_simulation(evaluation: Evaluation, episode: Episode, path: Path) -> str:
    """Draw `episode` and its prediction into `path`, and return a line that compares their scores."""
    assert evaluation.simulation is not None
    predicted = predicted_episode(evaluation.simulation, evaluation.policy, episode)
    titles = f"plant={evaluation.config.plant.kind}", "predicted by simulation"
    pole, track = evaluation.settings.pole.nominal.length, evaluation.settings.task.x_max
    pictures, times = side_by_side((episode, predicted), titles, pole, track)
    write_animation(path, pictures, times, evaluation.config.animation.mp4)
    scores = f"score {episode.score.sum():z.0f}, predicted by simulation {predicted.score.sum():z.0f}"
    return f"first episode: {scores}; {path.name} shows both"


def predicted_episode(env: CartPoleEnv, policy: Policy, episode: Episode) -> Episode:
    """Return an episode of `policy` on the simulated cart of `env`, from the measured start of `episode`."""
    names = ("x", "x_dot", "theta", "theta_dot")
    env.plant.start_from({name: float(getattr(episode, name)[0]) for name in names})
    (predicted,) = run_batch(env, policy)
    return predicted
