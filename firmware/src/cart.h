/* The cart's side of wire protocol version 2: docs/protocol.md as a state machine without I/O.

   Who calls what, when (cart_loop.h does all of it for a board):

     cart_boot      once, at power-on or reset
     cart_receive   for each complete run of bytes from the host, on arrival
     cart_look      at least once a millisecond, with the raw counts: limits and watchdog
     cart_tick      once at the end of each period of `period_us`, with the raw counts measured now; then send
                    the frames
     cart_ask_policy  after cart_tick and the sending of its frames

   After each of them call cart_drive, which brings motor values into force, and put cart_motor on the motor.
   All from one thread, never from an interrupt. No function blocks, allocates or recurses. Each takes a
   bounded time; the longest, cart_tick while homing, passes a few times over CART_WINDOW_COUNTS counts.

   Units: us since boot, which never wrap (64 bits); raw counts, positive to the right, 0 where the cart stood
   at boot, within 2^30; motor values -255 to 255, positive to the right. A `cart` needs about 1.2 kB. */
#ifndef CART_H
#define CART_H

#include "cart_config.h"
#include "cart_frames.h"
#include "cart_guards.h"
#include "cart_homing.h"
#include "cart_limits.h"
#include "cart_messages.h"
#include "cart_motor_line.h"

#ifdef __cplusplus
extern "C" {
#endif

/* What a policy on the board observes at the end of a period. */
typedef struct {
    int32_t cart_counts; /* from the middle of the track */
    int32_t pole_counts; /* from upright */
    int32_t soft_limit;  /* counts from the middle */
    uint32_t period_us;  /* since the counts of the period before */
    uint32_t set_period_us;
    bool first;   /* the first observation since START_POLICY */
    bool resumed; /* the watchdog held the motor at 0 since the last observation, which is out of date */
    int16_t motor; /* in force now: the policy's last one, unless a limit of the track has replaced it */
} cart_observation;

/* A policy on the board: returns the motor value for an observation, in a bounded time. */
typedef int16_t (*cart_policy)(void *memory, const cart_observation *observation);

typedef struct {
    /* Set these after cart_boot if the board has a policy. From START_POLICY on, the policy chooses the motor
       value after each period, until the host sends START or SET_MOTOR. All rules apply. While the policy
       drives, any frame that the cart accepts keeps the watchdog quiet. A value out of range counts as 0. */
    cart_policy policy;
    void *policy_memory;
    uint32_t policy_identity; /* for INFO; not 0 */

    int32_t pole_trim; /* counts above half a turn that a hanging pole shows after homing; 0 at boot */
    int32_t pole_lever_um; /* of the pole that is mounted, see cart_limits.h; CART_POLE_LEVER_UM at boot */

    /* Read these; only the core writes them. */
    uint32_t period_us; /* of the next period */
    bool armed, homed, homing;
    uint16_t fault;      /* latched faults */
    uint8_t carried_out; /* type of the message that cart_receive carried out; 0: refused or damaged */

    uint8_t switches; /* set it before each cart_look if CART_SWITCHES is not 0: those pressed, CART_LEFT, _RIGHT */

    /* Private. */
    cart_motor_line line;
    cart_limits limits;
    cart_guards guards;
    uint16_t reported;    /* by the newest FAULT frame */
    bool limited;         /* the limits have changed the motor value since the newest tick */
    cart_zeros zeros;
    int32_t pole_zero;    /* raw count that is reported as 0 */
    bool self_driven;     /* the policy chooses the motor values */
    bool observed;        /* the policy was asked since START_POLICY */
    bool interrupted;     /* the watchdog held the motor at 0 since then */
    bool expired;         /* the watchdog holds the motor at 0 since the newest period */
    bool commanded;       /* a SET_MOTOR was accepted since boot */
    uint64_t command_us;  /* arrival of the newest SET_MOTOR */
    uint64_t expires_us;  /* the watchdog then sets the motor to 0 */
    uint64_t heard_us;    /* arrival of the newest accepted frame */
    uint64_t measured_us[CART_WATCHDOG_PERIODS + 1]; /* times of the newest ticks, at their number modulo 4 */
    int32_t cart_count, pole_count; /* raw, read last */
    cart_reading reading; /* of the newest period */
    uint32_t ticks;
    uint8_t last_sequence; /* of the host */
    uint8_t sequence;      /* of the next frame sent */
    uint8_t seen;          /* switches at the newest look */
    cart_homing procedure;
} cart;

/* Boot: idle, not homed, motor 0. */
void cart_boot(cart *self);

/* Handle a run of stuffed bytes without its 0x00; write the answer, at most CART_FRAME_BYTES, and return its
   length, 0 for none. */
size_t cart_receive(cart *self, const uint8_t *stuffed, size_t length, uint64_t now_us, uint8_t *answer);

/* Bring the motor values that are due into force: on a board, those that have arrived. */
void cart_drive(cart *self, uint64_t now_us);

/* When the next motor value is due; `before_us` if none is due before that. Only an emulated cart needs it. */
uint64_t cart_next_due(const cart *self, uint64_t before_us);

/* Apply the rules that cannot wait for the end of a period, to the clock and the raw counts. */
void cart_look(cart *self, uint64_t now_us, int32_t cart_count, int32_t pole_count);

/* The motor value in force. */
int16_t cart_motor(const cart *self);

/* End a period: apply the rules; write FAULT, if one was latched, and STATE, at most 2 * CART_FRAME_BYTES,
   and return their length. */
size_t cart_tick(cart *self, uint64_t now_us, int32_t cart_count, int32_t pole_count, uint8_t *frames);

/* Let the policy choose the motor value if it drives. */
void cart_ask_policy(cart *self);

#ifdef __cplusplus
}
#endif

#endif
