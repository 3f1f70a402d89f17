"""A training logs to several places at once; Weights & Biases and MLflow are read back from their files."""

import json
import re
import shutil
import struct
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any, ClassVar

import pytest
from command_line import in_process
from serial_peer import wait_for
from toy_settings import TOY

from cartpole_rl.errors import ConfigError, LearningError
from cartpole_rl.exits import Terminated
from cartpole_rl.reporting.loggers import LOGGERS, Loggers
from cartpole_rl.reporting.tensorboard import scalars
from cartpole_rl.workflows.config import TrainConfig, load_settings
from cartpole_rl.workflows.train import TrainingMonitor, train

SHORT = {**TOY[TrainConfig], "task.time_limit": 50, "learning.evaluations": 2}
INSTALLED = [name for name in ("mlflow", "wandb") if find_spec(name)]


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of a sweep, which the loggers find around the run and in which they leave their files."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("MLFLOW_TRACKING_URI", "MLFLOW_EXPERIMENT_NAME", "WANDB_PROJECT"):
            patch.delenv(name, raising=False)
        patch.setenv("WANDB_MODE", "offline")
        patch.chdir(found := tmp_path_factory.mktemp("sweep"))
        (found / "multirun.yaml").write_text("{}")
        yield found


@pytest.fixture(scope="module")
def run(folder: Path) -> Path:
    """A short training that logged to all places at once."""
    train(load_settings(TrainConfig, {**SHORT, "logger": ["tensorboard", *INSTALLED]}), folder / "first")
    return folder / "first"


@pytest.fixture(scope="module")
def points(run: Path) -> list[tuple[int, Any]]:
    """Transitions and score of each evaluation."""
    evaluations = [json.loads(line) for line in (run / "history.jsonl").read_text().splitlines()]
    return [(each["transitions"], pytest.approx(each["score"], rel=1e-6)) for each in evaluations]


def test_mlflow_stands_beside_tensorboard_and_groups_a_sweep(
    run: Path, points: list[tuple[int, Any]]
) -> None:
    mlflow = pytest.importorskip("mlflow", reason="it is an extra")
    assert scalars(run, "evaluation/score") == points
    client = mlflow.MlflowClient("sqlite:///runs/mlflow.db")
    identity, store = (run / "mlflow_run.txt").read_text().splitlines()
    assert store == f"sqlite:///{Path('runs/mlflow.db').absolute()}"
    logged = client.get_run(identity)
    assert logged.info.status == "FINISHED"
    assert (logged.info.run_name, logged.data.tags["sweep"]) == ("first", run.parent.name)
    assert logged.data.params["learning.batch_size"] == str(SHORT["learning.batch_size"])
    history = client.get_metric_history(identity, "evaluation/score")
    assert [(each.step, each.value) for each in history] == points
    pictures = {Path(each.path).suffix for each in client.list_artifacts(identity, "pictures")}
    assert {".png", ".gif"} <= pictures


@pytest.mark.parametrize(
    ("error", "status"),
    [(None, "FINISHED"), (LearningError("diverged"), "FAILED"), (Terminated(15), "KILLED")],
)
def test_a_run_that_resumes_elsewhere_goes_on_in_mlflow_and_ends_as_the_training_does(
    error: BaseException | None, status: str, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mlflow = pytest.importorskip("mlflow", reason="it is an extra")
    identity, store = (run / "mlflow_run.txt").read_text().splitlines()
    monkeypatch.chdir(tmp_path)
    config = load_settings(TrainConfig, {**SHORT, "logger": "mlflow"})
    resumed = TrainingMonitor(shutil.copytree(run, tmp_path / "run"), config, resumed_at=2048)
    with suppress(LearningError, Terminated), resumed:
        resumed.on_update(5000, {"later": 1.0})
        if error:
            raise error
    found = mlflow.MlflowClient(store).get_run(identity)
    assert (found.data.metrics["later"], found.info.status) == (1.0, status)
    assert not Path("runs").exists()


def test_a_run_resumes_without_a_tracker_that_lost_it(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mlflow", reason="it is an extra")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", (run / "mlflow_run.txt").read_text().splitlines()[1])
    (tmp_path / "mlflow_run.txt").write_text("0123")
    Loggers((LOGGERS.find("mlflow"),), tmp_path, 1).scalars({"later": 1.0}, 5000)
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search("warning: logger=mlflow, sqlite:.*0123.*; the run goes on without it", line)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "nowhere://a")
    with pytest.raises(ConfigError, match="logger=mlflow, nowhere://"):
        Loggers((LOGGERS.find("mlflow"),), tmp_path)


def log_a_point(folder: Path) -> None:
    log = LOGGERS.find("mlflow")(folder)
    log.scalars({"score": 1.0}, 1)
    log.close()


def test_jobs_that_start_at_once_make_one_database_of_mlflow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mlflow", reason="it is an extra")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/mlflow.db")
    with ProcessPoolExecutor(2, get_context("fork")) as pool:  # mlflow is imported already
        list(pool.map(log_a_point, [tmp_path, tmp_path]))


def test_a_lost_server_of_mlflow_ends_no_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mlflow = pytest.importorskip("mlflow", reason="it is an extra")
    log, calls = LOGGERS.find("mlflow")(tmp_path), []

    def lost(*_: object, **__: object) -> None:
        calls.append(1)
        raise mlflow.MlflowException("no answer")

    monkeypatch.setattr(log._client, "log_batch", lost)
    log.scalars({"score": 1.0}, 1)
    log.scalars({"score": 2.0}, 2)
    assert capsys.readouterr().err.count("warning: logger=mlflow misses points: no answer") == 1
    assert len(calls) == 2
    monkeypatch.setattr("cartpole_rl.reporting.trackers.SLOW", 0)  # as if it hung
    for step in (3, 4):
        log.scalars({"score": 3.0}, step)
    assert len(calls) == 3
    monkeypatch.undo()
    log.hparams({"pole": {"rod (30 cm)": 0.3}}, {"score": 4.0})
    log.close()
    run = log._client.get_run(log._run)
    assert (run.data.params, run.info.status) == ({"pole.rod _30 cm_": "0.3"}, "FINISHED")
    assert run.data.metrics == {"summary/score": 4.0}


def stored(data: bytes) -> Iterator[bytes]:
    """The records of wandb's file: a header of 7 bytes, then LevelDB's log, in blocks of 32 KiB."""
    block, head, place, parts = 2**15, struct.Struct("<IHB"), 7, b""
    while place + head.size <= len(data):
        if (left := block - place % block) < head.size:
            place += left
            continue
        _, length, kind = head.unpack_from(data, place)
        place += head.size + length
        parts += data[place - length : place]
        if kind in (1, 4):  # the whole record, or its last part
            yield parts
            parts = b""


def test_wandb_is_written_offline(run: Path, points: list[tuple[int, Any]]) -> None:
    pytest.importorskip("wandb", reason="it is an extra")
    from wandb.proto.wandb_internal_pb2 import Record

    (file,) = run.glob("wandb/offline-run-*/*.wandb")
    assert file.stem == f"run-{(run / 'wandb_run.txt').read_text()}"
    logged, settings = [], {}
    for data in stored(file.read_bytes()):
        record = Record.FromString(data)
        items = {item.key or "/".join(item.nested_key): item.value_json for item in record.history.item}
        logged.append({name: json.loads(value) for name, value in items.items()})
        for item in (*record.config.update, *record.run.config.update):
            settings[item.key or ".".join(item.nested_key)] = json.loads(item.value_json)
    scored = [each for each in logged if "evaluation/score" in each]
    assert [(each["transitions"], each["evaluation/score"]) for each in scored] == points
    assert "video-file" in [each.get("pictures/cart/_type") for each in logged]
    assert settings["learning.batch_size"] == SHORT["learning.batch_size"]


@pytest.mark.usefixtures("folder")  # in which W&B is offline
def test_a_failed_training_has_failed_in_wandb(tmp_path: Path) -> None:
    pytest.importorskip("wandb", reason="it is an extra")
    from wandb.proto.wandb_internal_pb2 import Record

    (tmp_path / "wandb_run.txt").touch()  # as a power cut may leave it
    log = LOGGERS.find("wandb")(tmp_path, 1)
    log.fail(LearningError("diverged"))
    log.close()
    (file,) = tmp_path.glob("wandb/offline-run-*/*.wandb")

    def exit_codes() -> list[int]:
        records = map(Record.FromString, stored(file.read_bytes()))
        return [each.exit.exit_code for each in records if each.HasField("exit")]

    wait_for(lambda: bool(exit_codes()), 60)  # another process writes them
    assert exit_codes() == [1]


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_missing_library_is_one_line(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigError, match=f"logger={name} needs {name}: pip install {name}"):
        LOGGERS.find(name)(tmp_path)


class Noted:
    """A logger that notes its calls, and fails to close."""

    calls: ClassVar[list[str]] = []

    def __init__(self, folder: Path, purge_step: int | None = None) -> None:
        self.calls.append("open")

    def close(self) -> None:
        self.calls.append("close")
        raise OSError("disk full")


class Other(Noted): ...


def test_each_logger_is_opened_once_and_closed_whatever_the_others_do(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="disk full"):
        Loggers((Noted, Other, Noted), tmp_path).close()
    with pytest.raises(ZeroDivisionError):
        Loggers((Noted, lambda *_: 1 / 0), tmp_path)
    assert Noted.calls == ["open", "open", "close", "close", "open", "close"]


def test_several_are_a_list(tmp_path: Path) -> None:
    assert load_settings(TrainConfig, {"logger": "tensorboard"}).logger == ("tensorboard",)
    assert load_settings(TrainConfig, {"logger": []}).logger == ()
    done = in_process("train", "logger=[tensorboard,wanb]", folder=tmp_path)
    assert "give 'tensorboard', 'wandb', 'mlflow', or" in done.complaint
