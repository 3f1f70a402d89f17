/* The limits of the track, which know the cart's position and speed. They are looked at once a millisecond.

   Beyond the soft limit an outward motor value gives 0. A cart that runs outward too fast to stop before its
   hard limit is braked with full motor inward:

     left - shake < speed * (lag + reaction) + speed^2 / (2 * CART_BRAKING_UM_S2)

   `left` is the way to the hard limit and `lag` the age of the measured speed. A fast pole shakes the cart harder
   than the motor can hold it: by up to `lever` to each side of the common centre of mass, whose speed counts here
   if it is higher than the cart's. `shake` is twice the lever for a pole that turns 1.6 times a second or faster.

   Towards an end whose switch is pressed, the cart counts as being at that end or beyond.

   The brake acts while the cart is armed and after that until it has stood for half a second: a cart that STOP, the
   watchdog or a fault leaves at speed would roll into an end stop, and a swinging pole moves one that stands for a
   moment. It never pushes a cart that stands or moves inward.

   A frozen encoder shows a cart that stands; one with an open wire, one whose count changes to and fro by one. While
   the count changes by no more, the cart's motion is estimated from its last speed and, while the pole is slow, from
   hard pushes. After 20 mm or 100 counts of it, the larger, the cart is lost: its encoder is frozen, or something holds
   it. A lost cart is braked for the time that its estimated speed needs, or until its count changes by more. Friction
   can hold a cart against weaker pushes: they tell nothing. */
#ifndef CART_LIMITS_H
#define CART_LIMITS_H

#include "cart_config.h"

#include <stdbool.h>
#include <stdint.h>

#define CART_SOFT_COUNTS CART_COUNTS(CART_SOFT_LIMIT_UM) /* counts inside a stop */
#define CART_HARD_COUNTS CART_COUNTS(CART_HARD_LIMIT_UM)
#define CART_SPEED_SAMPLES 9u /* whose first and last give the speed */

/* Directions are 1 right, -1 left, 0 none. */
typedef struct {
    int8_t blocked; /* direction in which motor values are held at 0 */
    int8_t brake;   /* direction of the full motor value that brakes the cart */
    uint8_t sampled, newest;
    uint8_t fresh; /* samples since the cart was armed, at most as many as tell the speed */
    uint64_t us[CART_SPEED_SAMPLES];
    int32_t carts[CART_SPEED_SAMPLES], poles[CART_SPEED_SAMPLES];
    uint64_t until_us; /* the brake acts until then */
    uint64_t moved_us; /* the cart was armed or moved then */
    uint64_t blind_us; /* the brake of a lost cart acts until then */
    bool counted;      /* `count` is a count */
    int32_t count;     /* of the cart, since which its motion is estimated */
    uint64_t looked_us;
    int64_t speed_um, way_nm; /* estimated speed, um/s, and motion since the count changed */
} cart_limits;

/* A cart and its pole, from the zeros of homing. */
typedef struct {
    int64_t outward;   /* counts right of the middle */
    int64_t pole;      /* counts from upright */
    int32_t half_span; /* counts from the middle to a stop */
    int32_t lever_um;  /* m_p l / (m_c + m_p), with l from the pivot to the pole's centre of mass */
    bool armed;
    uint8_t pressed; /* end switches */
} cart_place;

/* Take a sample of the raw counts, unless the newest is younger than a millisecond. */
void cart_limits_sample(cart_limits *limits, uint64_t now_us, int32_t cart_count, int32_t pole_count);

/* Has a count changed faster than cart or pole can move, over the samples if all were taken since it was armed? */
bool cart_limits_cart_jumped(const cart_limits *limits);
bool cart_limits_pole_jumped(const cart_limits *limits);

/* Start the estimate of the cart's motion anew: the cart is armed now, and a hand may have moved it before. */
void cart_limits_forget(cart_limits *limits);

/* Does the cart's count change by one at most although the cart must have moved? `motor` is the value in force
   since the last look. */
bool cart_limits_lost(cart_limits *limits, uint64_t now_us, int16_t motor);

/* Brake a lost cart by its estimated speed, for 0.5 s at most. All limits were released before. */
void cart_limits_brake_blindly(cart_limits *limits, uint64_t now_us);

void cart_limits_apply(cart_limits *limits, uint64_t now_us, const cart_place *place);

/* End all limits: the cart homes, or its count is not to be trusted. */
void cart_limits_release(cart_limits *limits);

#endif
