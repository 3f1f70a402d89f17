#include "cart_limits.h"

#include "cart_guards.h"
#include "cart_numbers.h"

#include <math.h>

#define SAMPLE_US 1000u
#define REACTION_US 10000 /* until the motor's force has changed its sign */
#define RELEASE_US 10000  /* the brake is released this much later than it would be applied: it does not rattle */
#define REST 10000        /* um/s; slower outward motion is not braked */
#define JUMPED 5000000    /* um/s; no cart is faster: its count has jumped */
#define FASTEST 10000000  /* um/s; a higher speed counts as this one */
#define FAST_POLE (CART_POLE_COUNTS * 16LL / 10) /* counts/s; a higher speed shakes the cart no further */
#define PI 3.14159265358979323846
#define POLE_RADIANS (2 * PI / CART_POLE_COUNTS) /* a count */
#define LONGEST_ROLLING_US 3000000u /* after the cart was armed */
#define RESTED_US 500000u /* without motion, after which it rests */
#define SLOW_POLE (CART_POLE_COUNTS * 6LL / 10) /* counts/s; a faster pole may hold the cart against its motor */
#define PUSHED 5000000LL /* um/s^2: a hard push speeds a common cart up so hard */
#define SLOWED_US 100000 /* time constant of the estimated speed without a hard push */
#define LOST_NM (CART_NANOMETRES > 200000 ? 100 * CART_NANOMETRES : 20000000) /* estimated motion at the same count */
#define FASTEST_LOST 2500000 /* um/s; a higher estimate comes from a count that jumped */

static uint8_t oldest(const cart_limits *limits)
{
    if (limits->sampled < CART_SPEED_SAMPLES)
        return 0;
    return (uint8_t)((limits->newest + 1u) % CART_SPEED_SAMPLES);
}

static int64_t window_us(const cart_limits *limits)
{
    return (int64_t)(limits->us[limits->newest] - limits->us[oldest(limits)]);
}

void cart_limits_sample(cart_limits *limits, uint64_t now_us, int32_t cart_count, int32_t pole_count)
{
    if (limits->sampled && now_us < limits->us[limits->newest] + SAMPLE_US)
        return;
    if (limits->sampled < CART_SPEED_SAMPLES)
        limits->newest = limits->sampled++;
    else
        limits->newest = oldest(limits);
    if (limits->fresh < CART_SPEED_SAMPLES)
        limits->fresh++;
    limits->us[limits->newest] = now_us;
    limits->carts[limits->newest] = cart_count;
    limits->poles[limits->newest] = pole_count;
}

/* Over the samples, in counts/s, rounded down. */
static int64_t speed_of(const cart_limits *limits, const int32_t *counts)
{
    if (limits->sampled < 2)
        return 0;
    int64_t moved = (int64_t)counts[limits->newest] - counts[oldest(limits)];
    return cart_floor_divide(moved * 1000000, window_us(limits));
}

/* In um/s, rounded down. */
static int64_t cart_speed(const cart_limits *limits)
{
    return cart_floor_divide(speed_of(limits, limits->carts) * CART_NANOMETRES, 1000);
}

static int64_t within(int64_t number, int64_t largest)
{
    if (number > largest)
        return largest;
    return number < -largest ? -largest : number;
}

/* A wire that is open lets the count of a moving cart change to and fro by one. */
static bool stands(const cart_limits *limits)
{
    return cart_distance(limits->carts[limits->newest], limits->count) <= 1;
}

static int64_t moved(const cart_limits *limits, const int32_t *counts)
{
    return limits->fresh < CART_SPEED_SAMPLES ? 0 : cart_distance(counts[limits->newest], counts[oldest(limits)]);
}

bool cart_limits_cart_jumped(const cart_limits *limits)
{
    return cart_too_fast(moved(limits, limits->carts), window_us(limits), CART_FASTEST_CART);
}

bool cart_limits_pole_jumped(const cart_limits *limits)
{
    return cart_too_fast(moved(limits, limits->poles), window_us(limits), CART_FASTEST_POLE);
}

void cart_limits_forget(cart_limits *limits)
{
    limits->counted = false;
    limits->fresh = 0;
}

bool cart_limits_lost(cart_limits *limits, uint64_t now_us, int16_t motor)
{
    uint64_t passed_us = now_us > limits->looked_us ? now_us - limits->looked_us : 0;
    int64_t us = passed_us < SLOWED_US ? (int64_t)passed_us : SLOWED_US;
    limits->looked_us = now_us;
    if (!limits->counted || !stands(limits)) {
        limits->counted = true;
        limits->count = limits->carts[limits->newest];
        limits->speed_um = within(cart_speed(limits), FASTEST);
        limits->way_nm = 0;
        return false;
    }
    int64_t turning = speed_of(limits, limits->poles);
    bool slow_pole = turning < SLOW_POLE && turning > -SLOW_POLE;
    if (slow_pole && (motor >= CART_HARD_PUSH || motor <= -CART_HARD_PUSH)) {
        limits->speed_um += cart_floor_divide((motor > 0 ? PUSHED : -PUSHED) * us, 1000000);
    } else if (limits->speed_um < REST && limits->speed_um > -REST) {
        limits->speed_um = 0;
    } else {
        limits->speed_um -= cart_floor_divide(limits->speed_um * us, SLOWED_US);
    }
    limits->way_nm += cart_floor_divide(limits->speed_um * us, 1000);
    return limits->way_nm >= LOST_NM || limits->way_nm <= -LOST_NM;
}

void cart_limits_brake_blindly(cart_limits *limits, uint64_t now_us)
{
    int64_t size = limits->speed_um < 0 ? -limits->speed_um : limits->speed_um;
    if (size > FASTEST_LOST)
        return;
    limits->blind_us = now_us + (uint64_t)(size * 1000000 / PUSHED);
    limits->brake = limits->speed_um > 0 ? -1 : 1;
}

static int8_t brake(const cart_limits *limits, int64_t speed, const cart_place *place)
{
    if ((speed < REST && speed > -REST) || speed > JUMPED || speed < -JUMPED)
        return 0;
    int8_t direction = speed > 0 ? 1 : -1;
    int64_t turning = within(speed_of(limits, limits->poles), FAST_POLE);
    int64_t swing = (int64_t)(place->lever_um * ((double)turning * POLE_RADIANS) *
                              cos((double)place->pole * POLE_RADIANS)); /* um/s */
    int64_t size = direction * speed, of_centre = direction * (speed + swing);
    if (of_centre > size)
        size = of_centre;
    if (size > FASTEST)
        size = FASTEST;
    int64_t counts = direction * place->outward; /* towards the end ahead */
    if (CART_SWITCHES & place->pressed & (direction > 0 ? CART_RIGHT : CART_LEFT) && counts < place->half_span)
        counts = place->half_span;
    int64_t left = (int64_t)place->half_span - CART_HARD_COUNTS - counts;
    int64_t left_um = cart_floor_divide(left * CART_NANOMETRES, 1000);
    int64_t shake_um = 2 * (int64_t)place->lever_um * turning * turning / (FAST_POLE * FAST_POLE);
    int64_t lag_us = window_us(limits) / 2 + REACTION_US;
    if (limits->brake == -direction)
        lag_us += RELEASE_US;
    int64_t needed_um = size * lag_us / 1000000 + size * size / (2 * CART_BRAKING_UM_S2);
    return (int8_t)(left_um - shake_um < needed_um ? -direction : 0);
}

void cart_limits_apply(cart_limits *limits, uint64_t now_us, const cart_place *place)
{
    if (now_us < limits->blind_us && stands(limits))
        return;
    limits->blind_us = 0;
    int64_t speed = cart_speed(limits);
    int64_t away = place->outward < 0 ? -place->outward : place->outward;
    if (place->armed)
        limits->until_us = now_us + LONGEST_ROLLING_US;
    if (place->armed || speed >= REST || speed <= -REST)
        limits->moved_us = now_us;
    else if (now_us >= limits->moved_us + RESTED_US)
        limits->until_us = 0;
    limits->blocked = 0;
    if (place->armed && away >= (int64_t)place->half_span - CART_SOFT_COUNTS)
        limits->blocked = place->outward > 0 ? 1 : -1;
    limits->brake = now_us < limits->until_us ? brake(limits, speed, place) : 0;
}

void cart_limits_release(cart_limits *limits)
{
    limits->blocked = limits->brake = 0;
    limits->until_us = limits->blind_us = 0;
}
