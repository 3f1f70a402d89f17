"""Laws of physics that a person chooses by name: friction, actuators, integrators.

A law is one function that registers itself, with the parameters of the cart that it reads. The pages of
`cartpole_rl.physics.friction` and `cartpole_rl.physics.actuator` hold ours; docs/extending.md shows how to
write another. Formulas use methods of tensors alone, so that settings can import laws without PyTorch.
"""

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from cartpole_rl.errors import ConfigError
from cartpole_rl.registry import Extension, Registry
from cartpole_rl.rig.parameters import PARAMETERS, Parameter, add_parameter, check_names

if TYPE_CHECKING:
    from torch import Tensor

    from cartpole_rl.physics.parameters import CartParameters

Formula = Callable[["Tensor", "CartParameters"], "Tensor"]  # of a velocity or motor value, and the carts, [N]


class Law(Extension):
    """A law. It `reads` parameters of the cart by name, or new ones, which enter the table of parameters."""

    def __init__(
        self,
        name: str,
        item: Formula,
        reads: tuple[str | Parameter, ...] = (),
        holds_at_rest: bool = False,
        candidate: bool = False,
    ) -> None:
        """Register a law; friction that `holds_at_rest` stops a cart and never reverses it.

        A `candidate` is tried in every identification.
        """
        super().__init__(name, item)
        own = [each for each in reads if isinstance(each, Parameter)]
        for parameter in own:
            add_parameter(parameter)
        self.brings = tuple(each.name for each in own)  # parameters that no other law knows
        self.reads = tuple(each.name if isinstance(each, Parameter) else each for each in reads)
        check_names(self.reads, f"reads of {name}")
        self.holds_at_rest, self.candidate = holds_at_rest, candidate

    @property
    def has_formula(self) -> bool:
        """The formula is not just 0."""
        return self.item is not zero


def law_registry(kind: str) -> "Registry[Law]":
    """Return the registry of one kind of law; `cartpole_rl.physics.models` imports all of ours."""
    return Registry(kind, "cartpole_rl.physics.models", Law, _check_formula, decorated=True)


def _check_formula(formula: Any) -> None:
    """Raise ValueError for what does not take two arguments."""
    try:
        inspect.signature(formula).bind(None, None)
    except (TypeError, ValueError):
        raise ValueError("it must be a function of two arguments") from None


class _Watched:
    """A cart that remembers which of its parameters a formula reads."""

    def __init__(self, cart: "CartParameters") -> None:
        self._cart = cart
        self.read: set[str] = set()

    def __getattr__(self, name: str) -> Any:
        self.read.add(name)
        return getattr(self._cart, name)


def tried(law: Law, values: "Tensor", cart: "CartParameters") -> "Tensor":
    """Return the formula at `values` [N], for one cart. Raises ConfigError if it cannot be used."""
    watched, place = _Watched(cart), f"{law.registry.kind}={law}"
    try:
        result = law(values, watched)
    except Exception as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ConfigError(f"{place}: its formula fails: {reason}") from None
    if undeclared := sorted((watched.read & PARAMETERS.keys()).difference(law.reads)):
        raise ConfigError(f"{place} reads {', '.join(undeclared)}: add it to its `reads`")
    if getattr(result, "shape", None) != values.shape or not result.isfinite().all():
        raise ConfigError(f"{place}: its formula must give a finite number for each of N carts, [N]")
    return result


def zero(of: "Tensor", cart: "CartParameters") -> "Tensor":
    """Return 0, [N]: the formula of a law without one."""
    return of.new_zeros(of.shape)
