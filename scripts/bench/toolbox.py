"""A cart in MuJoCo, fitted by MuJoCo's own toolbox `mujoco.sysid`, for real.py to compare with.

`pip install "mujoco[sysid]"` installs the toolbox; without it, INSTALLED is False. It takes initial states as
given: here rounds of its search alternate with matching these, as `cartpole-identify` matches them, and its
residuals are those that remain where initial states follow. Its rollout has no delay of the motor, and its
sensors are a step late: `roll_out` replaces it.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.rollout import rollout
from numpy.typing import NDArray
from torch import Tensor

from cartpole_rl.choices import choice
from cartpole_rl.identification.matching import COARSE, InitialStates, finest_scale, match_initial_states
from cartpole_rl.identification.windows import Windows, history_periods

try:
    from mujoco import sysid
except ImportError:  # an older MuJoCo
    sysid = None

Array = NDArray[np.float64]
INSTALLED = hasattr(sysid, "optimize")  # with all that it requires
SUBSTEPS = 8  # of MuJoCo in a control period
SCREENING, ROUNDS = 3, 6  # rounds from each start, with a part of the windows, and from the best
SCREENED = 5  # one window in so many
SEARCH: dict[str, Any] = {
    "optimizer": "scipy_parallel_fd",
    "x_scale": "jac",
    "diff_step": 1e-6,
    "max_iters": 4,
    "ftol": 1e-4,
}
STARTS = (1.0, 3.0, 10.0)  # of the cart's mass, force and friction, times those of cart=sensorsini
BOUNDS = {
    "cart_mass": (0.05, 10.0),  # kg
    "cart_viscous": (0.0, 300.0),  # N s/m
    "cart_coulomb": (0.0, 20.0),  # N
    "force_linear": (1e-3, 1.0),  # N per motor value
    "pole_viscous": (0.0, 0.01),  # N m s/rad
    "pole_inertia": (0.8e-3, 1.5e-3),  # kg m^2
    "latency": (0.0, 0.06),  # s
    "angle_offset": (-0.1, 0.1),  # rad
}
XML = """<mujoco><option timestep="{step}" integrator="implicitfast" tolerance="1e-12"/><worldbody>
<body name="cart"><joint name="x" type="slide" axis="1 0 0"/>
<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
<body name="pole"><joint name="theta" axis="0 1 0"/>
<inertial mass="{pole_mass}" pos="0 0 {pole_com}" diaginertia="1e-3 1e-3 1e-6"/></body></body></worldbody>
<actuator><motor name="motor" joint="x"/></actuator>
<sensor><jointpos name="x" joint="x"/><jointpos name="theta" joint="theta"/></sensor></mujoco>"""


def nominal() -> dict[str, float]:
    """Return the parameters of cart=sensorsini and its pole."""
    every = {**choice("cart/sensorsini"), **choice("pole/sensorsini")["choices"]["sensorsini"]}
    return {name: float(every.get(name, 0.0)) for name in (*BOUNDS, "pole_mass", "pole_com")}


def cart_spec(period: float) -> mujoco.MjSpec:
    """Return the cart, of which `modify` sets the parameters."""
    return mujoco.MjSpec.from_string(XML.format(step=period / SUBSTEPS, **nominal()))


def modify(spec: mujoco.MjSpec, name: str, value: float) -> None:
    """Set one of BOUNDS in the cart; latency and angle_offset are no part of it."""
    if name == "cart_mass":
        spec.body("cart").mass = value
    elif name == "pole_inertia":
        spec.body("pole").inertia[:2] = value
    elif name == "force_linear":
        spec.actuator("motor").gear[0] = value
    elif name == "cart_coulomb":
        spec.joint("x").frictionloss = value
    elif name in {"cart_viscous", "pole_viscous"}:
        spec.joint("x" if name == "cart_viscous" else "theta").damping[0] = value


def delayed_means(motors: Array, latency: float, period: float) -> Array:
    """Return the mean motor value in each step of windows, [T x SUBSTEPS, ...], from [H + T, ...]."""
    area = np.concatenate((np.zeros_like(motors[:1]), motors.cumsum(0)))
    history = history_periods(period)
    edges = np.arange((len(motors) - history) * SUBSTEPS + 1) / SUBSTEPS + history - latency / period
    whole = np.minimum(edges.astype(int), len(motors) - 1)
    share = (edges - whole).reshape(-1, *[1] * (motors.ndim - 1))
    return np.asarray(np.diff(area[whole] + share * motors[whole], axis=0) * SUBSTEPS)


def first_states(motion: Tensor, angle_offset: float) -> Array:
    """Return MuJoCo's states [W, 5], time 0 first, for states `motion` [4, W] as measured."""
    x, x_dot, theta, theta_dot = motion.numpy()
    return np.stack((np.zeros_like(x), x, theta - angle_offset, x_dot, theta_dot), 1)


@dataclass(frozen=True)
class MujocoCart:
    """One cart, which `predict` takes in place of a Dynamics."""

    model: mujoco.MjModel
    latency: float  # s
    angle_offset: float  # rad
    period: float  # s

    @classmethod
    def of(cls, values: dict[str, float], period: float) -> MujocoCart:
        """Return the cart of these parameters, all of BOUNDS."""
        spec = cart_spec(period)
        for name, value in values.items():
            modify(spec, name, value)
        return cls(spec.compile(), values["latency"], values["angle_offset"], period)

    def positions(self, motion: Tensor, motors: Tensor, residual: None = None) -> Tensor:
        """Return measured positions [T + 1, 2, 1, W], from motor values [H + T, W].

        The states `motion` [4, 1, W] are as measured, with the offset of the angle.
        """
        first = first_states(motion[:, 0], self.angle_offset)
        control = delayed_means(motors.numpy(), self.latency, self.period).T[..., None]
        after, _ = rollout(self.model, mujoco.MjData(self.model), first, control)
        every = np.concatenate((first[:, None], after), 1)[:, ::SUBSTEPS, 1:3]
        every[..., 1] += self.angle_offset
        return torch.from_numpy(every).permute(1, 2, 0).unsqueeze(2)


def starting(scale: float) -> sysid.ParameterDict:
    """Return the unknowns of a search; the cart's mass, force and friction are `scale` times nominal."""
    found = sysid.ParameterDict()
    for name, (least, most) in BOUNDS.items():
        value = nominal()[name] * (scale if name.startswith(("cart_", "force_")) else 1)
        found.add(sysid.Parameter(name, value, least, most, modifier=modify_by))
    return found


def modify_by(spec: mujoco.MjSpec, parameter: sysid.Parameter) -> None:
    """Set a parameter in the cart, as the toolbox asks for it."""
    modify(spec, parameter.name, float(parameter.value[0]))


def values_of(parameters: sysid.ParameterDict) -> dict[str, float]:
    """Return parameters by name."""
    return {name: float(each.value[0]) for name, each in parameters.items()}


def sequences(windows: Windows, motion: Tensor, period: float) -> sysid.ModelSequences:
    """Return windows as the toolbox takes them, from initial states `motion` [4, W]."""
    spec = cart_spec(period)
    model, times = spec.compile(), period * np.arange(-history_periods(period), windows.periods + 1)
    measured = windows.positions.transpose(2, 0, 1)
    return sysid.ModelSequences(
        "cart",
        spec,
        [str(number) for number in range(windows.number)],
        [*first_states(motion, 0.0)],
        [sysid.TimeSeries(times[:-1], each[:, None]) for each in windows.motors.T],
        [sysid.TimeSeries.from_names(times[-len(each) :], each, model) for each in measured],
    )


def roll_out(
    models: Any, datas: Any, control_signal: Any, initial_states: Any, param_dicts: Any, **mappings: Any
) -> Sequence[Any]:
    """Return the trajectories of one window for several carts, with their latency and positions in time."""
    (control, first), (starts, controls) = (control_signal[0], initial_states[0]), ([], [])
    period = float(control.times[1] - control.times[0])
    for values in map(values_of, param_dicts):
        means = delayed_means(control.data, values["latency"], period)
        means = np.concatenate((means, means[-1:]))  # the toolbox does not apply the last one
        controls.append(sysid.TimeSeries(period / SUBSTEPS * np.arange(len(means)), means))
        starts.append(first - np.eye(5)[2] * values["angle_offset"])
    rolled = sysid.sysid_rollout(models, datas, controls, starts, *mappings.values())
    names = rolled[0].sensordata.signal_mapping
    return [
        each.replace(sensordata=sysid.TimeSeries(each.state.times, each.state.data[:, 1:3], names))
        for each in rolled
    ]


def search(
    parameters: sysid.ParameterDict, windows: Windows, period: float, rounds: int
) -> tuple[sysid.ParameterDict, float]:
    """Return the toolbox's parameters after some rounds, and their cost."""
    sizes = torch.maximum(COARSE, finest_scale(windows.resolution))
    positions, motors = torch.from_numpy(windows.positions), torch.from_numpy(windows.motors)
    start, cost = None, np.inf
    for _ in range(rounds):
        cart: Any = MujocoCart.of(values_of(parameters), period)
        states = match_initial_states(cart, positions, motors, sizes, start=start)
        start = states.motion
        measured = sequences(windows, start[:, 0], period)
        residual = sysid.build_residual_fn(
            models_sequences=[measured],
            modify_residual=remaining(measured, states, positions, sizes),
            custom_rollout=roll_out,
            resample_true=False,
            n_threads=1,
        )
        with redirect_stdout(io.StringIO()):
            parameters, found = sysid.optimize(parameters, residual, verbose=False, **SEARCH)
        cost = float(found.cost)
    return parameters, cost


def remaining(
    measured: sysid.ModelSequences, states: InitialStates, positions: Tensor, sizes: Tensor
) -> Callable[..., Any]:
    """Return the residuals of windows, as the toolbox asks for them, once initial states follow the cart."""
    values, vectors = torch.linalg.eigh(states.form[0])
    roots = (vectors * values.clamp(min=0).sqrt().unsqueeze(1)).mT.numpy()  # [W, R, R]
    first = ((positions[0] - states.motion[::2, 0]) / sizes.unsqueeze(1)).T.numpy()  # the rollout lacks it
    numbers = {id(each): number for number, each in enumerate(measured.sensordata)}

    def residuals(
        parameters: Any, predicted: Any, given: Any, model: Any, everything: bool, state: Any
    ) -> tuple[Array, Any, Any]:
        number = numbers[id(given)]
        offset = np.array([0.0, parameters["angle_offset"].value[0]])
        simulated = predicted.data[SUBSTEPS - 1 :: SUBSTEPS] + offset
        scaled = np.concatenate((first[number : number + 1], (given.data[1:] - simulated) / sizes.numpy()))
        return roots[number] @ scaled.ravel(), given, given

    return residuals


def fitted(windows: Windows, period: float) -> dict[str, float]:
    """Return the cart that the toolbox finds: from each of STARTS with few windows, then with all of them."""
    few = windows._replace(
        positions=windows.positions[..., ::SCREENED],
        motors=windows.motors[:, ::SCREENED],
        episode=windows.episode[::SCREENED],
        first=windows.first[::SCREENED],
    )
    screened = [search(starting(scale), few, period, SCREENING) for scale in STARTS]
    best, _ = min(screened, key=lambda each: each[1])
    return values_of(search(best, windows, period, ROUNDS)[0])


def at_bounds(values: dict[str, float]) -> list[str]:
    """Return the names of parameters within 1 % of a bound, of the width between both."""
    return [
        name
        for name, (least, most) in BOUNDS.items()
        if min(values[name] - least, most - values[name]) < 0.01 * (most - least)
    ]
