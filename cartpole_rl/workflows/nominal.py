"""The numbers of a run's cart and pole that are not the nominal ones; needs no slow imports."""

from collections.abc import Iterable, Iterator, Mapping

from cartpole_rl.choices import group_choices
from cartpole_rl.envs.cart_pole_settings import shipped_carts
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.workflows.person import print_message


def note_other_numbers(command: str, cart: Mapping[str, float], poles: Iterable[Pole]) -> None:
    """Print the numbers of a simulated cart and its poles that are not the nominal ones, if there are any."""
    found = [*differences(cart, shipped_carts()[0])]
    for pole in poles:
        found += differences(pole.model_dump(), nominal_pole(pole).model_dump())
    if found:
        print_message(command, f"note: the cart is not the nominal one: {', '.join(found)}")


def differences(numbers: Mapping[str, float], nominal: Mapping[str, float]) -> Iterator[str]:
    """Yield a text for each of the `numbers` that is not the nominal one."""
    for name, value in numbers.items():
        if value != nominal.get(name):
            yield f"{name} {value:.4g}" + (f" instead of {nominal[name]:g}" if name in nominal else "")


def nominal_pole(pole: Pole) -> Pole:
    """Return the pole in conf/ whose length is nearest to that of `pole`."""
    shipped = (
        Pole(**each) for found in group_choices("pole").values() for each in found.get("choices", {}).values()
    )
    return min(shipped, key=lambda each: abs(each.length - pole.length))
