"""Cutting TensorBoard's event files back to the step at which a resumed run begins again.

TensorBoard has a mark for this, torch's `purge_step`, but of its three readers only one keeps to it: the one
that `tensorboard` starts with replaces points only where new ones come, and the one behind its option
`--load_fast=false` shows both (seen with TensorBoard 2.21). So what is to go is taken out of the files.

An event file is a row of records: length u64 and its CRC u32, little-endian, the event, and its CRC u32.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from tensorboard.compat.proto.event_pb2 import Event

HEADER = struct.Struct("<QI")
FOOTER_BYTES = 4
HPARAMS = "_hparams_/"  # what TensorBoard's hparams plugin puts before its tags
FINAL = "Final/"  # before the names of final metrics; capitals sort first, and HPARAMS shows the first few


def cut_back(folder: Path, first_step: int) -> None:
    """Remove from the event files in `folder` all points at `first_step` and later, and the run's end.

    The end is the line on the HPARAMS page and the final metrics, which the resumed run writes anew. Other
    records stay as they are, save a last one that a killed run left unfinished. A file is replaced as a
    whole, so that being killed here loses nothing.
    """
    for path in sorted(folder.glob("events.out.tfevents.*")):
        copy = path.with_name(f"{path.name.replace('tfevents', 'rest')}.part")
        with path.open("rb") as source, copy.open("wb") as target:
            for record, event in _records(source):
                if _stays(event, first_step):
                    target.write(record)
        copy.replace(path)


def _records(source: BinaryIO) -> Iterator[tuple[bytes, Event]]:
    """Each whole record with the event in it."""
    while len(header := source.read(HEADER.size)) == HEADER.size:
        length, _ = HEADER.unpack(header)
        body = source.read(length)
        footer = source.read(FOOTER_BYTES)
        if len(body) < length or len(footer) < FOOTER_BYTES:
            return
        yield header + body + footer, Event.FromString(body)


def _stays(event: Event, first_step: int) -> bool:
    """Whether an event is older than `first_step` and no part of the run's end."""
    tags = [value.tag for value in event.summary.value]
    ends = any(tag.startswith((HPARAMS, FINAL)) for tag in tags)
    return event.step < first_step and not ends
