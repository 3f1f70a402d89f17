"""A policy of one's own, `run=module:name` or `run=file.onnx`, on the same path as a trained agent.

It is called with observations [N, K] float32 and returns either action values [N, A], of which the largest
acts, or actions [N], integers from 0 to A - 1. N is 1 on a cart, and the number of episodes in simulation. It
is a function of a tensor, a `torch.nn.Module`, a TorchRL module that reads `observation`, or the first output
of an ONNX file. The observation is that of `observation=`, the motor values are those of `actions=`.

A value that is not finite is a fault, as with a trained agent: motor value 0, and the episode ends. Whatever
else is wrong ends the command; on a cart the motor value is 0 first.
"""

import json
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from cartpole_rl.errors import ConfigError
from cartpole_rl.plants.specs import tensordict_of
from cartpole_rl.registry import object_at

METADATA = "cartpole_rl"  # in an ONNX file of cartpole-export: agent.json
UNSIGNED = torch.uint16, torch.uint32, torch.uint64  # PyTorch compares none of them
CHOSEN_BY = {  # what an exported agent has, and the setting that chooses it
    "motors": "choose them by actions=",
    "control_period": "choose it by control_period=",
    "observation": "choose it by observation=",
    "hardware": "choose its cart by cart=",
}


class OwnPolicy:
    """The policy at `run` for the motor values `motors`. Raises ConfigError if there is none.

    `driven` are the settings that it is driven with, named as in agent.json of an exported agent.
    """

    def __init__(self, run: Path, motors: Sequence[int], driven: Mapping[str, Any] | None = None) -> None:
        self._name, self._actions = f"run={run}", len(motors)
        expected = {"motors": [*motors], **(driven or {})}
        try:
            onnx = run.suffix == ".onnx"
            self._function = onnx_function(run, expected) if onnx else named_function(str(run))
        except ConfigError as error:
            raise ConfigError(f"{self._name}: {error}") from None

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return `action` [N], and `action_value` [N, A] if the policy has it. Raises ConfigError."""
        observation = tensordict.get("observation")
        given = self._result(observation)
        carts = len(observation)
        if given.shape == (carts, self._actions):
            return tensordict_of({"action_value": given, "action": given.argmax(-1)})
        if given.shape != (carts,) and given.numel() != carts:
            raise ConfigError(
                f"{self._name}: it gave numbers of shape {[*given.shape]} for observations "
                f"{[*observation.shape]}; give actions [{carts}] or action values [{carts}, {self._actions}]"
            )
        return tensordict_of(self._checked(given.reshape(carts)))

    def _result(self, observation: Tensor) -> Tensor:
        try:
            given = torch.as_tensor(self._function(observation.clone())).cpu()
            if given.dtype in UNSIGNED:
                given = given.long()
            elif given.is_floating_point() and given.itemsize == 1:
                given = given.float()
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            why = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise ConfigError(f"{self._name}: {why} ({last.filename}, line {last.lineno})") from error
        if given.is_complex():
            raise ConfigError(f"{self._name}: it gave complex numbers; give real ones")
        return given.long() if given.dtype == torch.bool else given

    def _checked(self, actions: Tensor) -> dict[str, Tensor]:
        """Return actions [N]; those that are not finite are named by an action value that is not."""
        finite = actions.isfinite()
        known = actions.where(finite, torch.zeros_like(actions))
        wrong = known[(known < 0) | (known >= self._actions) | (known != known.long())]
        if len(wrong):
            given = f"{wrong[0].item():g}"
            raise ConfigError(f"{self._name}: it chose {given}; give integers from 0 to {self._actions - 1}")
        value = actions.float().unsqueeze(-1)
        return {"action": known.long(), "action_value": value}


def differences(known: Any, wanted: Any) -> Iterator[tuple[str, str]]:
    """Yield both values where they differ; those of a mapping one by one, with their names."""
    if not isinstance(wanted, Mapping):
        if known != wanted:
            yield str(known), str(wanted)
        return
    for name, value in wanted.items():
        for each in differences(known.get(name, value), value):
            yield f"{name}={each[0]}", each[1]


def named_function(place: str) -> Callable[[Tensor], Any]:
    """Return the function of observations at "module:name". Raises ConfigError."""
    found = object_at(place)
    if isinstance(found, type) or not callable(found):
        what = "a class" if isinstance(found, type) else f"{type(found).__name__}"
        raise ConfigError(f"it is {what}; give a function of observations [N, K], or an instance of a module")
    if isinstance(found, nn.Module):
        found.eval()
    if not isinstance(found, TensorDictModuleBase):
        return found

    def of_tensordict(observation: Tensor) -> Tensor:
        chosen = found(TensorDict({"observation": observation}, batch_size=observation.shape[:1]))
        values = chosen.get("action_value", None)
        return chosen["action"] if values is None else values

    return of_tensordict


def onnx_function(file: Path, expected: Mapping[str, Any]) -> Callable[[Tensor], Any]:
    """Return the first output of an ONNX file as a function of observations. Raises ConfigError.

    An agent that `cartpole-export` wrote must have been trained with what is `expected`.
    """
    try:
        import onnxruntime
    except ImportError:
        raise ConfigError('it needs onnxruntime: pip install "cartpole_rl[export]"') from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # several would make a tick late
    try:
        session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors have no common class
        raise ConfigError(f"it is no ONNX model: {' '.join(str(error).split())}") from None
    try:
        about = json.loads(session.get_modelmeta().custom_metadata_map.get(METADATA, "{}"))
        others = [
            (name, *each)
            for name, wanted in expected.items()
            for each in differences(about.get(name, wanted), wanted)
        ]
    except (ValueError, AttributeError):
        raise ConfigError(f"its entry {METADATA} is damaged; export the agent again") from None
    for name, known, other in others[:1]:
        raise ConfigError(f"it was exported with {name} {known}, not {other}; {CHOSEN_BY[name]}")
    name, output = session.get_inputs()[0].name, session.get_outputs()[0].name
    return lambda observation: session.run([output], {name: observation.numpy()})[0]
