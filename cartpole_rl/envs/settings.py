"""Settings of a whole environment: cart, randomization, task, observation and track guard."""

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any

from pydantic import (
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    Tag,
    field_validator,
    model_serializer,
)

from cartpole_rl.choices import group_choices
from cartpole_rl.physics.friction import CART_FRICTIONS, POLE_FRICTIONS
from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.models import Models
from cartpole_rl.plants.settings import SimulationSettings
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.randomization.ranges import IdentifiedSettings, Range
from cartpole_rl.rig.hardware import RigSettings, hardware_of, nominal_hardware, parameters_of
from cartpole_rl.rig.parameters import completed
from cartpole_rl.settings import Finite, NonNegative, Positive, Settings
from cartpole_rl.tasks.features import ObservationKind
from cartpole_rl.tasks.settings import ActionSettings, RewardSettings, TaskSettings

POSITIONS = ObservationKind.POSITIONS.mirror_signs
LARGEST_MARGIN = 0.3  # m, of a track guard: most of half a track
LONGEST_POLE = 3.0  # m, in a track guard


class ObservationSettings(Settings):
    """The observation: the measured state and what the agent remembers."""

    kind: ObservationKind
    past_motors: int = Field(ge=0, le=16)  # number of last motor values
    past_velocities: int = Field(ge=0, le=16)  # number of last velocities
    past_positions: int = Field(ge=0, le=16)  # number of last positions, each as kind `positions`
    pole_length: bool  # the length of the pole, as labelled on it

    @property
    def past_size(self) -> int:
        """Size of the past: motor values, velocities, positions, each newest first."""
        return self.past_motors + 2 * self.past_velocities + len(POSITIONS) * self.past_positions

    @property
    def size(self) -> int:
        """Size of an observation."""
        return self.kind.size + self.past_size + int(self.pole_length)

    @property
    def mirror_signs(self) -> list[int]:
        """The factor of each number of an observation when left and right are swapped, [size]."""
        return [
            *self.kind.mirror_signs,
            *[-1] * (self.past_motors + 2 * self.past_velocities),
            *POSITIONS * self.past_positions,
            *[1] * self.pole_length,
        ]

    @property
    def frames(self) -> list[list[int]]:
        """The indices of each frame in an observation, oldest first: its positions and the last motor value.

        Empty unless the kind is `positions` and each position has its motor value.
        """
        if self.kind is not ObservationKind.POSITIONS or self.past_motors <= self.past_positions:
            return []
        size, first = len(POSITIONS), self.size - int(self.pole_length) - len(POSITIONS) * self.past_positions
        places = [0, *range(first, first + size * self.past_positions, size)]  # of x, newest first
        return [[*range(place, place + size), size + age] for age, place in enumerate(places)][::-1]


class GuardedPole(Settings):
    """The pole in a track guard: see `envs/guard.py`."""

    swing: NonNegative  # share of the way that the swinging pole can move the cart
    density: NonNegative  # 1/m: mass of the pole over its length and over the cart's mass
    # m; None: as the agent observes it
    length: Annotated[float, Field(gt=0, le=LONGEST_POLE)] | None = None


class TrackGuard(Settings):
    """The numbers of a track guard: see `envs/guard.py`."""

    margin: Annotated[float, Field(ge=0, lt=LARGEST_MARGIN)]  # m
    delay: NonNegative  # s
    deceleration: Positive  # m/s^2, of the cart without its pole; with it where there is no `pole`
    pole: GuardedPole | None = None
    also: "TrackGuard | None" = None  # a second guard: either one may brake

    @model_serializer(mode="wrap")
    def _as_earlier(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what a guard of an earlier version does not have: exported agents have a checksum."""
        return {name: value for name, value in serialize(self).items() if value is not None}

    @property
    def each(self) -> list["TrackGuard"]:
        """The guard, and the others that brake."""
        return [self, *(self.also.each if self.also else ())]

    @property
    def reads_length(self) -> bool:
        """True if it needs the length of the pole that the agent observes."""
        return any(each.pole and each.pole.length is None for each in self.each)

    def __str__(self) -> str:
        """Return the numbers with their units."""
        pole = f" (pole of {self.pole.length:.2f} m)" if self.pole and self.pole.length else ""
        swing = f", swing {self.pole.swing:g}{pole}" if self.pole else ""
        own = f"margin {self.margin:g} m, delay {self.delay:g} s, deceleration {self.deceleration:g} m/s^2"
        return f"{own}{swing}" + (f"; also {self.also}" if self.also else "")


class GuardSettings(Settings):
    """The track guard: its numbers, or the quantile by which they are fitted to the carts."""

    enabled: bool
    quantile: Annotated[float, Field(gt=0, le=1)]  # of the ways that braking carts run on
    numbers: TrackGuard | None  # None: fitted when a training starts

    @property
    def active(self) -> TrackGuard | None:
        """The guard to drive with, None if it is disabled or not yet fitted."""
        return self.numbers if self.enabled else None


def _randomization_kind(given: Any) -> str:
    """Return "identified" for the posterior of an identification, "ranges" for ranges by parameter name."""
    identified = isinstance(given, IdentifiedSettings) or (
        isinstance(given, Mapping) and "posterior" in given
    )
    return "identified" if identified else "ranges"


Randomization = Annotated[
    Annotated[dict[str, Range], Tag("ranges")] | Annotated[IdentifiedSettings, Tag("identified")],
    Discriminator(_randomization_kind),
]
SHORTEST_PERIOD, LONGEST_PERIOD = 0.005, 0.1  # s
ControlPeriod = Annotated[float, Field(ge=SHORTEST_PERIOD, le=LONGEST_PERIOD)]


class FrictionSettings(Settings):
    """A friction law, and numbers of the cart under it: see `driven_numbers`."""

    model: Any  # a Law of one registry
    parameters: dict[str, Finite]

    @field_validator("parameters", mode="before")
    @classmethod
    def _null_is_the_number_of_the_cart(cls, given: Any) -> Any:
        is_mapping = isinstance(given, Mapping)
        return {name: value for name, value in given.items() if value is not None} if is_mapping else given


class CartFrictionSettings(FrictionSettings):
    """The friction law of the cart."""

    model: Annotated[Law, CART_FRICTIONS]


class PoleFrictionSettings(FrictionSettings):
    """The friction law of the pole."""

    model: Annotated[Law, POLE_FRICTIONS]


@cache
def shipped_numbers(group: str, model: str) -> dict[str, float]:
    """Return the numbers of the cart that the choice of a friction model in conf/ gives; {} without one."""
    choices = (each for each in group_choices(group).values() if each["model"] == model)
    return next((dict(each["parameters"]) for each in choices), {})


@cache
def shipped_carts() -> tuple[dict[str, float], ...]:
    """Return the carts in conf/."""
    return tuple(group_choices("cart").values())


@cache
def replaced_carts() -> tuple[dict[str, float], ...]:
    """Return the carts in conf/ whose friction is that of a friction model's choice: those on ip02's rig."""
    return tuple(each for each in shipped_carts() if hardware_of(each) == nominal_hardware())


def driven_numbers(cart: Mapping[str, float], *frictions: FrictionSettings) -> dict[str, float]:
    """Return the numbers of the cart that is driven, without the pole's.

    A number of ip02 or thesis gives way to that of a friction model's choice in conf/. What a person
    gave replaces both; with `cart` and with a friction model, that with the friction model holds.
    """
    numbers = dict(cart)
    for friction in frictions:
        defaults = shipped_numbers(friction.model.registry.kind, friction.model)
        for name, value in friction.parameters.items():
            is_nominal = name not in cart or any(
                cart[name] == shipped.get(name) for shipped in replaced_carts()
            )
            if is_nominal or value != defaults.get(name):
                numbers[name] = value
    return numbers


class CartSettings(RigSettings):
    """The nominal cart, without a friction law of its own: a fit chooses one."""

    pole_friction: PoleFrictionSettings

    @property
    def frictions(self) -> tuple[FrictionSettings, ...]:
        """The friction laws that are chosen."""
        return (self.pole_friction,)

    @property
    def nominal_cart(self) -> dict[str, float]:
        """The parameters of the cart that is driven, or varied, without the pole's."""
        return completed(driven_numbers(parameters_of(self.cart), *self.frictions))

    def nominal_with(self, pole: Pole) -> dict[str, float]:
        """Return the nominal parameters of the cart with `pole`."""
        return {**self.nominal_cart, **pole.model_dump()}


class CartPoleSettings(CartSettings):
    """Settings of an environment without its plant, shared by training and evaluation."""

    cart_friction: CartFrictionSettings
    pole: PoleSettings
    actions: ActionSettings
    task: TaskSettings
    reward: RewardSettings
    observation: ObservationSettings
    guard: GuardSettings
    randomization: Randomization
    control_period: ControlPeriod

    @property
    def frictions(self) -> tuple[FrictionSettings, ...]:
        """The friction laws that are chosen."""
        return self.cart_friction, self.pole_friction

    @property
    def ranges(self) -> dict[str, Range]:
        """The ranges of the randomization; of an identified cart, those that it leaves open."""
        given = self.randomization
        return given.ranges if isinstance(given, IdentifiedSettings) else given

    def models(self, plant: SimulationSettings, actuator: Law | None = None) -> Models:
        """Return the physics models of the cart on `plant`, by default with its own actuator."""
        laws = self.cart_friction.model, self.pole_friction.model, actuator or self.actions.actuator
        return Models(*laws, plant.integrator, plant.pole_presses)
