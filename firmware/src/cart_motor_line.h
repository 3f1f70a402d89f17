/* The requested motor value and the commands that wait for their latency.

   A board has no latency: a command is due when it arrives. The emulated cart delays commands.
   Times are us since boot. */
#ifndef CART_MOTOR_LINE_H
#define CART_MOTOR_LINE_H

#include "cart_config.h"

#include <stdbool.h>
#include <stdint.h>

typedef struct {
    int16_t requested; /* the command in force, before the limits */
    uint16_t first;    /* index of the oldest pending command */
    uint16_t pending;  /* number of pending commands */
    uint64_t due_us[CART_PENDING];
    int16_t values[CART_PENDING];
} cart_motor_line;

/* Bring a value into force at `due_us`, or together with an earlier command that is due later. If no more
   commands can wait, the value replaces the newest one. */
void cart_line_command(cart_motor_line *line, uint64_t due_us, int16_t value);

/* Bring 0 into force at `now_us` and discard values that are due later. */
void cart_line_stop(cart_motor_line *line, uint64_t now_us);

/* Put a value into force at once and discard all pending ones. */
void cart_line_hold(cart_motor_line *line, int16_t value);

/* Bring the values that are due into force. */
void cart_line_drive(cart_motor_line *line, uint64_t now_us);

/* When the next value is due; `before_us` if none is due before that. */
uint64_t cart_line_next_due(const cart_motor_line *line, uint64_t before_us);

#endif
