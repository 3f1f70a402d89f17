"""Train a cart-pole agent in simulation, drive a serial cart with it, and fine-tune it there.

``docs/house.md`` describes the layers and their imports. Importing the package registers its environments
with Gymnasium, as Gymnasium expects of a package, without importing either. After that, or with
``gymnasium.make("cartpole_rl:cartpole_rl/SwingUp-v0")`` alone, Gymnasium finds the environments by name.
Gymnasium is slow to import and most of this package does not need it. If it is imported already, the
environments are registered at once, otherwise right after its import.
"""

import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

__version__ = "0.1.0"
ENVIRONMENTS = {"cartpole_rl/SwingUp-v0": "swingup", "cartpole_rl/Balance-v0": "balance"}  # id: task
MAX_EPISODE_STEPS = 500  # `duration` in conf/task/ at 0.02 s, which takes too long to read here


def register() -> None:
    """Register the environments that are not registered yet."""
    import gymnasium

    for name, task in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="cartpole_rl.envs.gymnasium:CartPoleGymnasium",
                vector_entry_point="cartpole_rl.envs.gymnasium_vector:CartPoleVector",
                kwargs={"task": task},
                max_episode_steps=MAX_EPISODE_STEPS,
            )


def _register_with_gymnasium() -> None:
    """Register now if Gymnasium is imported, otherwise right after its import."""
    if "gymnasium" in sys.modules:
        register()
    else:
        sys.meta_path.insert(0, _GymnasiumImportHook())


class _GymnasiumImportHook(MetaPathFinder):
    """A finder that makes the loader of Gymnasium register the environments."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of Gymnasium from the other finders; None for every other module."""
        if fullname != "gymnasium":
            return None
        others = (finder for finder in sys.meta_path if finder is not self)
        specs = (finder.find_spec(fullname, path, target) for finder in others)
        spec = next((spec for spec in specs if spec is not None), None)
        if spec is not None and spec.loader is not None:
            self._register_after(spec.loader)
        return spec

    def _register_after(self, loader: Loader) -> None:
        """Make `loader` register the environments once it has run the module."""
        run_module = loader.exec_module

        def run_and_register(module: ModuleType) -> None:
            run_module(module)  # if it fails, the next import is waited for
            sys.meta_path.remove(self)
            register()

        loader.exec_module = run_and_register  # type: ignore[method-assign]


_register_with_gymnasium()
