"""Reading TensorBoard's event files, and their truncation at the step from which a run is resumed.

TensorBoard has a marker for the truncation, torch's `purge_step`, but only one of its three readers obeys it:
the default reader replaces points only where new ones exist, and that of `--load_fast=false` shows both
(TensorBoard 2.21). Therefore the later points are removed from the files.

An event file is a sequence of records: length u64 and its CRC u32, little-endian, the event, and its CRC u32.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from tensorboard.compat.proto.event_pb2 import Event

HEADER = struct.Struct("<QI")
FOOTER_BYTES = 4
HPARAMS = "_hparams_/"  # prefix of the tags of TensorBoard's hparams plugin
FINAL = "summary/"  # prefix of final metrics, one point each; TensorBoard shows them last


def cut_back(folder: Path, first_step: int) -> None:
    """Remove points at `first_step` and later, and the final results, from the event files in `folder`.

    The final results are the line on the HPARAMS page and the final metrics; a resumed run writes them again.
    Other records stay, except a last one that a killed run left incomplete. Files are replaced atomically.
    """
    for path in sorted(folder.glob("events.out.tfevents.*")):
        copy = path.with_name(f"{path.name.replace('tfevents', 'rest')}.part")
        with path.open("rb") as source, copy.open("wb") as target:
            for record, event in _records(source):
                if _is_kept(event, first_step):
                    target.write(record)
        copy.replace(path)


def scalars(folder: Path, tag: str) -> list[tuple[int, float]]:
    """Return the points (step, value) of the curve `tag` in the event files in `folder`."""
    points = []
    for path in sorted(folder.glob("events.out.tfevents.*")):
        with path.open("rb") as source:
            for _, event in _records(source):
                points += [
                    (event.step, value.simple_value) for value in event.summary.value if value.tag == tag
                ]
    return points


def _records(source: BinaryIO) -> Iterator[tuple[bytes, Event]]:
    """Yield each complete record with its event."""
    while len(header := source.read(HEADER.size)) == HEADER.size:
        length, _ = HEADER.unpack(header)
        body = source.read(length)
        footer = source.read(FOOTER_BYTES)
        if len(body) < length or len(footer) < FOOTER_BYTES:
            return
        yield header + body + footer, Event.FromString(body)


def _is_kept(event: Event, first_step: int) -> bool:
    """Return True for an event before `first_step` that is not a final result."""
    tags = [value.tag for value in event.summary.value]
    is_final = any(tag.startswith((HPARAMS, FINAL)) for tag in tags)
    return event.step < first_step and not is_final
