"""A learned model of one cart as a file: identified parameters, their physics models, residuals."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from cartpole_rl.errors import CheckpointError
from cartpole_rl.files import replacing
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.residual import PLACES, Residual
from cartpole_rl.plants.settings import REMEDY, find_model
from cartpole_rl.rig.parameters import check_values

FORMAT = "cartpole_rl learned model 1"


@dataclass(frozen=True)
class LearnedModel:
    """An identified cart and its residual."""

    parameters: Mapping[str, float]  # of the identified cart, by name
    models: Models
    period: float  # s; a residual holds for one control period
    substeps: int
    residual: Residual  # float32


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
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(
            f"plant.model={source} is of another version of this package: {reason}; run cartpole-model again"
        ) from None


def _as_model(content: Mapping[str, Any]) -> LearnedModel:
    models = Models.of(**content["models"])  # a user's law brings its parameters
    check_values(content["parameters"])
    residual = Residual(**content["residual"])
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
    )
