"""Curves and pictures of a run on Weights & Biases, over the number of transitions, and in MLflow.

The environment variables of both hold, such as `WANDB_PROJECT` and `WANDB_MODE=offline`. MLflow is in
`runs/mlflow.db`, or wherever `MLFLOW_TRACKING_URI` says; `MLFLOW_EXPERIMENT_NAME` names the experiment. The
jobs of a sweep are a group of wandb, and have the sweep's name as the tag `sweep` in MLflow. A resumed run
goes on in the same run of either; points after its checkpoint then stand twice.
"""

import io
import logging
import os
import re
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from PIL import Image

from cartpole_rl.errors import ConfigError, reason_of
from cartpole_rl.files import locked, write_text
from cartpole_rl.reporting.loggers import Logger, flatten, library, sweep_of
from cartpole_rl.reporting.style import png
from cartpole_rl.terminal import print_message

PROJECT, AXIS = "cartpole_rl", "transitions"  # of wandb
SQLITE, STORE, PICTURES, EXPERIMENT = "sqlite:///", "runs/mlflow.db", "runs/mlflow", "cartpole_rl"
# in the run folder: its run; in MLflow's also the store
WANDB_RUN, MLFLOW_RUN = "wandb_run.txt", "mlflow_run.txt"
PATIENCE = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1", "MLFLOW_HTTP_REQUEST_TIMEOUT": "10"}  # else minutes
MOST = 100  # parameters that MLflow takes at once
SLOW, PAUSE = 1, 300  # s; after a call that failed so slowly, nothing is sent for so long


class WandbLog(Logger):
    """A run of Weights & Biases, which writes at once, in a process of its own.

    Raises ConfigError where nobody is logged in.
    """

    def __init__(self, folder: Path, purge_step: int | None = None) -> None:
        self._wandb, file = library("wandb"), folder / WANDB_RUN
        try:
            self._run = self._wandb.init(
                project=os.environ.get("WANDB_PROJECT", PROJECT),
                name=folder.name,
                group=sweep_of(folder),
                dir=folder,
                id=(file.read_text() or None) if purge_step is not None and file.exists() else None,
                resume="allow",
                settings=self._wandb.Settings(silent=True, console="off"),
            )
        except self._wandb.errors.Error as error:
            raise ConfigError(f"logger=wandb: {reason_of(error)} Or set WANDB_MODE=offline") from None
        write_text(file, self._run.id)
        self._exit_code = 0
        self._run.define_metric("*", step_metric=AXIS)

    def scalars(self, values: Mapping[str, float | None], step: int) -> None:
        """Log one point of each curve; None is no point."""
        self._run.log({**{name: each for name, each in values.items() if each is not None}, AXIS: step})

    def histogram(self, name: str, values: ArrayLike, step: int) -> None:
        """Log the distribution of the finite `values`, of any shape."""
        flat = np.asarray(values, dtype=np.float64).ravel()
        self._run.log({name: self._wandb.Histogram(flat[np.isfinite(flat)]), AXIS: step})

    def figure(self, name: str, figure: Figure, step: int) -> None:
        """Log a figure as a picture."""
        self._run.log({name: self._wandb.Image(Image.open(io.BytesIO(png(figure)))), AXIS: step})

    def animation(self, name: str, gif: bytes, step: int) -> None:
        """Log an animation, the bytes of a GIF."""
        path = Path(self._run.dir) / f"{name.replace('/', '_')}_{step}.gif"
        path.write_bytes(gif)
        self._run.log({name: self._wandb.Video(str(path), format="gif"), AXIS: step})

    def hparams(self, config: Mapping[str, Any], metrics: Mapping[str, float | None]) -> None:
        """Log the settings, with dotted names, and the final metrics as the summary."""
        self._run.config.update(flatten(config), allow_val_change=True)
        self._run.summary.update({f"summary/{name}": each for name, each in metrics.items()})

    def fail(self, error: BaseException) -> None:
        """Let the run end as failed."""
        self._exit_code = 1

    def close(self) -> None:
        """Send or write the rest."""
        self._run.finish(self._exit_code)


class MlflowLog(Logger):
    """A run of MLflow, which has no histograms and writes at once.

    Raises ConfigError where the server does not answer, or has not the run that is resumed. Jobs of a sweep
    make a database one after the other.
    """

    def __init__(self, folder: Path, purge_step: int | None = None) -> None:
        for name, number in PATIENCE.items():
            os.environ.setdefault(name, number)
        self._mlflow, file = library("mlflow"), folder / MLFLOW_RUN
        logging.getLogger("mlflow").setLevel(logging.WARNING)  # not how it makes its tables
        known = file.read_text().splitlines() if purge_step is not None and file.exists() else []
        run, recorded, *_ = *known, "", ""
        store = os.environ.get("MLFLOW_TRACKING_URI") or recorded or f"{SQLITE}{STORE}"
        database = Path(store.removeprefix(SQLITE)) if store.startswith(SQLITE) else None
        try:
            with locked(database.with_suffix(".lock")) if database else nullcontext():
                self._client = self._mlflow.MlflowClient(store)
                if run:
                    self._client.update_run(run, status="RUNNING")
                else:
                    tags = {"sweep": sweep} if (sweep := sweep_of(folder)) else {}
                    created = self._client.create_run(self._experiment(), run_name=folder.name, tags=tags)
                    run = created.info.run_id
        except Exception as error:  # of MLflow, SQLAlchemy or Alembic
            raise ConfigError(f"logger=mlflow, {store}: {reason_of(error)}") from None
        self._run, self._lost, self._status = run, False, "FINISHED"
        self._pause_ends = 0.0  # s, of the monotonic clock
        if database:
            store = f"{SQLITE}{database.absolute().as_posix()}"
        elif "@" in store:  # after a password
            store = ""
        write_text(file, f"{run}\n{store}\n")

    def _experiment(self) -> str:
        """Return the id of the experiment, which is made if it is missing."""
        name = os.environ.get("MLFLOW_EXPERIMENT_NAME", EXPERIMENT)
        pictures = None if os.environ.get("MLFLOW_TRACKING_URI") else Path(PICTURES).resolve().as_uri()
        found = self._client.get_experiment_by_name(name)
        if found is None:
            try:
                return str(self._client.create_experiment(name, pictures))
            except self._mlflow.MlflowException:  # another job has made it meanwhile
                found = self._client.get_experiment_by_name(name)
                if found is None:
                    raise
        return str(found.experiment_id)

    def scalars(self, values: Mapping[str, float | None], step: int) -> None:
        """Log one point of each curve; None is no point."""
        now, metric = int(1e3 * time.time()), self._mlflow.entities.Metric
        points = [metric(name, float(each), now, step) for name, each in values.items() if each is not None]
        self._send(self._client.log_batch, metrics=points)

    def figure(self, name: str, figure: Figure, step: int) -> None:
        """Log a figure as a picture."""
        self._send(self._client.log_figure, figure, f"{name}_{step}.png")

    def animation(self, name: str, gif: bytes, step: int) -> None:
        """Log an animation, the bytes of a GIF."""
        place, _, file = name.rpartition("/")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{file}_{step}.gif"
            path.write_bytes(gif)
            self._send(self._client.log_artifact, str(path), place or None)

    def hparams(self, config: Mapping[str, Any], metrics: Mapping[str, float | None]) -> None:
        """Log the settings, with dotted names, and the final metrics as `summary/...`."""
        taken = {re.sub(r"[^\w.\- ]", "_", name): str(each) for name, each in flatten(config).items()}
        settings = [self._mlflow.entities.Param(name, text) for name, text in taken.items()]
        self._pause_ends = 0.0  # the last occasion
        for first in range(0, len(settings), MOST):
            self._send(self._client.log_batch, params=settings[first : first + MOST])
        self.scalars({f"summary/{name}": each for name, each in metrics.items()}, 0)

    def fail(self, error: BaseException) -> None:
        """Let the run end as failed, or as killed by a signal."""
        self._status = "FAILED" if isinstance(error, Exception) else "KILLED"

    def close(self) -> None:
        """End the run."""
        self._pause_ends = 0.0
        self._send(self._client.set_terminated, self._status)

    def _send(self, method: Callable[..., object], *arguments: Any, **named: Any) -> None:
        """Call a method of the client for this run; a lost server is warned of once, and ends no training.

        It does not hold it up either: after a call that hung, others are left out for a while.
        """
        started = time.monotonic()
        if started < self._pause_ends:
            return
        try:
            method(self._run, *arguments, **named)
        except (self._mlflow.MlflowException, OSError) as error:
            if not self._lost:
                print_message("train", f"warning: logger=mlflow misses points: {reason_of(error)}")
            self._lost = True
            if (failed := time.monotonic()) > started + SLOW:
                self._pause_ends = failed + PAUSE
