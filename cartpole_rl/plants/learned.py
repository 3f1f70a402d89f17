"""N carts that move like a recorded cart: identified physics, and an ensemble's member per episode.

The members differ where the recordings give no information, so that an agent is trained on this uncertainty
as well. Carts are drawn as in any simulated plant; the learned residual is added to all of them.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict
from torch import Tensor

from cartpole_rl.compilation import Compiled
from cartpole_rl.errors import CheckpointError, ConfigError, reason_of
from cartpole_rl.files import replacing
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import cart_column
from cartpole_rl.physics.residual import LEAST_MEMORY, PLACES, TURN, Residual, chosen_members
from cartpole_rl.plants.settings import REMEDY, LearnedSettings, find_model
from cartpole_rl.plants.simulated import Carts, Inputs, Period, SimulatedPlant, run_carts
from cartpole_rl.plants.specs import Numbers, Plant, PlantOutput
from cartpole_rl.randomization.identified import IdentifiedCarts
from cartpole_rl.randomization.poles import check_one_pole
from cartpole_rl.randomization.randomizer import Draws
from cartpole_rl.rig.hardware import Hardware, hardware_of, nominal_hardware
from cartpole_rl.rig.parameters import check_values
from cartpole_rl.tasks.settings import StartSettings

FORMAT = "cartpole_rl learned model 1"
OLD_SCALES = {  # of files without them
    "units": torch.tensor((0.5, TURN)),
    "spacing": torch.tensor(0.004),
    "widening": torch.tensor(1.0),
}


@dataclass(frozen=True)
class LearnedModel:
    """An identified cart and its residual."""

    parameters: Mapping[str, float]  # of the identified cart, by name
    models: Models
    period: float  # s; a residual holds for one control period
    substeps: int
    residual: Residual  # float32
    hardware: Hardware = field(default_factory=nominal_hardware)


def save_model(path: Path, model: LearnedModel) -> None:
    """Write a model for `load_model`. An interrupted write leaves no file."""
    models = {
        name: value if isinstance(value, bool) else str(value)
        for name, value in model.models._asdict().items()
    }
    content = {
        "parameters": dict(model.parameters),
        "models": models,
        "period": model.period,
        "substeps": model.substeps,
        "hardware": model.hardware.model_dump(),
        "residual": {name: part.detach() for name, part in model.residual._asdict().items()},
    }
    with replacing(path) as beside, beside.open("wb") as file:  # with a path, torch hides why writing failed
        torch.save({"format": FORMAT, **content}, file)


def load_model(source: Path) -> LearnedModel:
    """Return the model in a file or a run folder. Raises CheckpointError if it is missing or damaged."""
    path = find_model(source)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises errors of many types for damaged bytes
        raise CheckpointError(
            f"plant.model={source} is not a learned model, or is damaged ({type(error).__name__}); {REMEDY}"
        ) from None
    found = content.get("format") if isinstance(content, dict) else None
    if found != FORMAT:
        raise CheckpointError(
            f"plant.model={source} is not a learned model: its format is {found!r}, not {FORMAT!r}; {REMEDY}"
        )
    try:
        return _as_model(content)
    except Exception as error:  # of another version, or edited by hand
        raise CheckpointError(
            f"plant.model={source} is of another version of this package: {reason_of(error)}; "
            "run cartpole-model again"
        ) from None


def _as_model(content: Mapping[str, Any]) -> LearnedModel:
    models = Models.of(**content["models"])  # a user's law brings its parameters
    check_values(content["parameters"])
    residual = Residual(**OLD_SCALES | content["residual"])
    if "units" not in content["residual"]:  # its network read x / 0.4 m
        rescaled = residual.first.clone()
        rescaled[:, :, 0] *= float((PLACES - 1) / 2 * residual.spacing) / 0.4
        residual = residual._replace(first=rescaled)
    if bad := [name for name, part in residual._asdict().items() if not part.isfinite().all()]:
        raise ValueError(f"its residual's {', '.join(bad)} is not finite")
    if residual.places.shape[1] != PLACES:
        raise ValueError(f"its tables have {residual.places.shape[1]} places, not {PLACES}")
    return LearnedModel(
        content["parameters"],
        models,
        float(content["period"]),
        int(content["substeps"]),
        residual,
        hardware_of(content.get("hardware", {})),
    )


if TYPE_CHECKING:
    from cartpole_rl.envs.settings import CartPoleSettings

FITTED_LENGTH = 0.2  # share: a fit may move the centre of mass of the pole by half of that


def run_learned_carts(
    carts: Carts, inputs: Inputs, residual: Residual, members: tuple[Tensor], **settings: Any
) -> Period:
    """Run `run_carts` with the addition of `residual`; `members` holds the member of each cart, [N] int64."""
    return run_carts(carts, inputs, addition=chosen_members(residual, *members), **settings)


class LearnedPlant(SimulatedPlant):
    """N carts of a learned model.

    `carts`, `start`, `seed`, `device` and `compiled` are those of a simulated plant; `randomizer` draws the
    parameters of the carts.
    """

    def __init__(
        self,
        carts: int,
        model: LearnedModel,
        randomizer: Draws,
        start: StartSettings,
        seed: int = 0,
        device: torch.device | str = "cpu",
        compiled: bool = False,
        hardware: Hardware | None = None,
    ) -> None:
        physics = model.models, model.period, model.substeps
        super().__init__(carts, randomizer, start, *physics, seed, device, compiled, hardware)
        # the member that moves each cart, [N]; it changes in place when a row resets
        self.member = torch.zeros(carts, dtype=torch.int64, device=self.device)
        memory, under_way = model.residual.memory, len(self._carts.drive) - 1
        if len(self._carts.drive) < 1 + memory:
            missing = self._carts.drive.new_zeros(1 + memory - len(self._carts.drive), carts)
            self._carts = self._carts._replace(drive=torch.cat((self._carts.drive, missing)))
        self._residual = Residual(*(part.to(self.device) for part in model.residual))
        settings = self._plain_run.keywords
        run: Callable[..., Period] = partial(run_learned_carts, in_effect=under_way, **settings)
        self._run_learned = Compiled(run) if compiled else run
        self._run = self._run_members

    def _run_members(self, carts: Carts, inputs: Inputs) -> Period:
        return self._run_learned(carts, inputs, self._residual, (self.member,))

    def restart(self, rows: Tensor, again: Tensor | None = None) -> TensorDict:
        """Start an episode on the carts `rows` [R], each with a new member, except for `again`."""
        drawn = torch.randint(
            self._residual.members, (len(rows),), generator=self._generator, device=self.device
        )
        if again is not None:
            drawn = torch.where(again, self.member[rows], drawn)
        self.member.index_copy_(0, rows, drawn)
        return super().restart(rows, again)

    def step_one(self, motor: int) -> PlantOutput[Numbers]:
        """Drive the only cart for a period, on tensors: the residual's networks are products of matrices."""
        return Plant.step_one(self, motor)

    def snapshot(self) -> dict[str, Any]:
        """Return everything on which the next step depends, for `restore`."""
        return {**super().snapshot(), "member": self.member.clone()}

    def restore(self, snapshot: Any) -> None:
        """Return to `snapshot`. Raises CheckpointError if the model then had more members."""
        if int(snapshot["member"].max()) >= self._residual.members:
            raise CheckpointError("plant.model has fewer members than when the run was saved; start anew")
        super().restore(snapshot)
        self.member.copy_(snapshot["member"])


def learned_carts(
    plant: LearnedSettings,
    config: "CartPoleSettings",
    prior: Draws,
    carts: int,
    start: StartSettings,
    seed: int,
    compiled: bool,
    device: torch.device | str,
) -> LearnedPlant:
    """Return the plant of plant=learned, with the errors and the carts of `model_and_carts`."""
    model, draws = model_and_carts(plant, config, prior)
    return LearnedPlant(carts, model, draws, start, seed, device, compiled, config.hardware)


def model_and_carts(
    plant: LearnedSettings, config: "CartPoleSettings", prior: Draws
) -> tuple[LearnedModel, IdentifiedCarts]:
    """Return the model, and the source of its carts: `plant.prior_share` of them come from `prior`.

    Raises CheckpointError; ConfigError for a model of another cart.
    """
    model = load_model(plant.model)
    check_same_cart(model, config)
    found = cart_column(model.parameters, torch.float32)
    return model, IdentifiedCarts(found, prior, plant.prior_share, LEAST_MEMORY * model.period)


def check_same_cart(model: LearnedModel, config: "CartPoleSettings") -> None:
    """Raise ConfigError if a learned model has another period, actuator or pole than `config`."""
    if not math.isclose(model.period, config.control_period, rel_tol=1e-6):
        raise ConfigError(f"control_period={config.control_period}: plant.model has {model.period} s")
    if model.models.actuator != config.actions.actuator:
        raise ConfigError(f"actions: plant.model has actuator {model.models.actuator}")
    if config.hardware.scales_text != model.hardware.scales_text:
        raise ConfigError(
            f"cart: plant.model has {model.hardware.scales_text}, not {config.hardware.scales_text}"
        )
    check_one_pole("plant.model", config.pole)
    pole, own = config.pole.nominal, 2 * model.parameters["pole_com"]
    if abs(own / pole.length - 1) > FITTED_LENGTH:
        raise ConfigError(f"pole: plant.model has one of {own:.2f} m, not {pole.length:.2f} m")
