"""Convert logs of any cart, or exported recordings, to recordings, and report what is doubtful in logs.

Motion tells much of what a layout can get wrong: signs, the scale and the zero of the angle, the scale of the
position, and a motor value that was chosen a row earlier or later.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cartpole_rl.choices import choice
from cartpole_rl.envs.settings import LONGEST_PERIOD, SHORTEST_PERIOD
from cartpole_rl.errors import RecordingError
from cartpole_rl.evaluation.exchange import read_mcap, read_minari
from cartpole_rl.evaluation.recordings import LENGTH, write_recording
from cartpole_rl.identification.checks import motions
from cartpole_rl.identification.logs import (
    LONGEST_GAP,
    STALE,
    TURN,
    UNKNOWN,
    Log,
    NotALogError,
    Report,
    Rows,
    cut_log,
    read_rows,
    signed,
    units_of_turn,
)
from cartpole_rl.identification.sensors import Estimate, Sensors, question_sensors
from cartpole_rl.identification.settings import SUFFIXES, ImportConfig, Layout, log_files
from cartpole_rl.plants.measured import FASTEST_CART
from cartpole_rl.rig.hardware import nominal_hardware
from cartpole_rl.run_folder import RECORDINGS, write_config, write_json
from cartpole_rl.terminal import as_word, print_message, print_results, progress_bar, shown, words_given
from cartpole_rl.workflows.build import RECORDED
from cartpole_rl.workflows.checks import exported_recordings

IMPORTED = "import.json"
CORRELATED = 0.2  # size of a correlation that has a sign
ANGLE_SCALE, POSITION_SCALE = 0.01, 0.10  # share by which a scale may differ
ANGLE_ZERO = 0.02  # rad by which the upright angle may differ
JITTER = 0.1  # share of the period
SAME = 0.01  # share by which the period of a log may differ from that of others, or of the layout
EARLY = 0.1  # periods by which a delay may be estimated too early; a shifted row makes it a whole one
WRAP = 0.005  # turns by which a column may wrap beside whole ones
ALMOST = 0.8  # turns: a column that wraps at less, or at their reciprocal, is in another unit
UNITS = {"rad": "radians", "deg": "degrees", "turn": "turns"}
FINER = 0.8  # share of the time between rows: a shorter period of a resampled log is invented
LATE = 0.05  # s, or two periods: a cart that takes longer is unusual
RESAMPLED = 5e-4  # s between rows from which a log may be so fast
LEAPS = 0.02  # share of rows; with a longer period than QUICK a pole may turn so far between two rows
QUICK = 0.02 * (1 + SAME)  # s
WEAK = 0.05  # share of the full motor value that a log surely goes beyond
SATURATED, LACKING = 0.5, 0.25  # shares of rows: with full motor, and with an empty cell


def import_logs(config: ImportConfig, folder: Path) -> Sensors | None:
    """Read the logs in `config.source` and write their parts as recordings.

    What cartpole-export wrote comes back as it was, with nothing to estimate.

    Writes into `folder` config.yaml, provenance.json, recordings/ and import.json: the rows that were left
    out, and the estimates of the sensors. Prints them, and each doubt. Raises RecordingError for a log that
    cannot be read, or if nothing is left.
    """
    form, places = exported_recordings(config.source)
    if form is not None:
        import_recordings(form, places, config, folder)
        return None
    paths = log_files(config)
    rows, others = {}, []
    with progress_bar(len(paths), "logs") as bar:
        for path in paths:
            try:
                rows[path] = read_rows(path, config.layout)
            except NotALogError as error:  # such as the notes beside the logs
                others.append(error)
            bar.update()
    if not rows:
        raise others[0]
    for other in others:
        print_message("import", f"note: left out: {other}")
    beside = [path for path in config.source.glob("[!.]*") if path.is_file()]
    if kinds := {path.suffix or path.name for path in beside if path.suffix.lower() not in SUFFIXES}:
        said = f"files of {config.source} that are no {', '.join(SUFFIXES)}: {', '.join(sorted(kinds))}"
        print_message("import", f"note: left out: {said}; unpack or convert logs among them")
    long = {path: read for path, read in rows.items() if read.time[-1] >= config.layout.shortest} or rows
    period = config.layout.period or common_period(long, config.source)
    logs = {
        path: cut_log(read, config.layout, config.hardware.encoders, period) for path, read in rows.items()
    }
    parts = [part for log in logs.values() for part in log.parts]
    reports = [log.report for log in logs.values()]
    if not parts:
        raise RecordingError(nothing_left(reports, period, config))
    with progress_bar(None, "steps", desc="sensors") as bar:
        taken = parts if SHORTEST_PERIOD <= period <= LONGEST_PERIOD else []  # at 1 kHz it takes minutes
        sensors = question_sensors(motions(taken), period, on_step=bar.update)
    misread = wrong_wrap(reports, config.layout) or angle_leaps(reports, period)
    if misread:  # then the angle tells nothing, and nor does what is estimated with it
        sensors = Sensors(None, None, None, None, None, sensors.push, 0.0)
    found = [*doubts(reports, sensors, period, config.layout)]
    write_config(folder, "import", {**config.model_dump(mode="json", by_alias=True), "seed": 0})
    names = Counter(name for path in logs for name in {path.stem, path.name})
    heading = {"plant": "log", "pole": "", LENGTH: config.pole_length or "", "control_period_s": period}
    for path, log in logs.items():
        name = path.stem if names[path.stem] == 1 else path.name  # log.csv and log.txt
        for number, part in enumerate(log.parts):
            place = folder / RECORDINGS / f"{name}_{number:02d}.csv"
            write_recording(place, part, {**heading, "log": path.name})
    write_json(folder / IMPORTED, summary(logs, sensors, found))
    print_summary(logs, parts, period, sensors, bool(taken) and not misread, found, folder, config)
    return sensors


def common_period(rows: Mapping[Path, Rows], source: Path) -> float:
    """Return the control period of all logs, s. Raises RecordingError if they have several."""
    periods = {path.name: read.period for path, read in rows.items()}
    usual = sorted(periods, key=lambda name: periods[name])[len(periods) // 2]
    middle = periods[usual]
    other = max(periods, key=lambda name: abs(periods[name] - middle))
    if abs(periods[other] - middle) > SAME * middle:
        raise RecordingError(
            f"from={source}: {other} has a row every {1e3 * periods[other]:g} ms, {usual} every "
            f"{1e3 * middle:g} ms; import those of one period at a time, or give layout.period and "
            "layout.resample=true"
        )
    return middle


def nothing_left(reports: Sequence[Report], period: float, config: ImportConfig) -> str:
    """Return the message that no part of the logs is long enough, with what may be wrong."""
    reasons = sum((Counter(each.left_out) for each in reports), Counter[str]())
    message = f"from={config.source}: no part of {config.layout.shortest:g} s is left; left out: "
    message += ", ".join(f"{number} rows {reason}" for reason, number in reasons.items()) or "none"
    causes = [*_time_doubts(reports, period, config.layout)]
    if (gaps := sum(each.gaps for each in reports)) and not config.layout.resample:
        causes.append(
            f"rows are missing in {gaps} places: give a smaller layout.shortest, or layout.resample=true, "
            f"which bridges up to {LONGEST_GAP - 1} rows"
        )
    return "; ".join((message, *causes))


def import_recordings(form: str, places: Sequence[Path], config: ImportConfig, folder: Path) -> None:
    """Write the recordings in files of MCAP or a data set of Minari as they were before their export."""
    if form == "mcap":
        found = [*map(read_mcap, places)]
        loaded, settings = [each for each, _ in found], found[0][1]
        if any(other != settings for _, other in found):  # of several agents
            settings = None
    else:
        loaded, settings = read_minari(places[0])
    content = {**config.model_dump(mode="json", by_alias=True), "seed": 0}
    write_config(folder, "import", {**content, **({RECORDED: settings} if settings else {})})
    for each in loaded:
        write_recording(folder / RECORDINGS / f"{each.name}.csv", each.episode, each.facts)
    print_results(folder, f"{RECORDINGS}/", f"cartpole-replay {as_word('from', shown(folder))}")


def doubts(reports: Sequence[Report], sensors: Sensors, period: float, layout: Layout) -> Iterator[str]:
    """Yield a sentence for each thing that the motion or the rows contradict."""
    if sensors.falls_upwards:
        yield (
            "the pole falls upwards: layout.angle.upright is half a turn off; give the recorded angle of the "
            "upright pole"
        )
    stale = max(each.stale for each in reports) > STALE
    # a shift also shows as a motor of the other sign
    shifted = [] if stale else [*_delay_doubts(sensors, period, layout)]
    if sensors.push < -CORRELATED and sensors.lag < -CORRELATED:
        yield (
            "positive motor values accelerate the cart to the left, and the pole runs ahead of its cart: "
            "give the other side for layout.position.positive"
        )
    elif sensors.push < -CORRELATED and not shifted:
        yield (
            "positive motor values accelerate the cart to the left: give the other side for "
            "layout.motor.positive or layout.position.positive"
        )
    elif sensors.lag < -CORRELATED:
        half_a_turn = ", or mend layout.angle.upright, which may be half a turn off"
        yield (
            "the pole runs ahead of its cart instead of staying behind: give the other side for "
            f"layout.angle.positive{half_a_turn if sensors.falls_upwards is None else ''}"
        )
    rows = sum(each.rows for each in reports)
    if wraps := wrong_wrap(reports, layout):
        yield wraps
    elif leaps := angle_leaps(reports, period):
        first = next(each.leap for each in reports if each.leaps)
        yield f"the angle leaps in {leaps} of {rows} rows, first in {first}: " + (
            "mend layout.angle.unit; the column may be in degrees"
            if leaps > LEAPS * rows
            else "if its counter begins anew there, give its number of values as layout.angle.wraps, such as "
            "65536; if not, leave these rows out by layout.keep"
        )
    if jumps := sum(each.jumps for each in reports):
        yield (
            f"the cart would be faster than {FASTEST_CART:g} m/s in {jumps} of {rows} rows: its counter "
            "begins anew there, or layout.position.unit is wrong"
        )
    if stale:
        yield (
            "rows are written more often than the cart is measured, so states stand still between rows: give "
            "the period of the measurements as layout.period=..., and layout.resample=true"
        )
    if sensors.lag >= -CORRELATED and not stale:
        if sensors.push >= -CORRELATED:
            yield from _scale_doubts(sensors, layout, angle_jump(reports, layout))
        yield from shifted
    yield from _time_doubts(reports, period, layout)
    unknown = sum(each.left_out.get(UNKNOWN, 0) for each in reports)
    if unknown > LACKING * rows:
        yield (
            f"{unknown} of {rows} rows were left out, {UNKNOWN}: if a column is written less often than the "
            "others, repeat its last value"
        )
    if beyond := sum(each.beyond for each in reports):
        full = f"layout.motor.full={layout.motor.full:g}"
        yield f"{beyond} of {rows} motor values are beyond {full}: give the largest"
    if (strongest := max(each.strongest for each in reports)) < WEAK:
        yield (
            f"the largest motor value is {strongest * layout.motor.full:.3g}, and layout.motor.full="
            f"{layout.motor.full:g}: in steps of a 255th little is left of it; give the motor's largest value"
        )
    saturated = sum(each.saturated for each in reports)
    if saturated > SATURATED * rows:
        yield f"{saturated} of {rows} rows have full motor: the motor's curve cannot be told from them"


def angle_leaps(reports: Sequence[Report], period: float) -> int:
    """Return in how many rows the angle leaps; 0 for a few of a long period, or of sizes that differ.

    A potentiometer gives any value in its dead zone.
    """
    leaps, anew = sum(each.leaps for each in reports), any(each.anew for each in reports)
    many = leaps > LEAPS * sum(each.rows for each in reports)
    return leaps if many or (anew and period <= QUICK) else 0


def angle_jump(reports: Sequence[Report], layout: Layout) -> float:
    """Return by how many units the angle jumps where its column wraps; 0 if it does not, or that was told."""
    wraps = [each.wrap for each in reports if each.wrap]
    if not wraps or not isinstance(layout.angle.wraps, bool):
        return 0.0
    jump = float(np.median(wraps)) * units_of_turn(layout)
    likely = (*TURN.values(), *(2.0**bits for bits in range(8, 25)))
    return next((size for size in likely if abs(jump / size - 1) < WRAP), jump)


def wrong_wrap(reports: Sequence[Report], layout: Layout) -> str:
    """Return a sentence if the angle jumps by other than whole turns."""
    jump, turn, name = angle_jump(reports, layout), units_of_turn(layout), layout.angle.name
    turns = jump / turn
    if not jump:
        return ""
    if abs(turns - max(1, round(turns))) <= WRAP:
        advice = f"the angle jumps by {jump:.6g} where {name} wraps: give layout.angle.wraps=true"
        return "" if layout.angle.wraps else advice
    said = f"the angle jumps by {jump:.6g} where {name} wraps, and a turn has {turn:.6g}: "
    for unit, size in TURN.items():
        if jump == size and not ALMOST < turns < 1 / ALMOST:
            return f"{said}the column may be in {UNITS[unit]}; give layout.angle.unit={unit}"
    return (
        f"{said}give layout.angle.wraps={jump:.6g}, or mend layout.angle.unit; of a potentiometer with a "
        "dead zone, leave its ends out by layout.keep"
    )


def _time_doubts(reports: Sequence[Report], period: float, layout: Layout) -> Iterator[str]:
    reports = [each for each in reports if each.rows * each.gap >= layout.shortest] or reports
    taken = SHORTEST_PERIOD <= period <= LONGEST_PERIOD
    if layout.period is not None and not taken:
        yield f"layout.period={period:g} s: give {SHORTEST_PERIOD:g} to {LONGEST_PERIOD:g}, or leave it out"
    elif not taken:
        fast = RESAMPLED <= period < SHORTEST_PERIOD
        resampled = ", or give layout.period=0.01 layout.resample=true" if fast else ""
        yield (
            f"rows are {1e3 * period:g} ms apart, and an identification takes {1e3 * SHORTEST_PERIOD:g} to "
            f"{1e3 * LONGEST_PERIOD:g} ms: mend layout.time.unit{resampled}"
        )
    gaps = [report.gap for report in reports]
    if layout.resample and period < FINER * max(gaps):
        yield (
            f"layout.period={period:g} s is shorter than the {1e3 * max(gaps):g} ms between rows, and "
            "nothing was measured in between: give a longer one, or leave it out"
        )
    jitter = max(report.jitter for report in reports)
    gap = max(gaps, key=lambda each: abs(each / period - 1))
    contradicted = layout.period is not None and not layout.resample and abs(gap / period - 1) > SAME
    if contradicted and taken:
        yield (
            f"rows are {1e3 * gap:g} ms apart, not layout.period={period:g} s: leave it out, or give "
            "layout.resample=true"
        )
    elif jitter > JITTER * period and not layout.resample and not contradicted:
        yield (
            f"the time between rows varies: 5 % are over {1e3 * jitter:.1f} ms from the period of "
            f"{1e3 * period:g} ms; give the clock of the cart's board as layout.time, or layout.resample=true"
        )


def _scale_doubts(sensors: Sensors, layout: Layout, jump: float) -> Iterator[str]:
    scale, zero, position = sensors.angle_scale, sensors.angle_zero, sensors.position_scale
    if scale is not None and not scale.holds(1, ANGLE_SCALE):
        turn = units_of_turn(layout)
        factor = _or_unit(scale.value)
        wraps = f", and where it wraps as layout.angle.wraps={jump:.6g}" if jump else ""
        yield (
            f"the angle's scale is refuted by its motion: it turns {factor} as far as recorded; a turn has "
            f"{turn / scale.value:.5g} units of {layout.angle.name} (95 %: {turn / scale.high:.5g} to "
            f"{turn / scale.low:.5g}), not {turn:.5g}: give it as layout.angle.unit{wraps}"
        )
    elif zero is not None and not zero.holds(0, ANGLE_ZERO):
        value, low, high = recorded_angle(zero, layout)
        yield (
            f"the pole is upright where {layout.angle.name} is {value:.7g} (95 %: {low:.7g} to {high:.7g}), "
            f"not {layout.angle.upright:.7g}: give it as layout.angle.upright"
        )
    if position is not None and scale is not None and not position.holds(1, POSITION_SCALE):
        yield (
            f"the position's scale is refuted by the pole: the cart moves {_or_unit(position.value)} as far "
            f"as recorded (95 %: {position.low:.3g} to {position.high:.3g}): mend layout.position.unit"
        )


def recorded_angle(angle: Estimate, layout: Layout) -> Estimate:
    """Return an angle, rad to the right of the upright of `layout`, in the units of its column."""
    factor = signed(layout.angle.positive) * units_of_turn(layout) / (2 * np.pi)
    value, *ends = (layout.angle.upright + factor * each for each in angle)
    return Estimate(value, *sorted(ends))


def _or_unit(factor: float) -> str:
    """Return a factor in words, with the unit that it suggests."""
    units = {np.pi / 180: "degrees", 180 / np.pi: "radians", 1e-3: "mm", 1e-2: "cm", 1e3: "m"}
    for value, unit in units.items():
        if abs(factor / value - 1) < 0.1:
            return f"{factor:.3g} times (the column may be in {unit})"
    return f"{factor:.3f} times"


def _delay_doubts(sensors: Sensors, period: float, layout: Layout) -> Iterator[str]:
    delay = sensors.delay
    if delay is None or (delay.high >= -EARLY * period and delay.low <= max(2 * period, LATE)):
        return
    early = delay.high < -EARLY * period
    if early and layout.motor.row == "chosen" and delay.high + period >= -EARLY * period:
        advice = "try layout.motor.row=in_force"
    elif early:
        advice = f"is {layout.motor.name} what was sent to the motor, in the rows' order?"
    elif layout.motor.row == "in_force":
        advice = "try layout.motor.row=chosen"
    else:
        advice = "does it take the cart so long?"
    when = "too early" if early else f"over {1e3 * max(2 * period, LATE):g} ms later"
    yield (
        f"the motor values seem shifted: they move the cart {when} ({1e3 * delay.value:.0f} ms, 95 %: "
        f"{1e3 * delay.low:.0f} to {1e3 * delay.high:.0f}, after the state of their row); {advice}"
    )


def summary(logs: dict[Path, Log], sensors: Sensors, found: Sequence[str]) -> dict[str, Any]:
    """Return the content of import.json."""
    return {
        "logs": {
            path.name: {**log.report._asdict(), "parts": [part.steps for part in log.parts]}
            for path, log in logs.items()
        },
        "sensors": {
            name: value._asdict() if isinstance(value, Estimate) else value
            for name, value in sensors._asdict().items()
        },
        "doubts": list(found),
    }


def print_summary(
    logs: dict[Path, Log],
    parts: Sequence[Any],
    period: float,
    sensors: Sensors,
    questioned: bool,
    found: Sequence[str],
    folder: Path,
    config: ImportConfig,
) -> None:
    """Print the parts that were kept, the rows that were left out, the estimates and the doubts."""
    reports = [log.report for log in logs.values()]
    seconds = period * sum(part.steps for part in parts)
    print(
        f"{len(logs)} logs, {sum(each.rows for each in reports)} rows: {len(parts)} recordings, "
        f"{seconds:.0f} s"
    )
    reasons = sum((Counter(each.left_out) for each in reports), Counter[str]())
    for reason, number in reasons.items():
        print(f"left out: {number} rows {reason}")
    if gaps := sum(each.gaps for each in reports):
        print(f"gaps: {gaps} between rows that are not one period apart")
    zero = sensors.angle_zero and recorded_angle(sensors.angle_zero, config.layout)
    for name, estimate, digits, factor, unit in (
        ("angle: true over recorded", sensors.angle_scale, 4, 1, ""),
        (f"upright where {config.layout.angle.name} is", zero, 7, 1, ""),
        ("position: true over recorded", sensors.position_scale, 4, 1, ""),
        ("state to effect of its motor value", sensors.delay, 4, 1e3, " ms"),
    ):
        if estimate is not None:
            value, low, high = (f"{factor * each:.{digits}g}" for each in estimate)
            print(f"{name}: {value}{unit} (95 %: {low} to {high})")
    if questioned and not (sensors.angle_scale or sensors.position_scale or sensors.delay):
        print("the recordings are too short, or show too little motion, to question their sensors")
    for doubt in found:
        print(f"doubt: {doubt}")
    if found:
        print("mend the layout where a doubt is right, and import again")
    unknown = [] if config.hardware == nominal_hardware() else ["cart=<yours>.yaml"]
    words = [as_word("from", shown(folder)), *(words_given("cart") or unknown), "pole=<yours>.yaml"]
    if not math.isclose(period, choice("identify")["control_period"]):
        words.append(f"control_period={period:g}")
    following = " ".join(["cartpole-identify", *words])
    if not SHORTEST_PERIOD <= period <= LONGEST_PERIOD:
        following = "cartpole-import, with the layout mended"
    print_results(folder, f"{RECORDINGS}/ and {IMPORTED}", following)
