"""Distill a trained agent into a smaller network, for a small processor.

The student learns the action values of its teacher. The states are those that both visit on simulated carts:
cloned from the teacher's states alone, a student does not learn to correct its own errors (Ross et al., "A
reduction of imitation learning and structured prediction to no-regret online learning", DAgger, 2011).
"""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import mean

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn.functional import smooth_l1_loss

from cartpole_rl.checking import validated
from cartpole_rl.envs.build import simulated_env, with_fitted_guard
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import LearningError
from cartpole_rl.evaluation.driving_policy import DrivingPolicy
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.checkpoints import AgentCheckpoint, save_agent
from cartpole_rl.learning.settings import DistillationSettings, half_cosine
from cartpole_rl.learning.states import seed_everything
from cartpole_rl.reporting.episodes import report_episodes
from cartpole_rl.run_folder import CHECKPOINTS, FIGURES, LAST, METRICS, write_config
from cartpole_rl.terminal import as_word, print_message, print_results, progress_bar, shown
from cartpole_rl.workflows.build import new_agent, provenance, trained_agent, use_threads
from cartpole_rl.workflows.config import DistillConfig, TrainConfig
from cartpole_rl.workflows.train import judge, nominal_env

LAST_RATE = 0.03  # share of the learning rate at the end
Driver = Callable[[TensorDictBase], TensorDictBase]  # from `observation` to `action` and `action_value`


def distill(config: DistillConfig, folder: Path) -> float:
    """Train a network of `config.hidden` to drive as the agent of `config.run` does; return its score.

    The carts are those of the agent's training. Writes into `folder` config.yaml, which has the provenance
    of the teacher as well, provenance.json, checkpoints/last.pt, metrics.json and figures/. Raises
    CheckpointError for a missing or damaged agent, ConfigError for impossible settings or a folder that
    already holds a run, LearningError if it diverges.
    """
    use_threads(config.threads)
    seed_everything(config.seed)
    teacher = trained_agent(config.run)
    training = student_settings(teacher.training, config)
    student = new_agent(training)
    carts, start = config.distillation.carts, training.task.start
    env = simulated_env(training, training.plant, carts, start, config.seed)
    settings, origin = training.model_dump(mode="json"), provenance(config.run, teacher)
    content = {**config.model_dump(mode="json"), "student": settings, "teacher": origin}
    write_config(folder, "distill", content)
    assert isinstance(teacher.policy, nn.Module)
    taught, driver = DrivingPolicy(teacher.policy), DrivingPolicy(student.greedy_policy())
    distillation = Distillation(config.distillation, taught, student, driver, env, config.seed)
    with progress_bar(config.distillation.rounds, "rounds") as progress:
        for loss in distillation.run():
            progress.set_postfix_str(f"loss {loss:.3f}", refresh=False)
            progress.update()
    episodes = judge(nominal_env(training), student.greedy_policy(), config.seed)
    score = mean([episode.total(training.task.measure) for episode in episodes])
    tuned_poles = [poles.model_dump(mode="json") for poles in teacher.known_poles[1:]]
    agent = AgentCheckpoint(settings, student.state_dict(), distillation.transitions, score, tuned_poles)
    if tuned_poles:
        print_message("distill", "note: the teacher was fine-tuned on a pole that the student did not see")
    save_agent(folder / CHECKPOINTS / LAST, agent)
    track = training.nominal_cart["track_half_length"]
    report_episodes(folder, episodes, training.plant.kind, training.pole, training.task, track)
    print(f"a network of {list(config.hidden)} hidden units scores {score:z.0f}")
    files = f"{METRICS}, {FIGURES}/ and {CHECKPOINTS}/"
    print_results(folder, files, f"cartpole-export {as_word('run', shown(folder))} format=c")
    return score


def student_settings(training: TrainConfig, config: DistillConfig) -> TrainConfig:
    """Return the settings of the teacher's training with the student's network. Raises ConfigError."""
    network = {"hidden": config.hidden, "recurrent": None, "kind": "dqn", "network": "mlp"}
    agent = training.agent.model_dump() | network
    own = {"agent": agent, "seed": config.seed, "compile": False, "device": "cpu"}
    values = {**training.model_dump(mode="json"), **own}
    return with_fitted_guard(validated(TrainConfig, values))


class Distillation:
    """The distillation of the policy `teacher` into `student`, whose greedy policy is `driver`.

    On the carts of `env`: the teacher drives every other one, the student the rest from the second round on.
    """

    def __init__(
        self,
        settings: DistillationSettings,
        teacher: Driver,
        student: QAgent,
        driver: Driver,
        env: CartPoleEnv,
        seed: int,
    ) -> None:
        self.settings, self.student, self.env = settings, student, env
        self._teacher, self._driver = teacher, driver
        self._random = torch.Generator().manual_seed(seed)
        self._by_student = torch.arange(env.plant.carts) % 2 == 0
        self._observations: list[Tensor] = []  # [N, K] for each period
        self._values: list[Tensor] = []  # [N, A], the teacher's
        weights = [weight for weight in student.actor.parameters() if weight.requires_grad]
        self._optimizer = torch.optim.Adam(weights, lr=settings.learning_rate, fused=True)

    @property
    def transitions(self) -> int:
        """Observations so far."""
        return sum(map(len, self._observations))

    def run(self) -> Iterator[float]:
        """Visit states and learn in turn; yield the mean loss of each round. Raises LearningError."""
        current = self.env.reset()
        for number in range(self.settings.rounds):
            current = self._visit(current, first=number == 0)
            yield self._learn(number)

    @torch.no_grad()
    def _visit(self, current: TensorDictBase, first: bool) -> TensorDictBase:
        """Drive all carts for a round, note what the teacher would do, and return the last frame."""
        carts, actions = self.env.plant.carts, len(self.env.hardware.motors)
        for _ in range(self.settings.periods):
            taught = self._teacher(current)
            self._observations.append(current["observation"].clone())
            self._values.append(taught["action_value"].clone())
            action = taught["action"]
            if not first:
                action = self._driver(current)["action"].where(self._by_student, action)
            explores = torch.rand(carts, generator=self._random) < self.settings.epsilon
            action = torch.randint(actions, (carts,), generator=self._random).where(explores, action)
            current = self.env.step_and_maybe_reset(current.set("action", action))[1]
        return current

    def _learn(self, number: int) -> float:
        """Make the updates of a round; return the mean loss."""
        settings = self.settings
        observations, values = torch.cat(self._observations), torch.cat(self._values)
        losses = []
        for update in range(settings.updates):
            progress = (number + update / settings.updates) / settings.rounds
            rate = half_cosine(settings.learning_rate, LAST_RATE * settings.learning_rate, progress)
            for group in self._optimizer.param_groups:
                group["lr"] = rate
            rows = torch.randint(len(observations), (settings.batch_size,), generator=self._random)
            losses.append(self._update(observations[rows], values[rows]))
        return sum(losses) / len(losses)

    def _update(self, observation: Tensor, taught: Tensor) -> float:
        """Make a gradient step on a batch; return the loss. Raises LearningError if it is not finite.

        The policy depends on the advantages alone. The mean value has a small weight: it keeps the student a
        Q-network, which can be fine-tuned.
        """
        batch = TensorDict({"observation": observation}, batch_size=observation.shape[:1])
        values = self.student.actor(batch)["action_value"]
        mean, taught_mean = values.mean(-1, keepdim=True), taught.mean(-1, keepdim=True)
        loss = smooth_l1_loss(values - mean, taught - taught_mean)
        loss = loss + self.settings.value_weight * smooth_l1_loss(mean, taught_mean)
        if not math.isfinite(number := loss.item()):
            raise LearningError("distillation diverged; try a smaller distillation.learning_rate")
        self._optimizer.zero_grad()
        loss.backward()
        self._optimizer.step()
        self.student.update_target()
        return number
