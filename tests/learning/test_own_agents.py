"""An agent with a learner of its own and a logger, from a module in the current folder.

docs/your-own-code.md has a Q-network and a loss of one's own.
"""

import json
import sys
from pathlib import Path

import pytest
import torch
from toy_settings import TOY

from cartpole_rl.agents.settings import AGENTS
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.learning.checkpoints import AgentCheckpoint, save_agent
from cartpole_rl.reporting.loggers import LOGGERS
from cartpole_rl.workflows.build import network_of, new_agent, trained_agent
from cartpole_rl.workflows.config import FinetuneConfig, TrainConfig, load_settings
from cartpole_rl.workflows.finetune import finetune
from cartpole_rl.workflows.train import nominal_env, train

MODULE = '''
import copy
import time
import torch
from torchrl.data import Categorical
from torchrl.modules import QValueActor
from cartpole_rl.agents.settings import AGENTS
from cartpole_rl.learning.agent import QAgent

class Search:
    """Random search: the best of some random changes of the weights."""

    def __init__(self, learning, buffer, optimizer, agent, env, evaluate, monitor, seed, compiled, measure):
        self.agent, self.evaluate, self.monitor, self.measure = agent, evaluate, monitor, measure
        self.rounds, self.transitions, self.seconds = learning.evaluations, 0, 0.0
        self.best = -1.0

    def run(self):
        for _ in range(self.rounds):
            kept, started = copy.deepcopy(self.agent.state_dict()), time.perf_counter()
            with torch.no_grad():
                for weight in self.agent.parameters():
                    weight.add_(torch.randn_like(weight))
            episodes = self.evaluate()
            score = sum(each.total(self.measure) for each in episodes) / len(episodes)
            if score <= self.best:
                self.restore({"agent": kept})
            self.best = max(score, self.best)
            self.transitions += 100
            self.seconds += time.perf_counter() - started
            self.monitor.on_update(self.transitions, {"search/best": self.best})
            self.monitor.on_evaluation(self, episodes, score == self.best)

    def snapshot(self):
        return {"agent": self.agent.state_dict()}

    def restore(self, snapshot):
        self.agent.load_state_dict(snapshot["agent"])

@AGENTS.register(learner=Search)
class Searched(torch.nn.Module):
    def __init__(self, settings, mirror_signs, actions, frames, device):
        super().__init__()
        network = torch.nn.Linear(len(mirror_signs), actions)
        self.policy = QValueActor(network, in_keys=["observation"], spec=Categorical(actions))

    def greedy_policy(self):
        return self.policy

@AGENTS.register(learner=Search)
class SearchedNetwork(QAgent):
    """Our network, found by random search."""

def layers(*extra, less=0):
    return lambda settings, signs, actions, frames: torch.nn.Sequential(
        torch.nn.Linear(len(signs), 32), *extra, torch.nn.Linear(32, actions - less)
    )

def zeroed(settings, signs, actions, frames):
    network = dropping(settings, signs, actions, frames)
    torch.nn.init.zeros_(network[-1].weight)
    return network

def spare(settings, signs, actions, frames):
    network = steady(settings, signs, actions, frames)
    network[0].head = torch.nn.Linear(1, 1)
    return network

class Stateful(torch.nn.Module):
    """Has a recurrent state, of as many carts as it first met."""

    def __init__(self, settings, signs, actions, frames):
        super().__init__()
        self.cell, self.state = torch.nn.GRUCell(len(signs), actions), None

    def forward(self, observation):
        self.state = self.cell(observation, self.state)
        return self.state

dropping, normed = layers(torch.nn.Dropout(0.1)), layers(torch.nn.BatchNorm1d(32))
mixing = layers(torch.nn.BatchNorm1d(32, affine=False, track_running_stats=False))
twice, lazy = layers(*2 * [torch.nn.Linear(32, 32)]), layers(torch.nn.LazyLinear(32))
steady, short, no_module = layers(torch.nn.LayerNorm(32)), layers(less=1), lambda *given: None

class Lines:
    def __init__(self, folder, purge_step=None):
        self.file = (folder / "lines.txt").open("a")

    def scalars(self, values, step):
        for name, value in values.items():
            print(step, name, value, file=self.file)

    def nothing(self, *arguments):
        """Log nothing."""

    histogram = figure = animation = hparams = flush = nothing

    def close(self):
        self.file.close()
'''
SMALL = TOY[TrainConfig] | {"learning.evaluations": 3, "task.time_limit": 50, "logger": "own_agents:Lines"}


@pytest.fixture(autouse=True)
def own_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "own_agents", raising=False)
    for registry in (AGENTS, LOGGERS):
        monkeypatch.setattr(registry, "_entries", {**registry._entries})
    (tmp_path / "own_agents.py").write_text(MODULE)


@pytest.mark.usefixtures("without_pictures")
def test_it_is_trained_logged_and_driven(tmp_path: Path) -> None:
    run, kind = tmp_path / "run", "own_agents:Searched"
    score = train(load_settings(TrainConfig, {**SMALL, "agent.kind": kind}), run)
    lines = (run / "lines.txt").read_text()
    assert " search/best " in lines
    assert " evaluation/score " in lines
    assert not list(run.glob("events*"))
    assert len((run / "history.jsonl").read_text().splitlines()) == 3
    agent = trained_agent(run)
    assert (agent.training.agent.kind, agent.policy.training) == (kind, False)
    assert len(run_batch(nominal_env(agent.training), agent.policy)) == 2
    assert json.loads((run / "metrics.json").read_text())["score"]["mean"] == pytest.approx(score)
    with pytest.raises(ConfigError, match=rf"agent\.kind={kind}, .* cannot be exported"):
        network_of(agent)


def test_fine_tuning_refuses_one_with_a_learner_of_its_own(tmp_path: Path) -> None:
    kind, run = "own_agents:SearchedNetwork", tmp_path / "agent.pt"
    training = load_settings(TrainConfig, {**SMALL, "agent.kind": kind})
    save_agent(
        run, AgentCheckpoint(training.model_dump(mode="json"), new_agent(training).state_dict(), 0, None)
    )
    with pytest.raises(ConfigError, match=rf"a learner of its own, and so has agent\.kind={kind}; give an"):
        finetune(load_settings(FinetuneConfig, {"run": str(run), "compile": False}), tmp_path / "run")


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"logger": "own_agents:Searched"}, r"logger\.0=own_agents:Searched: .*it has no `scalars`"),
        ({"agent.kind": "own_agents:Lines"}, "agent.kind=own_agents:Lines: .*it has no `greedy_policy`"),
        ({"agent.network": "own_agents:deep"}, "agent.network=own_agents:deep: .*has no 'deep'"),
        ({"agent.kind": "ppo"}, "agent.kind=ppo: .*give 'dqn', or your own as module:name$"),
    ],
)
def test_what_cannot_be_one_is_refused(setting: dict[str, str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_settings(TrainConfig, SMALL | setting)


@pytest.mark.parametrize(
    ("network", "complaint"),
    [
        *((name, "acts otherwise in training than afterwards") for name in ("dropping", "normed", "zeroed")),
        ("mixing", r"cannot read observations \[N, \d+\]: ValueError: Expected more than 1 value"),
        ("short", r"gave \[64, 8\] for observations \[64, \d+\]; give action values \[64, 9\]"),
        ("spare", "gives action values without a gradient by 0.head.weight; leave that weight out"),
        ("twice", "has one weight as 1.weight and as 2.weight, which would be trained twice; give"),
        ("lazy", "has no size for 1.weight yet; use Linear"),
        ("no_module", "returned NoneType; return a torch.nn.Module"),
    ],
)
def test_a_network_that_cannot_drive_is_refused(network: str, complaint: str) -> None:
    training = load_settings(TrainConfig, {**SMALL, "agent.network": f"own_agents:{network}"})
    with pytest.raises(ConfigError, match=rf"^agent\.network=own_agents:{network}: it {complaint}"):
        new_agent(training)


@pytest.mark.parametrize("network", ["steady", "Stateful"])
def test_to_try_a_network_changes_nothing(network: str) -> None:
    training = load_settings(TrainConfig, {**SMALL, "agent.network": f"own_agents:{network}"})
    torch.manual_seed(0)
    tried = new_agent(training).actor.module[0].module
    after, state = torch.get_rng_state(), getattr(tried, "state", None)
    torch.manual_seed(0)
    signs, actions = training.observation.mirror_signs, len(training.actions.motors)
    alone = training.agent.network(training.agent, signs, actions, training.observation.frames)
    assert torch.equal(torch.get_rng_state(), after)
    assert state is None
    assert all(map(torch.equal, tried.parameters(), alone.parameters()))
