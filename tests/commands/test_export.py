"""cartpole-export writes the files of each format, and says which; cartpole-import takes recordings back."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from command_line import in_process

from cartpole_rl.exporting.agent import read_agent
from cartpole_rl.run_folder import find_pretrained
from cartpole_rl.workflows.build import recorded_cart

FILES = {
    "weights": {"agent.npz"},
    "onnx": {"agent.onnx"},
    "c": {"policy.h", "policy.c"},
    "web": {"cart.html"},
}


@pytest.mark.parametrize(
    "form", [pytest.param(form, marks=pytest.mark.nightly if form == "onnx" else ()) for form in FILES]
)
def test_it_writes_the_files_of_the_format(form: str, tmp_path: Path) -> None:
    if form == "onnx":
        pytest.importorskip("onnxscript", reason='onnxscript is missing: pip install "cartpole_rl[export]"')
    words = ("run=pretrained/medium", f"format={form}", "hydra.run.dir=run")
    done = in_process("export", *words, folder=tmp_path)
    assert done.code == 0, done.err
    assert done.err == ""
    written = {path.name for path in (tmp_path / "run").iterdir()}
    assert written == FILES[form] | {"config.yaml", "provenance.json"}
    assert all(f"run/{name}" in done.out for name in FILES[form])
    assert str(tmp_path) not in done.out
    assert json.loads((tmp_path / "run/provenance.json").read_text())["program"] == "cartpole-export"


def test_an_agent_of_ones_own_is_exported_with_its_provenance(trained: Path, tmp_path: Path) -> None:
    run = trained / "checkpoints/best.pt"
    done = in_process("export", f"run={run}", "format=weights", "hydra.run.dir=run", folder=tmp_path)
    assert done.code == 0, done.err
    about = read_agent(tmp_path / "run/agent.npz").description
    assert len(about.motors) == 2
    assert about.provenance["command"][0] == "cartpole-train"


def test_a_refused_export_leaves_no_run(tmp_path: Path) -> None:
    checkpoint = torch.load("cartpole_rl/pretrained/medium/agent.pt", weights_only=True)
    checkpoint["config"]["plant"] = {"kind": "learned", "model": "model", "prior_share": 0.0}
    torch.save(checkpoint, tmp_path / "agent.pt")
    done = in_process("export", "run=agent.pt", "format=web", "hydra.run.dir=run", folder=tmp_path)
    assert done.code == 2
    assert "format=web: the agent was trained with plant=learned" in done.err
    assert not (tmp_path / "run/config.yaml").exists()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two short recordings of an agent, in `rec`."""
    folder = tmp_path_factory.mktemp("recorded")
    words = ("run=pretrained/large", "episodes=2", "task=swingup", "task.time_limit=30", "hydra.run.dir=rec")
    assert in_process("record", *words, folder=folder).code == 0
    return folder


@pytest.mark.parametrize("form", ["minari", "mcap"])
def test_recordings_come_back_to_the_bit(form: str, recorded: Path) -> None:
    pytest.importorskip(form, reason=f'{form} is missing: pip install "cartpole_rl[{form}]"')
    back = f"back_{form}"
    done = in_process("export", f"format={form}", "from=rec", f"hydra.run.dir={form}", folder=recorded)
    assert done.code == 0, done.err
    assert "2 " in done.out
    done = in_process("import", f"from={form}", f"hydra.run.dir={back}", folder=recorded)
    assert done.code == 0, done.err
    assert done.out.splitlines()[-1] == f"cartpole-replay from={back}"
    before = sorted((recorded / "rec/recordings").iterdir())
    after = sorted((recorded / back / "recordings").iterdir())
    assert [path.name for path in after] == ["episode_000.csv", "episode_001.csv"]
    assert [path.read_bytes() for path in after] == [path.read_bytes() for path in before]
    assert recorded_cart(after) == recorded_cart(before) is not None


def test_the_cart_of_an_unfinished_fine_tuning_is_that_of_its_first_agent(tmp_path: Path) -> None:
    (tmp_path / "checkpoints").mkdir()
    shutil.copy(find_pretrained(Path("pretrained/medium")), tmp_path / "checkpoints/start.pt")
    (tmp_path / "provenance.json").write_text('{"program": "cartpole-finetune"}')
    cart = recorded_cart([tmp_path / "recordings/episode_000.csv"])
    assert cart is not None
    assert cart.pole.name == "medium"


def test_a_data_set_is_found_by_its_name(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("minari", reason='minari is missing: pip install "cartpole_rl[minari]"')
    words = ("format=minari", "from=rec", "label=a-b", "hydra.run.dir=named")
    assert in_process("export", *words, folder=recorded).code == 0
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(recorded / "named"))
    words = ("from=cartpole_rl/a_b-v0", "hydra.run.dir=found")
    assert in_process("import", *words, folder=recorded).code == 0
    assert len([*recorded.glob("found/recordings/*.csv")]) == 2


def test_what_an_import_cannot_use_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "one.mcap").write_bytes(b"no such file")
    monkeypatch.setattr("cartpole_rl.workflows.checks.find_spec", lambda name: name)
    done = in_process("import", "from=one.mcap", "layout=plain", folder=tmp_path)
    assert done.code == 2
    assert "a recording has its own layout and cart; leave out layout=plain" in done.complaint
    monkeypatch.setattr("cartpole_rl.workflows.checks.find_spec", lambda name: None)
    done = in_process("import", "from=one.mcap", folder=tmp_path)
    assert done.code == 2
    assert 'from=one.mcap needs mcap: pip install "cartpole_rl[mcap]"' in done.complaint
