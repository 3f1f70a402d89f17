"""A cart with other encoders, another track and another motor, from its file alone."""

import re
from pathlib import Path

import pytest
import yaml
from command_line import COARSE, in_process

from cartpole_rl.choices import choice
from cartpole_rl.emulator.c_firmware import firmware_folder
from cartpole_rl.rig.hardware import HARDWARE

RIG = {
    "cart_nanometres_per_count": 40_000,
    "pole_counts_per_turn": 2400,
    "track_span": 0.46,
    "soft_limit": 0.02,
    "hard_limit": 0.006,
    "hard_push": 150,
    "moving_mass": 0.5,
    "moving_friction": 0.4,
    "motor_offset": 25,
    "motor_per_newton": 83,
    "gentle_force": 2.2,
    "right_switch": 1,
}
MOTION = {
    "cart_mass": 0.4,
    "track_half_length": 0.2,
    "cart_viscous": 0.8,
    "cart_coulomb": 0.4,
    "force_linear": 0.012,
    "force_offset": -0.3,
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "lab.yaml").write_text(yaml.safe_dump({"defaults": ["ip02"], **MOTION, **RIG}))
    return tmp_path


@pytest.mark.nightly  # test_its_firmware_has_its_numbers reads the same file
def test_the_preflight_reads_its_file(folder: Path) -> None:
    done = in_process("preflight", "cart=lab.yaml", "plant=emulated", COARSE, folder=folder)
    assert (done.code, done.err) == (0, ""), done
    *checks, _, following = done.out.splitlines()
    assert len(checks) == 8
    assert "OK   limits: soft 210 mm, hard 224 mm from the middle; 40000 nm and 1/2400 turn a count" in checks
    assert (
        following == "cartpole-identify cart=lab.yaml plant=emulated emulator.physics_step=0.001 pole=medium"
    )


@pytest.mark.usefixtures("without_pictures")
def test_a_controller_on_it_leads_to_its_identification(folder: Path) -> None:
    (folder / "rod.yaml").write_text("choices: {rod: {pole_mass: 0.05, pole_com: 0.2, pole_inertia: 6.7e-4}}")
    words = ("run=lqr", "cart=lab.yaml", "guard=none", "task=swingup", "task.time_limit=5", "episodes=1")
    for given, following in {
        "pole=rod.yaml control_period=0.01": "plant=emulated emulator=<yours>.yaml",
        "pole=large": "plant=emulated emulator=large",
    }.items():
        done = in_process("evaluate", *words, *given.split(), folder=folder)
        assert done.out.splitlines()[-1] == f"cartpole-identify cart=lab.yaml {given} {following}", done


def test_its_firmware_has_its_numbers(folder: Path) -> None:
    done = in_process("export", "format=firmware", "cart=lab.yaml", "hydra.run.dir=run", folder=folder)
    assert done.code == 0, done
    header = (folder / "run" / "cart_rig.h").read_text()
    assert "of cart=lab.yaml." in header
    assert "#define CART_NANOMETRES 40000 " in header
    assert "#define CART_POLE_COUNTS 2400 " in header
    assert "#define CART_SWITCHES 2 " in header
    assert "give pole= for another one" in done.out
    words = ("format=firmware", "cart=lab.yaml", "cart.track_span=0.5", "pole=large", "hydra.run.dir=longer")
    done = in_process("export", *words, folder=folder)
    assert (done.code, "give pole=" in done.out) == (0, False)
    assert in_process("export", "format=firmware", "hydra.run.dir=ip02", folder=folder).code == 0
    shipped = firmware_folder() / "src" / "cart_rig.h"
    assert (folder / "ip02" / "cart_rig.h").read_text() == shipped.read_text()
    longer = (folder / "longer" / "cart_rig.h").read_text()
    assert "of cart=lab.yaml cart.track_span=0.5 pole=large." in longer
    small, large = (int(re.findall(r"CART_POLE_LEVER_UM (\d+)", each)[0]) for each in (header, longer))
    assert large == pytest.approx(small * (0.23 * 0.3302 / 0.127 / 0.1778), rel=0.2)
    header = longer
    assert "#define CART_SPAN_UM 500000 " in header


@pytest.mark.nightly  # workflows/test_identified_files.py has its files, test_identify.py the fit
def test_it_is_identified(folder: Path) -> None:
    words = ("cart=lab.yaml", "plant=emulated", COARSE, "windows=60", "carts=64", "hydra.run.dir=run")
    assert in_process("identify", *words, folder=folder).code == 0
    found = yaml.safe_load((folder / "run" / "cart.yaml").read_text())
    assert {name: found[name] for name in HARDWARE} == {
        name: RIG.get(name, choice("cart/ip02")[name]) for name in HARDWARE
    }
    gain = found["force_linear"] / (found["cart_mass"] + 0.129)  # N a motor value and kg
    truth = 0.99 / 83 / (0.735 / 0.85 * 0.5 + 0.129)
    assert gain == pytest.approx(truth, rel=0.03)


def test_its_recordings_are_its_own(folder: Path) -> None:
    words = ("run=lqr", "cart=lab.yaml", "task=swingup", "task.time_limit=200", "hydra.run.dir=run")
    assert in_process("record", *words, folder=folder).code == 0
    for words in (("identify", "from=run"), ("replay", "from=run", "cart=ip02")):
        refused = in_process(*words, "hydra.run.dir=other", folder=folder)
        assert refused.code != 0
        assert "is of a cart with 40000 nm and 1/2400 turn a count, not 22749 nm and" in refused.err
        assert "give the file of that cart with cart=" in refused.err
    assert in_process("replay", "from=run", "cart=lab.yaml", "hydra.run.dir=replay", folder=folder).code == 0
