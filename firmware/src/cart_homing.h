/* Homing: touch both ends, check the span, centre the cart, wait until the pole hangs still.

   An end is a stop that holds the cart or, on a rig with end switches, the place where one is pressed. A side without
   a switch is then not visited: it is one span from the other.

   One reading every 15 ms or more, on raw counts: in less, a coarse encoder tells no speed. It needs only rough
   numbers of the cart. The pole's zero is the middle of its last small swing: friction in the bearing holds a stopped
   pole up to a count off the vertical. */
#ifndef CART_HOMING_H
#define CART_HOMING_H

#include "cart_servo.h"
#include "cart_window.h"

#include <stdbool.h>
#include <stdint.h>

/* The result of homing, in raw counts. */
typedef struct {
    int32_t left_stop, right_stop;
    int32_t hanging;
} cart_zeros;

/* Raw counts at the end of a period, and its length. */
typedef struct {
    int32_t cart, pole;
    uint32_t period_us;
} cart_reading;

typedef enum { CART_HOMING_GOES_ON, CART_HOMING_DONE, CART_HOMING_FAILED } cart_homing_status;

typedef enum {
    CART_LEAVE_SWITCH, /* on which the cart may stand */
    CART_TOUCH_LEFT,
    CART_TOUCH_RIGHT,
    CART_CENTRE,
    CART_FIND_HANGING,
    CART_BRAKE,
    CART_CENTRE_AGAIN,
    CART_WAIT_UNTIL_STILL,
    CART_ALL_STAGES_DONE
} cart_homing_stage;

typedef struct {
    cart_homing_stage stage;
    bool entered;        /* the stage has handled a reading */
    uint32_t waited_us;  /* since the last reading */
    uint8_t pressed;     /* switches at the newest two looks, also without homing: a single look may be noise */
    uint8_t suspects;    /* switches for which homing failed */
    uint32_t elapsed_us; /* since the stage began */
    cart_reading before; /* the reading before the present one */
    int32_t start;       /* cart count when the stage began, or when the pole was last fast */
    double rolled;       /* m/s the wrong way then */
    double ran;          /* m/s, when the cart last moved; 0 if the pole was fast */
    bool stopped;        /* at the reading before, at once */
    cart_zeros zeros;    /* as far as they are found; before that, ends are where homing began */
    int32_t pressed_at;  /* cart count at the look that saw a switch newly pressed */
    int64_t widest;      /* counts of the pole's swing before the brake can have changed it much */
    int64_t fastest;     /* counts/s of the pole, while the hanging count is searched */
    cart_servo servo;
    cart_window window;
} cart_homing;

/* Begin. Nothing is taken from an earlier homing: its zeros may be why the cart is homed again. */
void cart_homing_begin(cart_homing *homing);

/* Handle a reading, CART_SHORTEST_LOOK_US or more after the last one, and choose the motor value for the next one. */
cart_homing_status cart_homing_step(cart_homing *homing, const cart_reading *reading, int16_t *motor);

/* Count in the middle of the track, and counts from there to a stop. */
int32_t cart_zeros_middle(const cart_zeros *zeros);
int32_t cart_zeros_half_span(const cart_zeros *zeros);

#endif
