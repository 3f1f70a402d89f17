"""Wire protocol, version 2: bytes <-> dataclasses, without I/O. ``docs/protocol.md`` specifies it."""

from cartpole_rl.wire.frames import Frame, FrameSplitter, decode_frame, encode_frame
from cartpole_rl.wire.messages import (
    Ack,
    ClearFault,
    Fault,
    FaultReport,
    Flags,
    Hello,
    Home,
    Info,
    Message,
    MessageType,
    Nack,
    Reason,
    SetMotor,
    SetPeriod,
    Start,
    StartPolicy,
    State,
    Stop,
    microseconds_between,
    seconds_between,
    ticks_between,
    went_back,
)
