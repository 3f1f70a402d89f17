#include "cart.h"

#include "cart_numbers.h"

#include <string.h>

#define HALF_SPAN CART_COUNTS(CART_SPAN_UM / 2)
#define LONGEST_TICK_US 1000000000u /* a longer period counts as this long */
#define NO_AGE 65535u
#define KEPT_TICKS (CART_WATCHDOG_PERIODS + 1)
#define SWITCH_FAULTS (CART_SWITCHES * CART_FAULT_LEFT_SWITCH)
#define UNHOMING (CART_FAULT_CART_ENCODER | CART_FAULT_POLE_ENCODER | SWITCH_FAULTS)

void cart_boot(cart *self)
{
    memset(self, 0, sizeof *self);
    self->period_us = CART_PERIOD_US;
    self->pole_lever_um = CART_POLE_LEVER_UM;
    self->zeros.left_stop = -HALF_SPAN;
    self->zeros.right_stop = HALF_SPAN;
}

int16_t cart_motor(const cart *self)
{
    const cart_limits *limits = &self->limits;
    if (limits->brake)
        return (int16_t)(limits->brake * CART_LARGEST_MOTOR);
    return (int32_t)self->line.requested * limits->blocked > 0 ? 0 : self->line.requested;
}

void cart_drive(cart *self, uint64_t now_us)
{
    cart_line_drive(&self->line, now_us);
}

uint64_t cart_next_due(const cart *self, uint64_t before_us)
{
    return cart_line_next_due(&self->line, before_us);
}

static uint64_t ticked_us(const cart *self)
{
    return self->measured_us[self->ticks % KEPT_TICKS];
}

/* ---- Frames to the host ---- */

static uint8_t flags(const cart *self)
{
    return (uint8_t)((self->armed ? CART_ARMED : 0) | (self->homed ? CART_HOMED : 0) |
                     (self->homing ? CART_HOMING : 0) | (self->fault ? CART_FAULTED : 0) |
                     (cart_motor(self) != self->line.requested ? CART_SOFT_LIMIT : 0) |
                     CART_SWITCHES * CART_HAS_LEFT_SWITCH);
}

static size_t send(cart *self, uint8_t type, uint8_t all_flags, const uint8_t *payload, size_t length,
                   uint8_t *frame)
{
    return cart_frame(type, self->sequence++, all_flags, payload, length, frame);
}

static size_t send_info(cart *self, uint8_t *frame)
{
    uint8_t payload[CART_LONGEST_PAYLOAD];
    int32_t half_span = cart_zeros_half_span(&self->zeros);
    cart_info info = {half_span - CART_SOFT_COUNTS, half_span - CART_HARD_COUNTS, self->period_us,
                      self->policy ? self->policy_identity : 0};
    return send(self, CART_INFO, flags(self), payload, cart_pack_info(&info, payload), frame);
}

static int32_t reported_cart(const cart *self, int32_t cart_count)
{
    return cart_subtract(cart_count, cart_zeros_middle(&self->zeros));
}

static int32_t reported_pole(const cart *self, int32_t pole_count)
{
    return cart_subtract(pole_count, self->pole_zero);
}

static size_t send_state(cart *self, uint8_t all_flags, int32_t cart_count, int32_t pole_count,
                         uint8_t *frame)
{
    uint8_t payload[CART_LONGEST_PAYLOAD];
    uint64_t age_ms = self->commanded ? (ticked_us(self) - self->command_us) / 1000u : NO_AGE;
    cart_state state = {self->ticks,
                        (uint32_t)(ticked_us(self) & UINT32_MAX),
                        reported_cart(self, cart_count),
                        reported_pole(self, pole_count),
                        cart_motor(self),
                        self->last_sequence,
                        self->fault,
                        (uint16_t)(age_ms < NO_AGE ? age_ms : NO_AGE)};
    return send(self, CART_STATE, all_flags, payload, cart_pack_state(&state, payload), frame);
}

static size_t send_fault(cart *self, uint8_t all_flags, uint8_t *frame)
{
    uint8_t payload[CART_LONGEST_PAYLOAD];
    size_t length = cart_pack_fault(self->fault, self->ticks, payload);
    return send(self, CART_FAULT, all_flags, payload, length, frame);
}

/* ---- Messages from the host ---- */

/* Until when a motor value that answers the STATE of `tick` may be in force; 0 for an old or unknown one. */
static uint64_t expiry(const cart *self, uint32_t tick)
{
    if (self->ticks - tick >= KEPT_TICKS)
        return 0;
    return self->measured_us[tick % KEPT_TICKS] + (uint64_t)CART_WATCHDOG_PERIODS * self->period_us;
}

static cart_reason objection_in_this_state(const cart *self, uint8_t type)
{
    bool sets = type == CART_SET_PERIOD;
    bool homes = type == CART_HOME;
    bool starts = type == CART_START || type == CART_START_POLICY;
    bool drives = type == CART_SET_MOTOR || starts;
    if (self->homing && (sets || homes || drives))
        return CART_BUSY;
    if (self->armed && (sets || homes))
        return CART_BUSY;
    if (self->limits.brake && homes) /* homing would end the brake */
        return CART_BUSY;
    if (self->armed && type == CART_START_POLICY && !self->self_driven)
        return CART_BUSY;
    if (self->fault && (homes || drives))
        return CART_FAULT_LATCHED;
    if (starts && !self->homed)
        return CART_NOT_HOMED;
    if (type == CART_SET_MOTOR && !self->armed)
        return CART_NOT_ARMED;
    return CART_ACCEPTED;
}

/* The first reason, in the order of docs/protocol.md, for which a frame is refused. */
static cart_reason objection(const cart *self, const cart_envelope *envelope, uint64_t now_us)
{
    cart_reason reason;
    int expected = cart_host_payload(envelope->type);
    if (envelope->version != CART_VERSION)
        return CART_BAD_VERSION;
    if (expected < 0 || (envelope->type == CART_START_POLICY && self->policy == NULL))
        return CART_UNKNOWN_TYPE;
    if (envelope->payload_length != (size_t)expected)
        return CART_BAD_LENGTH;
    if (envelope->type == CART_SET_MOTOR) {
        int16_t motor = cart_read_i16(envelope->payload);
        if (motor > CART_LARGEST_MOTOR || motor < -CART_LARGEST_MOTOR)
            return CART_OUT_OF_RANGE;
    }
    if (envelope->type == CART_SET_PERIOD) {
        uint32_t period_us = cart_read_u32(envelope->payload);
        if (period_us < CART_SHORTEST_US || period_us > CART_LONGEST_US)
            return CART_OUT_OF_RANGE;
    }
    reason = objection_in_this_state(self, envelope->type);
    if (reason != CART_ACCEPTED || envelope->type != CART_SET_MOTOR)
        return reason;
    bool old = now_us >= expiry(self, cart_read_u32(envelope->payload + 2));
    return old && cart_read_i16(envelope->payload) != 0 ? CART_STALE : CART_ACCEPTED;
}

/* Disarm, set motor 0 and latch the fault. That of an encoder or a switch makes the zeros invalid. */
static void latch(cart *self, uint16_t fault)
{
    self->fault |= fault;
    self->armed = self->homing = self->self_driven = false;
    cart_line_hold(&self->line, 0);
    if (fault & UNHOMING)
        self->homed = false;
    if (fault & CART_FAULT_CART_ENCODER)
        cart_limits_release(&self->limits); /* nobody knows where the cart is */
}

/* Let the limits of the track decide, which need the zeros of a homing. */
static void apply_limits(cart *self, uint64_t now_us, int32_t cart_count, int32_t pole_count)
{
    cart_place place = {(int64_t)cart_count - cart_zeros_middle(&self->zeros),
                        (int64_t)pole_count - self->pole_zero,
                        cart_zeros_half_span(&self->zeros),
                        self->pole_lever_um,
                        self->armed,
                        CART_SWITCHES & self->procedure.pressed};
    self->cart_count = cart_count;
    self->pole_count = pole_count;
    if (self->homing) {
        cart_limits_release(&self->limits);
    } else {
        if (self->armed && cart_limits_cart_jumped(&self->limits))
            latch(self, CART_FAULT_CART_ENCODER);
        if (self->armed && cart_limits_pole_jumped(&self->limits))
            latch(self, CART_FAULT_POLE_ENCODER);
        if (self->armed && cart_limits_lost(&self->limits, now_us, cart_motor(self))) {
            latch(self, CART_FAULT_CART_ENCODER);
            cart_limits_brake_blindly(&self->limits, now_us);
        }
        place.armed = self->armed;
        cart_limits_apply(&self->limits, now_us, &place);
    }
    if (cart_motor(self) != self->line.requested)
        self->limited = true;
}

static void arm(cart *self, uint64_t now_us)
{
    if (self->armed)
        return;
    self->armed = true;
    self->observed = self->interrupted = false;
    self->expires_us = expiry(self, self->ticks);
    cart_guards_reset(&self->guards);
    cart_limits_forget(&self->limits);
    apply_limits(self, now_us, self->cart_count, self->pole_count);
}

/* Give the motor to the host. The policy's last value does not outlive it. */
static void take_over(cart *self, uint64_t now_us)
{
    if (self->self_driven)
        cart_line_stop(&self->line, now_us);
    self->self_driven = false;
}

static void begin_homing(cart *self)
{
    self->homed = false;
    self->homing = true;
    cart_homing_begin(&self->procedure);
    cart_line_hold(&self->line, 0);
    cart_limits_release(&self->limits);
    cart_guards_reset(&self->guards);
    cart_limits_forget(&self->limits);
}

static void carry_out(cart *self, const cart_envelope *envelope, uint64_t now_us)
{
    switch (envelope->type) {
    case CART_SET_MOTOR:
        take_over(self, now_us);
        self->commanded = true;
        self->command_us = now_us;
        self->expires_us = expiry(self, cart_read_u32(envelope->payload + 2));
        cart_line_command(&self->line, now_us, cart_read_i16(envelope->payload));
        break;
    case CART_START:
        take_over(self, now_us);
        arm(self, now_us);
        break;
    case CART_START_POLICY:
        arm(self, now_us);
        self->self_driven = true;
        break;
    case CART_STOP:
        self->armed = self->homing = self->self_driven = false;
        cart_line_stop(&self->line, now_us);
        break;
    case CART_HOME:
        begin_homing(self);
        break;
    case CART_CLEAR_FAULT:
        self->fault = self->reported = 0;
        break;
    case CART_SET_PERIOD:
        self->period_us = cart_read_u32(envelope->payload);
        break;
    default: /* HELLO */
        break;
    }
}

static size_t refuse(cart *self, const cart_envelope *envelope, cart_reason reason, uint8_t *answer)
{
    uint8_t payload[] = {envelope->sequence, envelope->type, (uint8_t)reason};
    return send(self, CART_NACK, flags(self), payload, sizeof payload, answer);
}

size_t cart_receive(cart *self, const uint8_t *stuffed, size_t length, uint64_t now_us, uint8_t *answer)
{
    cart_envelope envelope;
    self->carried_out = 0;
    if (!cart_open(stuffed, length, &envelope))
        return 0; /* nothing in a damaged frame can be trusted */
    cart_reason reason = objection(self, &envelope, now_us);
    if (reason != CART_ACCEPTED)
        return refuse(self, &envelope, reason, answer);
    carry_out(self, &envelope, now_us);
    self->heard_us = now_us;
    if (self->self_driven)
        self->expires_us = expiry(self, self->ticks); /* any frame shows that the host is there */
    self->carried_out = envelope.type;
    self->last_sequence = envelope.sequence;
    if (envelope.type == CART_SET_MOTOR)
        return 0; /* the next STATE acknowledges it */
    if (envelope.type == CART_HELLO || envelope.type == CART_SET_PERIOD)
        return send_info(self, answer);
    uint8_t payload[] = {envelope.sequence, envelope.type};
    return send(self, CART_ACK, flags(self), payload, sizeof payload, answer);
}

/* ---- The rules of a period ---- */

/* Latch new faults. Homing may touch the stops and detects a stall itself. */
static void check_faults(cart *self, const cart_reading *reading)
{
    cart_guards *guards = &self->guards;
    uint32_t period_us = reading->period_us;
    int16_t motor = cart_motor(self);
    bool jumped = cart_cart_jumped(&guards->cart_jumps, reading->cart, period_us);
    if (cart_cart_frozen(&guards->cart_freezes, reading->cart, motor, period_us) || jumped)
        latch(self, CART_FAULT_CART_ENCODER);
    jumped = cart_pole_jumped(&guards->pole_jumps, reading->pole, period_us);
    if (cart_pole_frozen(&guards->pole_freezes, reading->pole, reading->cart, period_us) || jumped)
        latch(self, CART_FAULT_POLE_ENCODER);
    int64_t from_middle = cart_distance(reading->cart, cart_zeros_middle(&self->zeros));
    if (self->armed && from_middle >= (int64_t)cart_zeros_half_span(&self->zeros) - CART_HARD_COUNTS)
        latch(self, CART_FAULT_HARD_LIMIT);
    if (self->armed && cart_stalled(&guards->stalls, reading->cart, motor, period_us))
        latch(self, CART_FAULT_STALL);
}

/* Let homing choose the motor value, or end it with its zeros or a fault. */
static void step_homing(cart *self, const cart_reading *reading)
{
    self->procedure.waited_us += reading->period_us;
    if (self->procedure.waited_us < CART_SHORTEST_LOOK_US)
        return;
    const cart_reading look = {reading->cart, reading->pole, self->procedure.waited_us};
    self->procedure.waited_us = 0;
    int16_t motor = 0;
    switch (cart_homing_step(&self->procedure, &look, &motor)) {
    case CART_HOMING_GOES_ON:
        cart_line_hold(&self->line, motor);
        break;
    case CART_HOMING_DONE:
        self->zeros = self->procedure.zeros;
        self->pole_zero = self->zeros.hanging - CART_POLE_COUNTS / 2 - self->pole_trim;
        self->homed = true;
        self->homing = false;
        cart_line_hold(&self->line, 0);
        break;
    default: /* CART_HOMING_FAILED */
        latch(self, CART_FAULT_HOMING |
                        (SWITCH_FAULTS & (self->procedure.suspects * CART_FAULT_LEFT_SWITCH)));
        break;
    }
}

static uint32_t length_of_period(const cart *self, uint64_t now_us)
{
    uint64_t length_us = now_us - ticked_us(self);
    if (length_us < 1)
        return 1;
    return (uint32_t)(length_us < LONGEST_TICK_US ? length_us : LONGEST_TICK_US);
}

/* End a homing without a host; return whether the watchdog holds the motor at 0. */
static bool expire(cart *self, uint64_t now_us)
{
    if (self->homing && now_us > self->heard_us + CART_LEASE_US) {
        self->homing = false;
        cart_line_hold(&self->line, 0);
    }
    if (!self->armed || now_us < self->expires_us)
        return false;
    cart_line_hold(&self->line, 0);
    return true;
}

/* A newly pressed switch stops a homing cart at once. Any that is pressed is the hard limit of an armed one. */
static void see_switches(cart *self, int32_t cart_count)
{
    cart_homing *homing = &self->procedure;
    uint8_t switches = CART_SWITCHES & self->switches;
    uint8_t pressed = switches & self->seen;
    self->seen = switches;
    if (pressed & ~homing->pressed) {
        homing->pressed_at = cart_count;
        if (self->homing)
            cart_line_hold(&self->line, 0);
    }
    homing->pressed = pressed;
    if (self->armed && pressed)
        latch(self, (uint16_t)(CART_FAULT_HARD_LIMIT | pressed * CART_FAULT_LEFT_SWITCH));
}

void cart_look(cart *self, uint64_t now_us, int32_t cart_count, int32_t pole_count)
{
    self->interrupted |= expire(self, now_us); /* it may end before the next tick */
    if (CART_SWITCHES)
        see_switches(self, cart_count);
    cart_limits_sample(&self->limits, now_us, cart_count, pole_count);
    apply_limits(self, now_us, cart_count, pole_count);
}

size_t cart_tick(cart *self, uint64_t now_us, int32_t cart_count, int32_t pole_count, uint8_t *frames)
{
    cart_reading reading = {cart_count, pole_count, length_of_period(self, now_us)};
    self->reading = reading;
    self->ticks++;
    self->measured_us[self->ticks % KEPT_TICKS] = now_us;
    cart_limits_sample(&self->limits, now_us, cart_count, pole_count);
    self->expired = expire(self, now_us);
    if (self->armed || self->homing)
        check_faults(self, &reading);
    if (self->homing)
        step_homing(self, &reading);
    apply_limits(self, now_us, cart_count, pole_count);
    uint8_t all_flags = (uint8_t)(flags(self) | (self->expired && self->armed ? CART_WATCHDOG : 0) |
                                  (self->limited ? CART_SOFT_LIMIT : 0));
    self->limited = cart_motor(self) != self->line.requested;
    size_t length = 0;
    if (self->fault & ~self->reported)
        length = send_fault(self, all_flags, frames);
    self->reported = self->fault;
    length += send_state(self, all_flags, cart_count, pole_count, frames + length);
    return length;
}

void cart_ask_policy(cart *self)
{
    if (!self->self_driven)
        return;
    if (self->expired) {
        self->interrupted = true;
        return;
    }
    const cart_reading *reading = &self->reading;
    cart_observation observation = {reported_cart(self, reading->cart), reported_pole(self, reading->pole),
                                    cart_zeros_half_span(&self->zeros) - CART_SOFT_COUNTS, reading->period_us,
                                    self->period_us, !self->observed, self->interrupted,
                                    cart_motor(self)};
    int16_t motor = self->policy(self->policy_memory, &observation);
    bool valid = motor <= CART_LARGEST_MOTOR && motor >= -CART_LARGEST_MOTOR;
    self->observed = true;
    self->interrupted = false;
    cart_line_hold(&self->line, valid ? motor : 0);
}
