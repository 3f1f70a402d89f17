"""Wire protocol, version 2: bytes <-> dataclasses, without I/O. ``docs/protocol.md`` specifies it."""
