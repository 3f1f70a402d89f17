/* The messages of protocol version 2: numbers of types, flags, faults and reasons, and their payloads. */
#ifndef CART_MESSAGES_H
#define CART_MESSAGES_H

#include <stddef.h>
#include <stdint.h>

enum {
    CART_HELLO = 0x01,
    CART_START = 0x02,
    CART_STOP = 0x03,
    CART_SET_MOTOR = 0x04,
    CART_HOME = 0x05,
    CART_CLEAR_FAULT = 0x06,
    CART_SET_PERIOD = 0x07,
    CART_START_POLICY = 0x08,
    CART_INFO = 0x81,
    CART_STATE = 0x82,
    CART_ACK = 0x83,
    CART_NACK = 0x84,
    CART_FAULT = 0x85
};

enum {
    CART_ARMED = 0x01,
    CART_HOMED = 0x02,
    CART_HOMING = 0x04,
    CART_FAULTED = 0x08,
    CART_SOFT_LIMIT = 0x10,
    CART_WATCHDOG = 0x20,
    CART_HAS_LEFT_SWITCH = 0x40, /* times CART_RIGHT: 0x80, a right one */
};

enum {
    CART_FAULT_HARD_LIMIT = 0x0001,
    CART_FAULT_STALL = 0x0002,
    CART_FAULT_CART_ENCODER = 0x0004,
    CART_FAULT_POLE_ENCODER = 0x0008,
    CART_FAULT_HOMING = 0x0010,
    CART_FAULT_LEFT_SWITCH = 0x0020, /* times CART_RIGHT: that of the right switch */
    CART_FAULT_RIGHT_SWITCH = 0x0040
};

typedef enum {
    CART_ACCEPTED = 0,
    CART_UNKNOWN_TYPE = 1,
    CART_BAD_LENGTH = 2,
    CART_OUT_OF_RANGE = 3,
    CART_NOT_HOMED = 4,
    CART_NOT_ARMED = 5,
    CART_FAULT_LATCHED = 6,
    CART_BUSY = 7,
    CART_BAD_VERSION = 8,
    CART_STALE = 9
} cart_reason;

typedef struct {
    int32_t soft_limit; /* counts from the middle */
    int32_t hard_limit; /* counts from the middle */
    uint32_t period_us;
    uint32_t policy; /* identity of the agent on the board; 0 without one */
} cart_info;

typedef struct {
    uint32_t tick;
    uint32_t time_us;
    int32_t cart_counts;
    int32_t pole_counts;
    int16_t motor;
    uint8_t last_sequence;
    uint16_t fault;
    uint16_t command_age_ms;
} cart_state;

/* The payload length of a message from the host, or -1 for an unknown type. */
int cart_host_payload(uint8_t type);

/* Write a payload; return its length. */
size_t cart_pack_info(const cart_info *info, uint8_t *payload);
size_t cart_pack_state(const cart_state *state, uint8_t *payload);
size_t cart_pack_fault(uint16_t fault, uint32_t tick, uint8_t *payload);

/* Read a number from a payload. */
int16_t cart_read_i16(const uint8_t *bytes);
uint32_t cart_read_u32(const uint8_t *bytes);

#endif
