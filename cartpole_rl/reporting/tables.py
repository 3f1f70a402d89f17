"""The runs and the episodes behind a report as tables: CSV, Parquet, or rows for a data frame."""

import csv
import json
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from cartpole_rl.files import replacing
from cartpole_rl.reporting.runs import DAMAGE, Run, flattened, measured
from cartpole_rl.reporting.sweeps import STAGES, Sweep, read_groups, without_repetitions
from cartpole_rl.run_folder import COMPARISON, METRICS

STAGE_SCORES = {f"score_{stage}": f"{Path(COMPARISON).stem}.{stage}.score" for stage in STAGES}
ESCAPED = "backslashreplace"  # a file's name may hold bytes that are no UTF-8
BATCH = 10_000  # rows of a Parquet file that are in memory at once

Row = Mapping[str, Hashable]
Rows = Callable[[], Iterable[Row]]  # is asked twice: for the columns, and for the rows


def episodes(*sources: str) -> Iterator[dict[str, Hashable]]:
    """Yield a row for each episode of the runs in folders and glob patterns. Raises ConfigError."""
    return episode_rows(read_groups({"runs": sources}, "score")[0])


def run_rows(sweeps: Sequence[Sweep]) -> Iterator[dict[str, Hashable]]:
    """Yield a row for each run: its group, differing settings and mean metrics, or why it is left out.

    The metrics of a fine-tuning are those of the policy that it `kept`.
    """
    for sweep in sweeps:
        results = {member.run.folder: member.run for member in sweep.members}
        for folder, head in _heads(sweep):
            run = results.get(folder, Run(folder))
            names = {**{name: name for name in run.results}, **STAGE_SCORES}
            means = {name: measured(run.results, key) for name, key in names.items()}
            found = {name: value for name, value in means.items() if value is not None}
            yield {**head, **found, **({"kept": run.kept} if run.kept else {})}


def episode_rows(sweeps: Sequence[Sweep]) -> Iterator[dict[str, Hashable]]:
    """Yield a row for each episode: its run as in `run_rows`, its metrics, its cart and its start.

    `stage` is before or after of a fine-tuning.
    """
    for sweep in sweeps:
        for folder, head in _heads(sweep):
            for stage, results in _stages(folder):
                shared = {name: results.get(name) for name in ("plant", "pole") if name in results}
                cart = results.get("cart") or {}
                for number, episode in enumerate(results.get("episodes") or ()):
                    row = {**episode, "cart": {**cart, **(episode.get("cart") or {})}}
                    values = {name: value for name, value in flattened(row).items() if value != "{}"}
                    yield {**head, **shared, "stage": stage, "episode": number, **values}


def write_table(rows: Rows, path: Path) -> None:
    """Write rows as CSV or Parquet, by the suffix of the file; rows lack what they have no value of."""
    kinds = _kinds(rows())
    (_write_parquet if path.suffix == ".parquet" else _write_csv)(rows(), kinds, path)


def _heads(sweep: Sweep) -> Iterator[tuple[Path, dict[str, Hashable]]]:
    """Yield the folder of each run, and what it is."""
    repeated = {each.run: each.reason for each in without_repetitions(sweep)[1]}
    named = zip(sweep.members, sweep.labels, sweep.evaluations, strict=True)
    for number, (member, label, evaluation) in enumerate(named):
        run = member.run.folder.as_posix()
        head: dict[str, Hashable] = {"set": sweep.name, "run": run, "command": member.run.program}
        head |= {
            "group": label,
            "evaluation": evaluation,
            "seed": (*member.seeds, None)[0],
            "left_out": repeated.get(run, ""),
        }
        head |= {"agent_seed": member.seed} if len(member.seeds) > 1 else {}
        yield (
            member.run.folder,
            head | {f"setting:{key}": each[number] for key, each in sweep.columns.items()},
        )
    for each in sweep.exclusions:
        yield Path(each.run), {"set": sweep.name, "run": each.run, "left_out": each.reason}


def _stages(folder: Path) -> list[tuple[str, Mapping[str, Any]]]:
    """Return the results in a run folder that hold episodes; none of a damaged one."""
    try:
        if (folder / COMPARISON).is_file():
            comparison = _json(folder / COMPARISON)
            return [(stage, {**_json(folder / METRICS), **comparison[stage]}) for stage in STAGES]
        return [("", _json(folder / METRICS))]
    except DAMAGE:
        return []


def _json(file: Path) -> dict[str, Any]:
    return dict(json.loads(file.read_text(encoding="utf-8")))


def _kinds(rows: Iterable[Row]) -> dict[str, type]:
    """Return the columns of rows, each with the type that all of its values have."""
    kinds: dict[str, type] = {}
    for row in rows:
        for name, value in row.items():
            own, kind = type(value), kinds.get(name, type(None))
            if own is kind or value is None:
                kinds.setdefault(name, kind)
            elif kind is type(None) or {own, kind} == {int, float}:
                kinds[name] = own if kind is type(None) else float
            else:
                kinds[name] = str
    return kinds


def _write_csv(rows: Iterable[Row], kinds: Mapping[str, type], path: Path) -> None:
    with replacing(path) as part, part.open("w", encoding="utf-8", errors=ESCAPED, newline="") as file:
        writer = csv.DictWriter(file, [*kinds], restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _write_parquet(rows: Iterable[Row], kinds: Mapping[str, type], path: Path) -> None:
    import pyarrow  # an extra
    from pyarrow import parquet

    names = {str: "string", bool: "bool_", int: "int64"}  # a metric that no episode has is a number
    types = {name: getattr(pyarrow, names.get(kind, "float64"))() for name, kind in kinds.items()}
    schema, rest = pyarrow.schema([*types.items()]), iter(rows)
    with replacing(path) as part, parquet.ParquetWriter(part, schema) as writer:
        while batch := [*islice(rest, BATCH)]:
            columns = ([_cell(row.get(name), kind) for row in batch] for name, kind in kinds.items())
            writer.write_table(pyarrow.table([*columns], schema=schema))


def _cell(value: Hashable, kind: type) -> Hashable:
    return str(value).encode(errors=ESCAPED).decode() if kind is str and value is not None else value
