"""Write an agent or recordings for other programs, or the numbers of a cart for its firmware."""

import re
from collections.abc import Sequence
from pathlib import Path

from cartpole_rl.choices import choice
from cartpole_rl.emulator.c_firmware import rig_header
from cartpole_rl.emulator.guards import lever_um
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.exchange import MinariData, write_mcap
from cartpole_rl.evaluation.recordings import read_recording
from cartpole_rl.exporting.agent import ExportedAgent
from cartpole_rl.exporting.c_code import c_files
from cartpole_rl.exporting.onnx_model import onnx_model
from cartpole_rl.exporting.web_page import web_page
from cartpole_rl.files import write_bytes, write_text
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.reporting.texts import count_text
from cartpole_rl.rig.hardware import hardware_of
from cartpole_rl.rig.parameters import completed
from cartpole_rl.run_folder import recordings, write_config
from cartpole_rl.terminal import shown
from cartpole_rl.workflows.build import (
    TrainedAgent,
    exported_agent,
    network_of,
    provenance,
    recorded_cart,
    trained_agent,
    with_shaking_pole,
)
from cartpole_rl.workflows.config import ExportConfig

RIG_HEADER = "cart_rig.h"
DATASET = "cartpole_rl/{}-v0"  # Minari's name of the recordings


def export(config: ExportConfig, folder: Path, words: Sequence[str] = ()) -> None:
    """Write an agent, recordings, or the header that a cart's firmware is built with, as `config.format`.

    Writes into `folder` config.yaml, provenance.json and agent.npz, agent.onnx, policy.h and policy.c,
    cart.html, cart_rig.h, which names the cart as `words` of the command line do, cartpole_rl/<label>-v0/, or
    a file for each recording. Raises CheckpointError for a missing or damaged agent, RecordingError for a
    recording, ConfigError for one that cannot be exported, or for a folder that already holds a run.
    """
    if config.of_recordings:
        write_recordings(config, folder)
        return
    if config.run is None:
        write_rig(config, folder, words)
        return
    trained = trained_agent(config.run)
    agent = exported_agent(trained, provenance(config.run, trained))
    contents = files_of(config.format, agent, trained)
    write_config(folder, "export", {**config.model_dump(mode="json"), "seed": None})
    for name, content in contents.items():
        write_bytes(folder / name, content)
    files = " and ".join(f"{shown(folder)}/{name}" for name in contents)
    print(f"{files} {'are' if len(contents) > 1 else 'is'} written; SHA-256 of the agent: {agent.checksum}")


def write_recordings(config: ExportConfig, folder: Path) -> None:
    """Write the recordings of `config.source` as a data set of Minari, or each as a file of MCAP."""
    assert config.source is not None
    paths = recordings(config.source)
    loaded, settings = [*map(read_recording, paths)], recorded_cart(paths)
    data = MinariData(loaded, settings) if config.format == "minari" else None
    write_config(folder, "export", {**config.model_dump(mode="json", by_alias=True), "seed": None})
    if data is None:
        for each in loaded:
            write_mcap(folder / f"{each.name}.mcap", each, settings)
        print(f"{shown(folder)}/ has {count_text(len(loaded), 'MCAP file')} for Foxglove")
        return
    name = DATASET.format(re.sub(r"\W+", "_", config.label) or "recordings")
    place = folder / name / "data"
    data.write(place, name)
    print(f'minari.MinariDataset("{shown(place)}") has {count_text(len(loaded))}')


def write_rig(config: ExportConfig, folder: Path, words: Sequence[str]) -> None:
    """Write cart_rig.h. Raises ConfigError for a folder that already holds a run."""
    chosen = ("cart=", "cart.", "pole=", "pole.")
    pole = config.pole or PoleSettings(**choice("pole/medium"))
    given = [word for word in words if word.startswith(chosen)]
    source = " ".join(given if config.cart else ["cart=ip02", *given])
    cart = config.cart or choice("cart/ip02")
    header = rig_header(hardware_of(cart), source, lever_um(completed(with_shaking_pole(cart, pole))))
    write_config(folder, "export", {**config.model_dump(mode="json"), "seed": None})
    write_text(folder / RIG_HEADER, header)
    place = folder / RIG_HEADER
    print(f"{shown(place)} is written; build the firmware with RIG={place.resolve()}")
    if config.pole is None:
        print("its brake allows for Quanser's medium pole; give pole= for another one")


def files_of(form: str, agent: ExportedAgent, trained: TrainedAgent) -> dict[str, bytes]:
    """Return the contents of the files of a format, by name. Raises ConfigError."""
    match form:
        case "weights":
            return {"agent.npz": agent.weights_file()}
        case "onnx":
            return {"agent.onnx": onnx_model(agent, network_of(trained))}
        case "c":
            return {name: text.encode() for name, text in c_files(agent, trained.training).items()}
    plant = trained.training.plant
    if plant.has_residual:
        raise ConfigError(f"format=web: the agent was trained with plant={plant.kind}, not plant=simulated")
    return {"cart.html": web_page(agent, trained.training, plant).encode()}
