"""The equations of motion, against the thesis's own form, Gymnasium, MuJoCo and Newton's second law."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import gymnasium
import numpy as np
import pytest
import torch

pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')

import mujoco
from torch import Tensor

from cartpole_rl.physics import dynamics
from cartpole_rl.physics.dynamics import (
    Drive,
    State,
    accelerations,
    advance,
    coupling,
    mechanism,
    normal_force_ratio,
    run_period,
)
from cartpole_rl.physics.models import INTEGRATORS, Models
from cartpole_rl.physics.parameters import GRAVITY, CartParameters

MakeCart = Callable[..., CartParameters]
POLE = ("pole_mass", "pole_com", "pole_inertia")
FRICTIONLESS = Models.of(cart_friction="none", pole_friction="none", actuator="newtons")


def draw(count: int, *spread: float, seed: int = 0) -> tuple[Tensor, ...]:
    """Columns [count] in float64, each uniform within plus or minus its spread."""
    generator = torch.Generator().manual_seed(seed)
    unit = 2 * torch.rand((count, len(spread)), generator=generator, dtype=torch.float64) - 1
    return (unit * torch.tensor(spread, dtype=torch.float64)).unbind(1)


def test_accelerations_are_the_thesis_equations_for_a_uniform_rod(make_cart: MakeCart) -> None:
    x, x_dot, theta, theta_dot, f = draw(1000, 0.3, 1.0, math.pi, 10.0, 5.0)
    m_c, m_p, l, k, g = 0.7, 0.2, 0.25, 1 / 3, GRAVITY  # noqa: E741 - the thesis's letters
    cart = make_cart(1000, cart_mass=m_c, pole_mass=m_p, pole_com=l, pole_inertia=k * m_p * l**2)
    body = mechanism(cart)
    state = State(x, x_dot, theta, theta_dot)

    x_ddot, theta_ddot = accelerations(state, f, torch.zeros(1000), body, coupling(state, cart, body))

    sin, cos, m = torch.sin(theta), torch.cos(theta), m_c + m_p
    thesis_theta_ddot = (m * g * sin - cos * (f + m_p * l * theta_dot**2 * sin)) / (
        (1 + k) * m * l - m_p * l * cos**2
    )
    thesis_x_ddot = (f - m_p * l * thesis_theta_ddot * cos + m_p * l * theta_dot**2 * sin) / m
    torch.testing.assert_close(theta_ddot, thesis_theta_ddot, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(x_ddot, thesis_x_ddot, rtol=1e-12, atol=1e-12)


def test_one_explicit_step_is_gymnasiums(make_cart: MakeCart, monkeypatch: pytest.MonkeyPatch) -> None:
    reference = gymnasium.make("CartPole-v1").unwrapped
    monkeypatch.setattr(dynamics, "GRAVITY", reference.gravity)  # 9.8 there
    starts = torch.stack(draw(1000, 2.4, 3.0, math.pi, 5.0), 1)
    pushes = torch.where(draw(1000, 1.0, seed=1)[0] > 0, reference.force_mag, -reference.force_mag)
    half_length = reference.length
    cart = make_cart(
        1000,
        cart_mass=reference.masscart,
        pole_mass=reference.masspole,
        pole_com=half_length,
        pole_inertia=reference.masspole * (2 * half_length) ** 2 / 12,
    )
    models = FRICTIONLESS._replace(integrator=INTEGRATORS.find("explicit"))

    ours = advance(State(*starts.unbind(1)), pushes, cart, mechanism(cart), models, reference.tau)

    reference.reset()
    for row, (start, push) in enumerate(zip(starts.tolist(), pushes.tolist(), strict=True)):
        reference.state = np.array(start, dtype=np.float64)
        reference.steps_beyond_terminated = None
        reference.step(int(push > 0))
        theirs = torch.as_tensor(reference.state)
        torch.testing.assert_close(torch.stack(ours, 1)[row], theirs, rtol=0, atol=1e-6)


MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <option integrator="RK4" timestep="{step}">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body>
      <joint type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="{cart_mass}" diaginertia="1 1 1"/>
      <body>
        <joint type="hinge" axis="0 1 0"/>
        <inertial pos="0 0 {pole_com}" mass="{pole_mass}" diaginertia="{pole_inertia} {pole_inertia} 1e-6"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@dataclass(frozen=True)
class MujocoCart:
    """A frictionless cart in MuJoCo, written without the package's equations, in SI units.

    The hinge counts from the track's normal; a tilt of the track, positive where its right end is lower, is
    a turn of gravity.
    """

    cart_mass: float
    pole_mass: float
    pole_com: float
    pole_inertia: float
    tilt: float = 0.0
    gravity: float = 9.81

    def run(self, start: np.ndarray, force: float, seconds: float, step: float = 1e-3) -> np.ndarray:
        """State (x, x_dot, theta, theta_dot) after `seconds` from `start` under a constant `force`."""
        model = mujoco.MjModel.from_xml_string(MODEL.format(step=step, **vars(self)))
        model.opt.gravity[:] = (self.gravity * math.sin(self.tilt), 0, -self.gravity * math.cos(self.tilt))
        data = mujoco.MjData(model)
        data.qpos[:] = start[0], start[2] - self.tilt
        data.qvel[:] = start[1], start[3]
        data.qfrc_applied[0] = force
        for _ in range(round(seconds / step)):
            mujoco.mj_step(model, data)
        (x, angle), (x_dot, angle_dot) = data.qpos, data.qvel
        return np.array([x, x_dot, angle + self.tilt, angle_dot])


def test_a_cart_that_feels_less_of_the_pole_is_a_heavier_one_under_more_force(make_cart: MakeCart) -> None:
    """0.5 s from 20 states; a cart that feels nothing is a thousand tonnes."""
    felt = torch.tensor([0.3, 0.0], dtype=torch.float64).repeat_interleave(10)
    cart, larger = make_cart(20, backdrivability=felt), 1 / felt.clamp(min=1e-6)
    starts, (force,) = torch.stack(draw(20, 0.2, 0.5, math.pi, 6.0), 1), draw(20, 2.0, seed=1)
    mass, *pole = (float(getattr(cart, name)[0]) for name in ("cart_mass", *POLE))
    truth = np.stack(
        [
            MujocoCart(more * mass, *pole).run(start, more * push, 0.5)
            for start, push, more in zip(starts.numpy(), force.tolist(), larger.tolist(), strict=True)
        ]
    )
    state, body = State(*starts.unbind(1)), mechanism(cart)
    for _ in range(10_000):
        state = advance(state, force, cart, body, FRICTIONLESS, 5e-5)
    torch.testing.assert_close(torch.stack(state, 1), torch.tensor(truth), rtol=0, atol=0.01)


def test_a_stepper_holds_its_cart_on_a_tilted_track(make_cart: MakeCart) -> None:
    cart = make_cart(1, backdrivability=0.0, track_tilt=0.1)
    nothing = torch.zeros(1, dtype=torch.float64)
    state = State(nothing, nothing, nothing + 2.0, nothing + 3.0)
    for _ in range(100):
        state = advance(state, nothing, cart, mechanism(cart), FRICTIONLESS, 1e-3)
    assert (state.x, state.x_dot) == (0, 0)
    assert state.theta != 2.0


class TestAgainstMujoco:
    """2 s from 50 states that hang, swing, stand and spin, each under a force, on a level and a tilted track.

    Semi-implicit Euler's error falls with the step. With 80 substeps, 0.25 ms, the worst of the 50 is off by
    less than 5 mm and 0.1 rad, half of them by less than 1 mm and 3 mrad. Extrapolated to step 0 the worst
    is off by less than 0.5 mm and 20 mrad, half of them by less than 0.01 mm and 0.05 mrad.
    """

    SUBSTEPS = (20, 40, 80)

    @pytest.fixture(scope="class")
    def errors(self, make_cart: MakeCart) -> dict[int, Tensor]:
        """State - MuJoCo's of each track, [2, 50, 4], by the number of substeps a control period."""
        tilts = torch.tensor([0.0, 0.1], dtype=torch.float64).repeat_interleave(50)
        cart = make_cart(100, track_tilt=tilts)
        starts = torch.stack(draw(50, 0.2, 0.5, math.pi, 6.0), 1).repeat(2, 1)
        force = draw(50, 2.0, seed=1)[0].repeat(2)
        numbers = [float(getattr(cart, name)[0]) for name in ("cart_mass", *POLE)]
        truth = [
            MujocoCart(*numbers, tilt=tilt).run(start.numpy(), push, 2.0)
            for tilt, start, push in zip(tilts.tolist(), starts, force.tolist(), strict=True)
        ]
        return {
            count: (self.simulate(starts, force, cart, count) - torch.tensor(np.stack(truth))).unflatten(
                0, (2, 50)
            )
            for count in self.SUBSTEPS
        }

    def simulate(self, starts: Tensor, force: Tensor, cart: CartParameters, substeps: int) -> Tensor:
        state, body = State(*starts.unbind(1)), mechanism(cart)
        for _ in range(100 * substeps):
            state = advance(state, force, cart, body, FRICTIONLESS, 0.02 / substeps)
        return torch.stack(state, 1)

    def test_error_halves_with_the_step(self, errors: dict[int, Tensor]) -> None:
        rms = {count: error.square().mean(1).sqrt() for count, error in errors.items()}
        for coarse, fine in ((20, 40), (40, 80)):
            ratio = rms[coarse] / rms[fine]
            assert (ratio > 1.8).all()
            assert (ratio < 2.4).all()

    def test_bound_at_the_finest_step_and_limit_of_small_steps(self, errors: dict[int, Tensor]) -> None:
        for error, worst, half in (
            (errors[80], (5e-3, 0.1), (1e-3, 3e-3)),
            (2 * errors[80] - errors[40], (5e-4, 0.02), (1e-5, 5e-5)),
        ):
            positions = error[..., ::2].abs()
            assert (positions.amax(1) < torch.tensor(worst)).all()
            assert (positions.median(1).values < torch.tensor(half)).all()


@pytest.mark.parametrize("tilt", [0.0, 0.15])
def test_normal_force_is_newtons_second_law_across_the_track(make_cart: MakeCart, tilt: float) -> None:
    x, x_dot, theta, theta_dot, force = draw(200, 0.3, 1.0, math.pi, 10.0, 5.0)
    cart = make_cart(200, track_tilt=tilt)
    body = mechanism(cart)
    state = State(x, x_dot, theta, theta_dot)
    terms = coupling(state, cart, body)
    _, theta_ddot = accelerations(state, force, torch.zeros(200), body, terms)

    def height(time: Tensor) -> Tensor:
        """Of the pole's centre of mass above the track, along this motion."""
        return cart.pole_com * torch.cos(theta - tilt + theta_dot * time + theta_ddot * time**2 / 2)

    time = torch.zeros(200, dtype=torch.float64, requires_grad=True)
    (speed,) = torch.autograd.grad(height(time).sum(), time, create_graph=True)
    (rise,) = torch.autograd.grad(speed.sum(), time)
    weight = (cart.cart_mass + cart.pole_mass) * GRAVITY * math.cos(tilt)
    normal = (weight + cart.pole_mass * rise).clamp(min=0)  # the track does not pull

    torch.testing.assert_close(normal_force_ratio(state, theta_ddot, body, terms), normal / weight)


def test_a_batch_equals_its_carts_simulated_alone(make_cart: MakeCart) -> None:
    count = 16
    mass, coulomb, lag, tilt = draw(count, 0.3, 0.4, 0.01, 0.1, seed=2)
    changes = {
        "cart_mass": 0.7 + mass,
        "cart_coulomb": 0.5 + coulomb,
        "motor_time_constant": 0.01 + lag,
        "track_tilt": tilt,
    }
    start = State(*draw(count, 0.2, 0.5, math.pi, 6.0))
    motors = torch.stack([draw(count, 250.0, seed=3)[0], draw(count, 250.0, seed=4)[0]])
    latency = draw(count, 0.02, seed=5)[0].abs()
    drive = Drive(torch.zeros(count, dtype=torch.float64), motors)
    models = Models.of(cart_friction="stribeck", pole_friction="exponential_drag", pole_presses=True)

    together, drive_together = run_period(start, drive, latency, make_cart(count, **changes), models, 0.02, 4)

    for row in range(count):
        alone, drive_alone = run_period(
            State(*(value[row : row + 1] for value in start)),
            Drive(drive.force[row : row + 1], motors[:, row : row + 1]),
            latency[row : row + 1],
            make_cart(1, **{name: value[row : row + 1] for name, value in changes.items()}),
            models,
            0.02,
            4,
        )
        expected = torch.stack(together)[:, row : row + 1]
        torch.testing.assert_close(torch.stack(alone), expected, rtol=0, atol=1e-12)
        torch.testing.assert_close(drive_alone.force, drive_together.force[row : row + 1], rtol=0, atol=1e-12)
