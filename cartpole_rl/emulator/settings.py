"""The settings of the emulated cart, in SI units: its true parameters, its imperfections and its faults.

The default cart is not the nominal one: it differs from the simulator's nominal cart by as much as a real
cart differs from one that was weighed and measured by hand. ``docs/emulator.md`` compares the two. Signs:
x, motor and angles are positive to the right; angle 0 is upright.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from cartpole_rl.checking import validated
from cartpole_rl.choices import choice, is_own_file, load
from cartpole_rl.errors import ConfigError
from cartpole_rl.rig.hardware import LARGEST_MOTOR, Hardware, hardware_of, nominal_hardware
from cartpole_rl.rig.parameters import check_cart, completed
from cartpole_rl.settings import Finite, Fraction, NonNegative, Positive, Settings

Share = Annotated[float, Field(allow_inf_nan=False, ge=0, le=0.9)]  # of frames; above it hardly one arrives
ONBOARD = Path("onboard")  # as `policy`: the agent that is evaluated
Port = Literal["auto", "pty", "tcp"]
MotorValue = Annotated[float, Field(ge=0, le=LARGEST_MOTOR)]
Coefficient = Annotated[float, Field(allow_inf_nan=False)]
Mass = Annotated[float, Field(ge=1e-6, allow_inf_nan=False)]  # kg; MuJoCo takes none near 0
Inertia = Annotated[float, Field(ge=1e-11, allow_inf_nan=False)]  # kg m^2; likewise
# numbers of a file that the emulated cart has, and that scale those of the default cart or are added to them
TAKEN = ("backdrivability", "coasting")
SCALED = ("cart_mass", "cart_viscous", "pole_viscous", "pole_drag")
ADDED = ("force_asymmetry", "motor_time_constant", "latency_jitter", "track_tilt", "angle_offset")


def _numbers(cart: Any) -> Any:
    """Return the numbers of a person's own file, which a run keeps when the file is changed or moved."""
    if not is_own_file(cart):
        return cart
    try:
        return load("cart", cart).values
    except ConfigError as error:
        raise ConfigError(f"emulator.{error}") from None


class EmulatorSettings(Settings):
    """The settings ``emulator.*``. Raises pydantic's ValidationError for a wrong name or value."""

    clock: Literal["lockstep", "real"] = "lockstep"  # one period for each frame, or 50 Hz by the wall clock
    # the reference, or the portable C of a real cart, compiled on first use
    firmware: Literal["python", "c"] = "python"
    # folder of an agent in C that drives after START_POLICY; in cartpole-evaluate onboard: the agent of run=
    policy: Path | None = None
    port: Port = "auto"  # a pseudo-terminal or a local TCP port; auto: pty where the system has it
    hardware: Hardware | None = None  # of the cart's file, which the firmware is built with; None: ip02's
    # a choice, or the numbers of a file, of cart=, which this cart is like; None: those of the command
    cart: Annotated[str | dict[str, Finite] | None, BeforeValidator(_numbers)] = None
    given: tuple[str, ...] = ()  # settings that cart= does not replace: those that the user gave
    seed: Annotated[int, Field(ge=0)] = 0  # of latencies, disturbed frames, boot position, the hand's angle

    cart_mass: Mass = 0.735  # kg, rotor included
    pole_mass: Mass = 0.129  # kg
    pole_com: Positive = 0.1765  # m, pivot to centre of mass
    pole_inertia: Inertia = 1.22e-3  # kg m^2, about the centre of mass
    track_half_length: Annotated[float, Field(ge=0.05, le=10)] = 0.409  # m, middle to a stop or an end switch

    cart_viscous: NonNegative = 0.65  # N s/m
    cart_coulomb_left: NonNegative = 0.58  # N, while the cart moves left
    cart_coulomb_right: NonNegative = 0.53  # N, while the cart moves right
    cart_stiction_ratio: Annotated[float, Field(ge=1, le=10)] = 1.2  # breakaway force / Coulomb friction
    cogging: NonNegative = 0.0  # N, amplitude of a force ripple along the track
    cogging_pitch: Positive = 0.04  # m, of that ripple: a turn of the pinion
    pole_viscous: NonNegative = 3.0e-4  # N m s
    pole_coulomb: NonNegative = 2.0e-4  # N m
    pole_drag: NonNegative = 2.5e-5  # N m s^2, times the square of the angular speed

    backdrivability: Fraction = 1.0  # share of the pole's and gravity's force that moves the cart; stepper: 0
    coasting: Fraction = 0.0  # share of cart_viscous that fades with the motor value
    # [a, b, c]: F = sign(u) max(0, a u^2 + b |u| + c), N
    force_curve: tuple[Coefficient, Coefficient, Coefficient] = (0.0, 0.0198, -0.99)
    force_asymmetry: Annotated[float, Field(ge=-0.9, le=0.9)] = 0.03  # force to the right: times 1 + this
    deadband_left: MotorValue = 55.0  # motor values from minus this to 0 give no force
    deadband_right: MotorValue = 60.0  # motor values from 0 to this give no force
    motor_time_constant: Annotated[float, Field(ge=0, le=1)] = 0.005  # s, first-order lag of the force
    latency: Annotated[float, Field(ge=0, le=1)] = 0.003  # s, from a command's arrival to its effect
    latency_jitter: Annotated[float, Field(ge=0, le=1)] = 0.001  # s, each latency differs by up to this

    track_tilt: Annotated[float, Field(ge=-0.2, le=0.2)] = 0.002  # rad; positive if the right end is lower
    angle_offset: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.004  # rad, measured minus true after homing

    frame_loss: Share = 0.0  # share of frames lost, in each direction
    frame_corruption: Share = 0.0  # share of frames with a wrong byte, in each direction
    frame_duplication: Share = 0.0  # share of frames that arrive twice, in each direction
    frame_reordering: Share = 0.0  # share of frames that arrive after the next one, in each direction

    unplug_at: Positive | None = None  # s since the start; the cable is pulled and the process ends
    reset_at: Positive | None = None  # s since the start; the firmware restarts
    clock_rate: Annotated[float, Field(ge=0.1, le=10)] = 1.0  # s that the firmware's clock passes in a second
    stuck_encoder: Literal["none", "cart", "pole"] = "none"  # the encoder whose count freezes
    stuck_at: NonNegative = 0.0  # s since the start; the count freezes then

    # near the middle with a hanging pole, or anywhere with a turning pole
    boot: Literal["hanging", "anywhere"] = "hanging"
    start: Literal["hanging", "upright"] = "hanging"  # upright: a hand holds the pole up before START
    knock: NonNegative = 0.0  # rad/s that a hand adds once to a pole that has stood for 2 s, after each START
    journal: Path | None = None  # new file for commands carried out and motor values in force
    physics_step: Annotated[float, Field(ge=1e-5, le=1e-3)] = 5e-4  # s, the longest step of the physics

    @model_validator(mode="after")
    def _no_setting_is_without_effect(self) -> Self:
        if self.policy is not None and self.firmware != "c":
            raise ValueError("policy is C code, which the Python firmware cannot run: set firmware=c")
        if self.stuck_at > 0 and self.stuck_encoder == "none":
            raise ValueError(
                "stuck_at has no effect without stuck_encoder: set stuck_encoder=cart or stuck_encoder=pole"
            )
        return self

    def of_cart(self, cart: Mapping[str, float]) -> Self:
        """Return the settings of a cart with the hardware and the numbers of a file, or of `self.cart`.

        Where these settings are still those of the default cart, and not `given`, they become those of one
        that differs from the file as the default cart differs from ip02's. A file with ip02's hardware
        changes nothing. Raises ConfigError for another rig than `hardware` or that of `self.cart`.
        """
        check_cart(cart)
        hardware, of_ip02 = hardware_of(cart), choice("cart/ip02")
        followed = self._numbers_for(hardware) or cart
        if self.hardware == hardware or (self.hardware is None and hardware == nominal_hardware()):
            return self
        if self.hardware is not None:
            raise ConfigError("emulator.hardware: it differs from the rig of cart=; leave it out, give cart=")
        numbers, default = completed({**of_ip02, **followed}), EmulatorSettings()

        def times(name: str, of: str = "") -> float:
            return getattr(default, name) * numbers[of or name] / of_ip02[of or name]

        def plus(name: str) -> float:
            return getattr(default, name) + numbers[name] - of_ip02[name]

        def coulomb(name: str, side: int) -> float:
            return times(name, "cart_coulomb") * (1 + side * numbers["cart_coulomb_asymmetry"])

        def wide(name: str) -> float:
            start = zero_force_motor(numbers) / zero_force_motor(of_ip02)
            return min(LARGEST_MOTOR, max(start * getattr(default, name), numbers[name]))

        _, slope, constant = default.force_curve
        scaled = {
            "track_half_length": default.track_half_length
            + hardware.half_span
            - nominal_hardware().half_span,
            "cart_coulomb_left": coulomb("cart_coulomb_left", -1),
            "cart_coulomb_right": coulomb("cart_coulomb_right", 1),
            "pole_coulomb": times("pole_coulomb", "pole_viscous") + numbers["pole_coulomb"],
            "force_curve": (
                numbers["force_quadratic"],
                slope * numbers["force_linear"] / of_ip02["force_linear"],
                constant * numbers["force_offset"] / of_ip02["force_offset"],
            ),
            "cart_stiction_ratio": max(1.0, times("cart_stiction_ratio")),
            "deadband_left": wide("deadband_left"),
            "deadband_right": wide("deadband_right"),
            "latency": max(0.0, plus("latency")),
            **{name: numbers[name] for name in TAKEN},
            **{name: times(name) for name in SCALED},
            **{name: plus(name) for name in ADDED},
        }
        changes = {
            name: value
            for name, value in scaled.items()
            if name not in self.given and getattr(self, name) == getattr(default, name)
        }
        values = {**self.model_dump(), **changes, "hardware": hardware}
        return validated(type(self), values, lambda _: "the emulated cart of cart=: emulator.")

    def _numbers_for(self, hardware: Hardware) -> dict[str, float]:
        """Return the numbers of `cart`, if any. Raises ConfigError for a given one of another rig."""
        try:
            cart = load("cart", self.cart).values
            check_cart(cart)
        except ConfigError as error:
            raise ConfigError(f"emulator.cart: {error}") from None
        rig = hardware_of(cart)
        if not cart or rig == hardware:
            return cart
        if isinstance(self.cart, str) and "cart" not in self.given:
            return {}  # a choice of conf/emulator/ was taken for its pole
        name, value = next(each for each in rig if each[1] != getattr(hardware, each[0]))
        raise ConfigError(
            f"emulator.cart: it has {name} {value:g}, but the cart of this command or of the agent's "
            f"training {getattr(hardware, name):g}; give the file of that cart, or emulator.cart=null"
        )


def zero_force_motor(cart: Mapping[str, float]) -> float:
    """Return the motor value at which the force of a cart's linear curve starts; 0 without a slope."""
    slope = cart["force_linear"]
    return max(0.0, -cart["force_offset"] / slope) if slope else 0.0
