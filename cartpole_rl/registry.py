"""Extensions: what the configuration chooses by name, ours and a user's own alike.

A registry holds the extensions of one kind. Each of ours registers itself where it is written::

    CART_FRICTIONS = Registry("cart_friction", __name__, Law, decorated=True)

    @CART_FRICTIONS.register("step", reads=("cart_coulomb",))
    def step_force(x_dot, cart): ...

    class CartFrictionSettings(Settings):
        model: Annotated[Law, CART_FRICTIONS]  # takes a name, holds the law, is stored as the name

A class that is slow to import is registered by its place and imported when it is first used::

    PLANTS = Registry("plant", __name__)
    PLANTS.add("simulated", "cartpole_rl.plants.simulated:SimulatedPlant")
    PLANTS.find("simulated")(carts, ...)

A user's own extension needs no edit here. It is chosen

- as ``module:name``, for an object of a module in the current folder, on PYTHONPATH, or installed:
  ``cart_friction.model=my_laws:tanh_force``,
- or by the name of an entry point of an installed package, in the group ``cartpole_rl.<kind>``.

What settings and files store is the name that was given.
"""

import re
import sys
import traceback
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from cartpole_rl.errors import ConfigError

Object = TypeVar("Object")
OWN = "your own as module:name"


class Extension(str):
    """The name of a registered object, with the object: calls are passed on to it.

    It equals its name. A subclass adds the properties that are given when an extension of its kind is
    registered, as keywords of its constructor.
    """

    registry: "Registry[Any]"

    def __new__(cls, name: str, item: Any, **properties: Any) -> "Extension":
        """Return the extension `item`: the object, or its place as "module:name"."""
        return super().__new__(cls, name)

    def __init__(self, name: str, item: Any) -> None:
        self._item = item

    @property
    def item(self) -> Any:
        """The function or class. Raises ConfigError if its module cannot be imported."""
        if isinstance(self._item, str):
            self._item = object_at(self._item)
        return self._item

    def named(self, name: str) -> Self:
        """Return the same extension under another name."""
        other = str.__new__(type(self), name)
        vars(other).update(vars(self))
        return other

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Return the result of the function or class."""
        return self.item(*arguments, **named)

    def __reduce__(self) -> tuple[Any, ...]:
        return _recall, (self.registry.home, self.registry.kind, str(self))


Kind = TypeVar("Kind", bound=Extension)


class Registry(Generic[Kind]):
    """The extensions of one `kind`, such as "cart_friction".

    `home` is the `__name__` of the module that imports or registers all of ours. Extensions are an `entry`
    each. `check` raises ValueError for an object that cannot be one. If they must be `decorated`, an object
    that was not registered is refused; otherwise it is taken without properties.
    """

    all: dict[str, "Registry[Any]"] = {}  # noqa: RUF012 - by kind

    def __init__(
        self,
        kind: str,
        home: str,
        entry: type[Kind] = Extension,  # type: ignore[assignment]
        check: Callable[[Any], object] | None = None,
        decorated: bool = False,
    ) -> None:
        self.kind, self.home, self.entry, self.check, self.decorated = kind, home, entry, check, decorated
        self._entries: dict[str, Kind] = {}
        Registry.all[kind] = self

    def __iter__(self) -> Iterator[Kind]:
        """Iterate over the registered extensions; those of entry points come in once they are used."""
        return iter(self._entries.values())

    def loaded(self) -> list[Kind]:
        """Return all extensions, those of entry points included. Raises ConfigError."""
        return [self.find(name) for name in self.names]

    @property
    def names(self) -> list[str]:
        """The names to choose from, entry points included."""
        return [*{**self._entries, **dict.fromkeys(_entry_points(self.kind))}]

    def add(self, name: str, item: Any, **properties: Any) -> Kind:
        """Register an object, or its place as "module:name". Raises ConfigError if it is refused.

        An object of the same place replaces one: a module is run again after an error in it, or by reload.
        """
        if name in self._entries and not same_place(self._entries[name]._item, item):
            raise ConfigError(f"there is a {self.words} {name!r} already: choose another name")
        if self.check and not isinstance(item, str):
            try:
                self.check(item)
            except ValueError as error:
                raise ConfigError(f"{name} is no {self.words}: {error}") from None
        entry = self.entry(name, item, **properties)
        entry.registry = self
        self._entries[name] = entry
        return entry

    def register(self, name: str = "", **properties: Any) -> Callable[[Object], Object]:
        """Register the function or class below this decorator; without a name, as "module:name"."""

        def registered(item: Object) -> Object:
            place = f"{getattr(item, '__module__', '')}:{getattr(item, '__qualname__', '')}"
            self.add(name or place, item, **properties)
            return item

        return registered

    def find(self, name: str) -> Kind:
        """Return the extension of that name. Raises ConfigError in one line if there is none."""
        try:
            found = self._found(name)
        except ConfigError as error:
            raise ConfigError(f"{self.words} {name!r}: {error}") from None
        if found is None:
            raise ConfigError(f"{self.words} {name!r} is unknown: give {self.expected}")
        return found

    def _found(self, name: str) -> Kind | None:
        """Return the extension of that name, a user's registered under it; None without one."""
        if name in self._entries:
            return self._entries[name]
        place = name if ":" in name else _entry_points(self.kind).get(name)
        if place is None:
            return None
        item = object_at(place)
        found = next((each for each in self if each._item is item), None)
        if found is None and self.decorated:
            raise ConfigError(f"{place} is not registered as a {self.words}; docs/extending.md shows how")
        if found is None:
            return self.add(name, item)
        return self._entries.setdefault(name, found.named(name))

    @property
    def words(self) -> str:
        """The kind in words."""
        return self.kind.replace("_", " ")

    @property
    def expected(self) -> str:
        """The names to choose from, in words."""
        return f"{', '.join(map(repr, self.names))}, or {OWN}"

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Validate a name as its extension; JSON has the name."""
        return core_schema.no_info_plain_validator_function(
            self._validated, serialization=core_schema.to_string_ser_schema()
        )

    def _validated(self, given: Any) -> Kind:
        if not isinstance(given, str):
            raise PydanticCustomError("string_type", "give text")
        try:
            found = self._found(given)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        if found is None:
            raise PydanticCustomError("enum", "give {expected}", {"expected": self.expected})
        return found


def of_module(item: Any) -> str | None:
    """Return the name of the module in which an object was written; None for a place."""
    return getattr(item, "__module__", None)


def same_place(one: Any, other: Any) -> bool:
    """Return whether two objects have the same module, and the same name in it."""
    name = getattr(one, "__qualname__", "<none>")
    same = of_module(one) == of_module(other) and name == getattr(other, "__qualname__", None)
    return same and "<" not in name  # several functions can be <lambda> or <locals>


def _recall(home: str, kind: str, name: str) -> Extension:
    """Return an extension that was pickled."""
    import_module(home)
    return Registry.all[kind].find(name)


@cache
def _entry_points(kind: str) -> dict[str, str]:
    """Return the places, "module:name", of the extensions of installed packages, by their names."""
    return {point.name: point.value for point in entry_points(group=f"cartpole_rl.{kind}")}


def object_at(place: str) -> Any:
    """Return the object at "module:name". Raises ConfigError."""
    module, _, name = place.partition(":")
    if not re.fullmatch(r"\w+(\.\w+)*", module) or not name:
        raise ConfigError("write it as module:name")
    found = _module(module)
    for part in name.split("."):
        if not hasattr(found, part):
            raise ConfigError(f"the module {module} has no {name!r}")
        found = getattr(found, part)
    return found


def _module(name: str) -> Any:
    """Import a module, also from the current folder. Raises ConfigError in one line."""
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.append(here)
    try:
        return import_module(name)
    except (Exception, SystemExit) as error:
        for registry in Registry.all.values():  # nothing of a module that is not whole
            entries = registry._entries.items()
            registry._entries = {key: each for key, each in entries if of_module(each._item) != name}
        if isinstance(error, ConfigError):  # an extension in it is refused
            raise
        if isinstance(error, ModuleNotFoundError) and name.startswith(str(error.name)):
            places = "in the current folder, on PYTHONPATH or among installed packages"
            raise ConfigError(f"there is no module {error.name!r} {places}") from None
        last = traceback.extract_tb(error.__traceback__)[-1]
        why = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ConfigError(f"{name} cannot be imported: {why} ({last.filename}, line {last.lineno})") from None
