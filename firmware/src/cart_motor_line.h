/* The motor value in force and the commands that wait for their latency.

   A board has no latency: a command is due when it arrives. The emulated cart delays commands.
   Times are us since boot. */
#ifndef CART_MOTOR_LINE_H
#define CART_MOTOR_LINE_H

#include "cart_config.h"

#include <stdbool.h>
#include <stdint.h>

typedef struct {
    int8_t blocked;    /* direction that the soft limit forbids: 1 right, -1 left, 0 none */
    int16_t requested; /* the command in force, before the soft limit */
    uint16_t first;    /* index of the oldest pending command */
    uint16_t pending;  /* number of pending commands */
    uint64_t due_us[CART_PENDING];
    int16_t values[CART_PENDING];
} cart_motor_line;

/* The motor value in force. */
int16_t cart_line_value(const cart_motor_line *line);

/* True if the command in force points in the forbidden direction and is held at 0. */
bool cart_line_limited(const cart_motor_line *line);

/* Bring a value into force at `due_us`, or together with an earlier command that is due later. If no more
   commands can wait, the value replaces the newest one. */
void cart_line_command(cart_motor_line *line, uint64_t due_us, int16_t value);

/* Bring 0 into force at `now_us` and discard values that are due later. */
void cart_line_stop(cart_motor_line *line, uint64_t now_us);

/* Put a value into force at once and discard all pending ones. */
void cart_line_hold(cart_motor_line *line, int16_t value);

/* Put the next value that is due before `end_us` into force; return false if there is none. */
bool cart_line_next(cart_motor_line *line, uint64_t end_us, uint64_t *due_us);

#endif
