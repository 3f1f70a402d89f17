"""Carts of a learned model: one member an episode, the same carts where nothing was learned, files."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from courses import scattered
from small_files import files_of_at_most

from cartpole_rl.errors import CheckpointError
from cartpole_rl.physics.dynamics import State
from cartpole_rl.physics.friction import CART_FRICTIONS
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.physics.residual import PLACES, Residual
from cartpole_rl.plants.learned import FORMAT, LearnedModel, LearnedPlant, load_model, save_model
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.randomization.randomizer import Randomizer

STEP = Models(cart_friction=CART_FRICTIONS.find("step"))
START = scattered(position_spread=0.1, angle_spread=0.1)
CARTS = 6

MakeLearned = Callable[..., LearnedPlant]


def learned_model(nominal: dict[str, float], size: float) -> LearnedModel:
    generator = torch.Generator().manual_seed(0)
    drawn = Residual.untrained(3, 8, generator, 0.02, 4.0, 0.814)
    residual = drawn._replace(
        places=size * torch.randn(3, PLACES, generator=generator),
        last=size * torch.randn(3, 2, 8, generator=generator),
    )
    return LearnedModel(nominal, STEP, 0.02, 4, residual)


@pytest.fixture(scope="module")
def make_learned(ip02: dict[str, float], medium: PoleSettings, nominal: dict[str, float]) -> MakeLearned:
    def build(size: float = 0.5, **settings: bool | int) -> LearnedPlant:
        randomizer = Randomizer(ip02, medium, {})
        return LearnedPlant(CARTS, learned_model(nominal, size), randomizer, START, **settings)

    return build


def driven(plant: SimulatedPlant, periods: int = 30) -> torch.Tensor:
    """True states after each period of a fixed shaking, [periods, 4, CARTS]."""
    present, states = plant.reset(), []
    for period in range(periods):
        motor = torch.full((CARTS, 1), 220 if period % 10 < 5 else -220)
        present = plant.step(present.set("motor", motor))["next"]
        states.append(torch.stack(plant.true_state))
    return torch.stack(states)


def test_nothing_learned_is_a_simulated_plant(
    make_learned: MakeLearned, ip02: dict[str, float], medium: PoleSettings
) -> None:
    simulated = SimulatedPlant(CARTS, Randomizer(ip02, medium, {}), START, STEP)
    learned = make_learned(size=0.0)
    start = torch.stack(
        (torch.zeros(CARTS), torch.zeros(CARTS), torch.full((CARTS,), 3.0), torch.ones(CARTS))
    )
    states = []
    for plant in (simulated, learned):
        present = plant.reset()
        plant.place(State(*start))
        for _ in range(20):
            present = plant.step(present.set("motor", torch.full((CARTS, 1), 220)))["next"]
        states.append(torch.stack(plant.true_state))
    assert torch.equal(*states)


def test_each_episode_has_a_member(make_learned: MakeLearned) -> None:
    plant = make_learned()
    plant.reset()
    met = set()
    for _ in range(10):
        plant.restart(torch.tensor([0, 2]))
        met |= set(plant.member[[0, 2]].tolist())
    assert met == {0, 1, 2}
    others = plant.member[[1, 3, 4, 5]].clone()
    plant.restart(torch.tensor([0]))
    assert torch.equal(plant.member[[1, 3, 4, 5]], others)
    own = plant.member[2].clone()
    for _ in range(10):
        plant.restart(torch.tensor([0, 2]), again=torch.tensor([False, True]))
        assert plant.member[2] == own


def test_members_move_apart(make_learned: MakeLearned) -> None:
    plant = make_learned()
    by_member = {}
    states = driven(plant)[-1]
    for cart, member in enumerate(plant.member.tolist()):
        by_member.setdefault(member, states[:, cart])
    assert len(by_member) > 1
    first, second = list(by_member.values())[:2]
    assert not torch.allclose(first, second, atol=1e-3)


@pytest.mark.nightly  # envs/test_compiled_environment.py compiles in every run
def test_compiled_is_the_same(make_learned: MakeLearned) -> None:
    plain, compiled = (driven(make_learned(seed=3, compiled=each)) for each in (False, True))
    assert torch.allclose(plain, compiled, atol=1e-3)


def test_a_snapshot_goes_on_as_if_nothing_had_happened(make_learned: MakeLearned) -> None:
    plant = make_learned()
    present = plant.reset().set("motor", torch.full((CARTS, 1), 220))
    plant.step(present)
    snapshot = plant.snapshot()
    ends = []
    for _ in range(2):
        plant.step(present)
        plant.restart(torch.tensor([1, 4]))
        ends.append((torch.stack(plant.true_state), plant.member.clone()))
        plant.restore(snapshot)
    for first, second in zip(*ends, strict=True):
        assert torch.equal(first, second)


def test_a_snapshot_of_more_members_is_refused(make_learned: MakeLearned) -> None:
    plant = make_learned()
    plant.reset()
    snapshot = plant.snapshot()
    snapshot["member"][0] = 3
    with pytest.raises(CheckpointError, match=r"^plant\.model has fewer members than when the run was saved"):
        plant.restore(snapshot)


def test_a_state_that_is_not_a_number_stays_one(make_learned: MakeLearned) -> None:
    """The environment ends the episode, as on a simulated plant."""
    plant = make_learned()
    present = plant.reset()
    plant.place(State(*torch.full((4, CARTS), torch.nan)))
    plant.step(present.set("motor", torch.full((CARTS, 1), 220)))
    assert torch.stack(plant.true_state).isnan().all()


class TestFile:
    def test_it_comes_back(self, nominal: dict[str, float], tmp_path: Path) -> None:
        model = learned_model(nominal, 0.5)
        save_model(tmp_path / "model.pt", model)
        for source in (tmp_path, tmp_path / "model.pt"):
            read = load_model(source)
            assert (dict(read.parameters), read.models, read.period, read.substeps) == (
                nominal,
                STEP,
                0.02,
                4,
            )
            assert all(map(torch.equal, read.residual, model.residual))
        assert list(read.parameters) == list(nominal)
        assert set(read.parameters) == set(CartParameters.names())

    def test_one_that_cannot_be_written_is_named(self, nominal: dict[str, float], tmp_path: Path) -> None:
        path = tmp_path / "model.pt"
        with files_of_at_most(1024), pytest.raises(OSError, match="File too large") as caught:
            save_model(path, learned_model(nominal, 0.5))
        assert caught.value.filename == str(path)
        assert not list(tmp_path.iterdir())

    def test_what_is_no_model_is_named(self, nominal: dict[str, float], tmp_path: Path) -> None:
        def complaint(source: Path) -> str:
            with pytest.raises(CheckpointError) as error:
                load_model(source)
            return str(error.value).replace(str(tmp_path), "")

        assert complaint(tmp_path) == "plant.model=: it holds no model.pt; give a run of cartpole-model"
        assert complaint(tmp_path / "a.pt").startswith("plant.model=/a.pt: there is no such file or folder")
        whole = tmp_path / "whole.pt"
        save_model(whole, learned_model(nominal, 0.5))
        (tmp_path / "cut.pt").write_bytes(whole.read_bytes()[:2000])
        assert "cut.pt is not a learned model, or is damaged" in complaint(tmp_path / "cut.pt")
        torch.save({"format": "cartpole_rl agent 1"}, tmp_path / "agent.pt")
        assert "its format is 'cartpole_rl agent 1'" in complaint(tmp_path / "agent.pt")
        content = torch.load(whole)
        assert content["format"] == FORMAT
        for name in ("units", "spacing", "widening"):
            del content["residual"][name]
        torch.save(content, tmp_path / "first.pt")  # of the first version, for ip02 alone
        old = load_model(tmp_path / "first.pt").residual
        assert (old.units.tolist(), float(old.spacing), float(old.widening)) == (
            [0.5, 2.0],
            pytest.approx(0.004),
            1,
        )
        del content["parameters"]["cart_mass"]
        torch.save(content, tmp_path / "older.pt")
        assert "of another version" in complaint(tmp_path / "older.pt")
        assert "'cart_mass' is missing; run cartpole-model again" in complaint(tmp_path / "older.pt")
