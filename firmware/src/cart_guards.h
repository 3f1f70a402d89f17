/* Fault detection while the motor may move: a stalled cart and implausible encoders.

   Each function is called once a period with the counts at its end and its length in us. */
#ifndef CART_GUARDS_H
#define CART_GUARDS_H

#include "cart_config.h"

#include <stdbool.h>
#include <stdint.h>

#define CART_FASTEST_CART (5000000000LL / CART_NANOMETRES) /* counts/s: 5 m/s */
#define CART_FASTEST_POLE (16LL * CART_POLE_COUNTS)        /* counts/s: 16 turns a second */

typedef struct {
    int8_t direction;   /* of the push that is watched: 1, -1, or 0 for none */
    int32_t anchor;     /* cart count at its start */
    uint32_t pushed_us; /* since then */
} cart_stall_watch;

typedef struct {
    bool counted; /* `last` is a count */
    int32_t last;
} cart_jump_watch;

typedef struct {
    bool counted; /* `count` is a count */
    int32_t count;
    int8_t direction;           /* of the present push: 1, -1, or 0 for none */
    uint32_t lasts_us;          /* its length up to the newest count, not beyond the time that is needed */
    uint32_t right_us, left_us; /* of pushes since the count changed, not beyond the time that is needed */
} cart_frozen_cart_watch;

typedef struct {
    bool counted; /* `pole` and `cart` are counts */
    bool moved;   /* a look has ended since the pole's count changed */
    int32_t pole, cart;      /* counts; `cart` when the present look began */
    uint32_t elapsed_us;     /* of this look */
    int64_t lowest, highest; /* cart speed in um/s since then */
    int64_t rise, fall;      /* largest increase and decrease of that speed */
} cart_frozen_pole_watch;

typedef struct {
    cart_stall_watch stalls;
    cart_jump_watch cart_jumps, pole_jumps;
    cart_frozen_cart_watch cart_freezes;
    cart_frozen_pole_watch pole_freezes;
} cart_guards;

/* Forget everything: a hand may have moved cart and pole while the motor was off. */
void cart_guards_reset(cart_guards *guards);

/* A push of at least CART_HARD_PUSH one way for 0.5 s that moves the cart by less than 1 mm. */
bool cart_stalled(cart_stall_watch *watch, int32_t cart, int16_t motor, uint32_t period_us);

/* Has a count `moved` in `us` faster than `fastest` counts/s? One count may come from rounding. */
bool cart_too_fast(int64_t moved, int64_t us, int64_t fastest);

/* A count that changes faster over a period than cart or pole can move. */
bool cart_cart_jumped(cart_jump_watch *watch, int32_t cart, uint32_t period_us);
bool cart_pole_jumped(cart_jump_watch *watch, int32_t pole, uint32_t period_us);

/* A cart count that changes by one at most, as with an open wire, under a hard push one way and then the other. */
bool cart_cart_frozen(cart_frozen_cart_watch *watch, int32_t cart, int16_t motor, uint32_t period_us);

/* A pole count that changes by one at most while the cart speeds up by 0.2 m/s and slows down again. */
bool cart_pole_frozen(cart_frozen_pole_watch *watch, int32_t pole, int32_t cart, uint32_t period_us);

#endif
