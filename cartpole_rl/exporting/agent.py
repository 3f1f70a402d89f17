"""An agent as plain numbers: its description, its layers, and the weights file. No PyTorch.

The greedy action is the index of the largest action value. With h = observation, each layer but the last is

    h = relu(gain * normalized(weight @ h + bias) + shift)

where `normalized` subtracts the mean and divides by the standard deviation (of the variance plus
`norm_epsilon`), in each of `norm_groups` equal parts of the vector. Without layer normalization it is
h = relu(weight @ h + bias). The last layer is weight @ h + bias.

The weights file is a NumPy archive (.npz) with the arrays of each layer, and agent.json with the description
and the checksum. It is a zip file without pickled objects: `unzip` opens it, and `numpy.load` reads it in any
program.
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.envs.settings import CartPoleSettings, ObservationSettings, TrackGuard
from cartpole_rl.errors import CheckpointError, ConfigError
from cartpole_rl.randomization.poles import possible_poles
from cartpole_rl.rig.hardware import nominal_encoders
from cartpole_rl.settings import Count, Finite, Positive, Settings
from cartpole_rl.tasks.features import LENGTH_SCALE, MOTOR_SCALE, THETA_DOT, X_DOT, ObservationKind, Quantity
from cartpole_rl.tasks.settings import MotorValue, Start

FORMAT: Literal["cartpole_rl weights 1"] = "cartpole_rl weights 1"
NORM_EPSILON = 1e-5  # added to the variance; PyTorch's default
DESCRIPTION = "agent.json"
FLOATS = np.dtype("<f4")
EPOCH = (1980, 1, 1, 0, 0, 0)  # of every member, so that equal agents make equal files

Floats = NDArray[np.float32]


class ObservedNumber(Settings):
    """A number of the observation: `name`, as it was some control periods ago, divided by `scale`.

    It is 0 while the episode is younger than that. The motor value 1 period ago is the one sent last.
    """

    name: str  # x, x_dot, theta, theta_dot, cos_theta, sin_theta, motor or pole_length
    periods_ago: Annotated[int, Field(ge=0)]
    unit: str
    scale: Positive


class Description(Settings):
    """An agent without its weights."""

    format: Literal["cartpole_rl weights 1"] = FORMAT
    task: str
    observation: ObservationSettings
    numbers: tuple[ObservedNumber, ...]  # the observation, in order
    # of the observation, each hidden layer, and the action values
    sizes: Annotated[tuple[Count, ...], Field(min_length=2)]
    layer_norm: bool
    norm_groups: Literal[1, 2]  # parts of a hidden layer that are normalized separately
    norm_epsilon: Positive = NORM_EPSILON
    mirrored: bool  # the action values have the mirror symmetry of left and right
    motors: tuple[MotorValue, ...]  # by action index
    start: Start  # the initial angle of the pole
    angle_limit: Finite | None  # rad from upright; beyond it the episode ends. None: no limit
    guard: TrackGuard | None  # its rule is in cartpole_rl/envs/guard.py
    track_half_length: Positive  # m, of the nominal cart; a real one reports its own
    control_period: Positive  # s
    cart_metres_per_count: Positive = nominal_encoders().metres
    pole_counts_per_turn: Count = nominal_encoders().turn
    hardware: dict[str, Finite] = Field(default_factory=dict)  # the numbers of the rig in cart=
    pole_lengths: tuple[Positive, Positive]  # m, the shortest and the longest pole of the training
    provenance: dict[str, Any]  # of the training: command, versions, commit, seed, score

    @property
    def origin(self) -> str:
        """The command of the training."""
        return " ".join(map(str, self.provenance.get("command", []))) or "unknown"

    @property
    def is_consistent(self) -> bool:
        """True if the parts that repeat each other agree."""
        ends = len(self.numbers), len(self.motors)
        agree = ends == (self.sizes[0], self.sizes[-1])
        known = self.observation.pole_length or not (self.guard and self.guard.reads_length)
        return agree and known and self.numbers == observed_numbers(self.observation)

    def shapes(self) -> Iterator[tuple[str, tuple[int, ...]]]:
        """Yield the name and the shape of each array of weights."""
        last = len(self.sizes) - 2
        for number, (inputs, outputs) in enumerate(zip(self.sizes[:-1], self.sizes[1:], strict=True)):
            yield f"layer{number}.weight", (outputs, inputs)
            normalized = self.layer_norm and number < last
            for name in ("bias", "gain", "shift") if normalized else ("bias",):
                yield f"layer{number}.{name}", (outputs,)


def description(
    settings: CartPoleSettings, agent: AgentSettings, provenance: Mapping[str, Any]
) -> Description:
    """Return the description of an agent that was trained with `settings`. Raises ConfigError."""
    lengths = settings.pole.lengths or [pole.length for pole in possible_poles(settings.pole)]
    observation, motors, task = settings.observation, settings.actions.motors, settings.task
    return Description(
        task=task.name,
        observation=observation,
        numbers=observed_numbers(observation),
        sizes=(observation.size, *agent.hidden, len(motors)),
        layer_norm=agent.layer_norm,
        norm_groups=2 if agent.mirrored else 1,
        mirrored=agent.mirrored,
        motors=motors,
        start=task.evaluation_start.angle,
        angle_limit=task.angle_limit,
        guard=settings.guard.active,
        track_half_length=settings.nominal_cart["track_half_length"],
        control_period=settings.control_period,
        cart_metres_per_count=settings.hardware.encoders.metres,
        pole_counts_per_turn=settings.hardware.encoders.turn,
        hardware=settings.hardware.model_dump(),
        pole_lengths=(min(lengths), max(lengths)),
        provenance=dict(provenance),
    )


def observed_numbers(observation: ObservationSettings) -> tuple[ObservedNumber, ...]:
    """Return the definition of each number of an observation, in order.

    Raises ConfigError for a `Quantity` without a name.
    """
    numbers = definitions(observation.kind.quantities, 0)
    for ago in range(1, observation.past_motors + 1):
        numbers.append(ObservedNumber(name="motor", periods_ago=ago, unit="", scale=MOTOR_SCALE))
    for ago in range(1, observation.past_velocities + 1):
        numbers += definitions((X_DOT, THETA_DOT), ago)
    for ago in range(1, observation.past_positions + 1):
        numbers += definitions(ObservationKind.POSITIONS.quantities, ago)
    if observation.pole_length:
        numbers.append(ObservedNumber(name="pole_length", periods_ago=0, unit="m", scale=LENGTH_SCALE))
    return tuple(numbers)


def definitions(quantities: Sequence[Quantity], periods_ago: int) -> list[ObservedNumber]:
    """Return the definitions of `quantities` as they were `periods_ago`."""
    if any(not quantity.name for quantity in quantities):
        raise ConfigError(
            "observation: a number of this kind has no name; name its Quantity in tasks/features.py"
        )
    return [
        ObservedNumber(name=each.name, periods_ago=periods_ago, unit=each.unit, scale=each.scale)
        for each in quantities
    ]


class Layer(NamedTuple):
    """A layer; `gain` and `shift` are None where nothing is normalized."""

    weight: Floats  # [outputs, inputs]
    bias: Floats  # [outputs]
    gain: Floats | None = None  # [outputs]
    shift: Floats | None = None  # [outputs]


@dataclass(frozen=True)
class ExportedAgent:
    """An agent as plain numbers."""

    description: Description
    layers: tuple[Layer, ...]

    def arrays(self) -> Iterator[tuple[str, Floats]]:
        """Yield each array with its name, such as layer0.weight."""
        for number, layer in enumerate(self.layers):
            for name, values in layer._asdict().items():
                if values is not None:
                    yield f"layer{number}.{name}", values

    @property
    def json(self) -> str:
        """The description and the checksum as JSON."""
        content = {**self.description.model_dump(mode="json"), "sha256": self.checksum}
        return json.dumps(content, indent=1, allow_nan=False)

    @property
    def checksum(self) -> str:
        """SHA-256, in hexadecimal, of the description and of each array: it identifies the agent, not a file.

        The description is JSON with sorted keys, without spaces, in ASCII. Each array is its name and shape
        as text, as in "layer0.bias [128]", and its float32 numbers, row by row, little-endian.
        """
        unknown = () if self.description.hardware else ("hardware",)  # of files of earlier versions
        return self._digest(self.description.model_dump(mode="json", exclude={*unknown}))

    @property
    def identity(self) -> int:
        """The 32 bits that a board reports of its agent, never 0: such a checksum without the provenance."""
        functional = self.description.model_dump(mode="json", exclude={"provenance", "hardware"})
        return int(self._digest(functional)[:8], 16) or 1

    def identity_with(self, pole_length: float) -> int:
        """Return what a board reports that was compiled for a pole of a length in m."""
        centimetres = int(100 * pole_length + 0.5) if self.description.observation.pole_length else 0
        return (self.identity ^ centimetres * 0x9E3779B1) & 0xFFFFFFFF or 1

    def _digest(self, description: dict[str, Any]) -> str:
        digest = hashlib.sha256(canonical_json(description).encode())
        for name, values in self.arrays():
            digest.update(f"{name} {list(values.shape)}".encode())
            digest.update(np.ascontiguousarray(values, FLOATS).tobytes())
        return digest.hexdigest()

    def values(self, observations: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the action values [N, A] of observations [N, K]."""
        about, h = self.description, observations
        for number, layer in enumerate(self.layers):
            h = h @ layer.weight.T.astype(np.float64) + layer.bias
            if layer.gain is not None:
                parts = h.reshape(len(h), about.norm_groups, -1)
                parts = parts - parts.mean(2, keepdims=True)
                parts = parts / np.sqrt((parts**2).mean(2, keepdims=True) + about.norm_epsilon)
                h = layer.gain * parts.reshape(len(h), -1) + layer.shift
            if number < len(self.layers) - 1:
                h = np.maximum(h, 0)
        return h

    def check(self, source: str) -> None:
        """Raise CheckpointError, which names `source`, if the parts do not fit or a weight is not finite."""
        if not self.description.is_consistent:
            raise CheckpointError(f"{source}: its description contradicts itself; export the agent again")
        expected = dict(self.description.shapes())
        found = dict(self.arrays())
        for name in sorted({*expected, *found}):
            shape = found[name].shape if name in found else None
            if shape != expected.get(name):
                raise CheckpointError(
                    f"{source}: {name} has shape {shape}, not {expected.get(name)}; export the agent again"
                )
            if not np.isfinite(found[name]).all():
                raise CheckpointError(f"{source}: {name} is not finite; export another checkpoint")

    def weights_file(self) -> bytes:
        """Return the content of the weights file."""
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr(zipfile.ZipInfo(DESCRIPTION, EPOCH), self.json + "\n")
            for name, values in self.arrays():
                content = io.BytesIO()
                np.save(content, values.astype(FLOATS), allow_pickle=False)
                archive.writestr(zipfile.ZipInfo(f"{name}.npy", EPOCH), content.getvalue())
        return file.getvalue()


def canonical_json(values: Any) -> str:
    """Return JSON with sorted keys and without spaces. Raises ValueError for an infinite number."""
    return json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False)


def read_agent(path: Path) -> ExportedAgent:
    """Read a weights file and check all of it: format, shapes, finite numbers, checksum.

    Raises CheckpointError in one line.
    """
    values, arrays = read_archive(path)
    checksum = values.pop("sha256", None)
    if values.get("format") != FORMAT:
        raise CheckpointError(
            f"{path}: its format is {values.get('format')!r}, not {FORMAT!r}; export it again"
        )
    try:
        about = Description(**values)
    except ValidationError as error:
        wrong = ".".join(map(str, error.errors()[0]["loc"]))
        raise CheckpointError(f"{path}: {wrong} in {DESCRIPTION} is wrong; export the agent again") from None
    agent = ExportedAgent(about, layers_of(arrays))
    agent.check(str(path))
    if len(arrays) != len(dict(agent.arrays())) or agent.checksum != checksum:
        raise CheckpointError(f"{path}: its content does not match its checksum; export the agent again")
    return agent


def read_archive(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the JSON and the arrays of a weights file. Raises CheckpointError."""
    if not path.is_file():
        raise CheckpointError(
            f"{path}: there is no such file; give one that cartpole-export format=weights wrote"
        )
    try:
        with np.load(path, allow_pickle=False) as archive:
            content = {name: archive[name] for name in archive.files}
        values = json.loads(content.pop(DESCRIPTION))
        if not isinstance(values, dict):
            raise ValueError("it is no JSON object")
        canonical_json(values)
        if any(not isinstance(each, np.ndarray) or each.dtype != FLOATS for each in content.values()):
            raise ValueError("a member is not an array of float32")
    except Exception as error:  # a damaged zip file raises errors of many kinds
        raise CheckpointError(
            f"{path} is not a weights file, or is damaged ({type(error).__name__}); "
            "give one that cartpole-export format=weights wrote"
        ) from None
    return values, content


def layers_of(arrays: dict[str, Any]) -> tuple[Layer, ...]:
    """Return the layers in the arrays of a file; missing parts are empty arrays, which `check` reports."""
    count = sum(name.endswith(".weight") for name in arrays)
    nothing = np.zeros(0, np.float32)
    return tuple(
        Layer(
            *(arrays.get(f"layer{number}.{name}", nothing) for name in ("weight", "bias")),
            *(arrays.get(f"layer{number}.{name}") for name in ("gain", "shift")),
        )
        for number in range(count)
    )
