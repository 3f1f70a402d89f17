#include "cart_guards.h"

#include "cart_numbers.h"

#include <string.h>

#define STALL_US 500000u
#define STALL_COUNTS CART_COUNTS(1000)
#define PUSH_US 100000u        /* of hard pushes one way, after which the count must have changed */
#define PUSH_SQUARE (12000LL * CART_NANOMETRES) /* us^2, of its beginning: until 0.5 m/s^2 move a cart by 3 counts */
/* In a look 0.2 m/s turn a pole as long as 1 m by two counts: 15 ms for 4096 a turn. */
#define LOOK_US (62000000 / CART_POLE_COUNTS > CART_SHORTEST_US ? 62000000 / CART_POLE_COUNTS : CART_SHORTEST_US)
#define ROUNDING_UM_S (4000LL * CART_NANOMETRES / LOOK_US) /* um/s: four counts of the cart in a look */
#define SPEED_CHANGE (ROUNDING_UM_S > 200000 ? ROUNDING_UM_S : 200000)
#define SECOND_US 1000000LL

static int8_t push(int16_t motor)
{
    if (motor >= CART_HARD_PUSH)
        return 1;
    return motor <= -CART_HARD_PUSH ? -1 : 0;
}

void cart_guards_reset(cart_guards *guards)
{
    memset(guards, 0, sizeof *guards);
}

bool cart_stalled(cart_stall_watch *watch, int32_t cart, int16_t motor, uint32_t period_us)
{
    int8_t direction = push(motor);
    bool same = direction == watch->direction && cart_distance(cart, watch->anchor) < STALL_COUNTS;
    if (direction == 0 || !same) {
        watch->direction = direction;
        watch->anchor = cart;
        watch->pushed_us = 0;
        return false;
    }
    watch->pushed_us += period_us;
    return watch->pushed_us >= STALL_US;
}

bool cart_too_fast(int64_t moved, int64_t us, int64_t fastest)
{
    return (moved - 1) * SECOND_US > fastest * us;
}

static bool jumped(cart_jump_watch *watch, int32_t count, uint32_t period_us, int64_t fastest)
{
    bool first = !watch->counted;
    int64_t moved = cart_distance(count, watch->last);
    watch->counted = true;
    watch->last = count;
    return !first && cart_too_fast(moved, (int64_t)period_us, fastest);
}

bool cart_cart_jumped(cart_jump_watch *watch, int32_t cart, uint32_t period_us)
{
    return jumped(watch, cart, period_us, CART_FASTEST_CART);
}

bool cart_pole_jumped(cart_jump_watch *watch, int32_t pole, uint32_t period_us)
{
    return jumped(watch, pole, period_us, CART_FASTEST_POLE);
}

bool cart_cart_frozen(cart_frozen_cart_watch *watch, int32_t cart, int16_t motor, uint32_t period_us)
{
    int8_t direction = push(motor);
    int64_t before_us = direction == watch->direction ? watch->lasts_us : 0;
    watch->direction = direction;
    watch->lasts_us = (uint32_t)(before_us + period_us < 2 * PUSH_US ? before_us + period_us : 2 * PUSH_US);
    if (!watch->counted || cart_distance(cart, watch->count) > 1) {
        watch->counted = true;
        watch->count = cart;
        watch->right_us = watch->left_us = 0;
    } else if (direction != 0 && before_us * before_us >= PUSH_SQUARE) {
        uint32_t *pushed_us = direction > 0 ? &watch->right_us : &watch->left_us;
        uint32_t left_us = PUSH_US - *pushed_us;
        *pushed_us += period_us < left_us ? period_us : left_us;
    }
    return watch->right_us >= PUSH_US && watch->left_us >= PUSH_US;
}

bool cart_pole_frozen(cart_frozen_pole_watch *watch, int32_t pole, int32_t cart, uint32_t period_us)
{
    if (!watch->counted || cart_distance(pole, watch->pole) > 1) {
        *watch = (cart_frozen_pole_watch){.counted = true, .pole = pole, .cart = cart};
        return false;
    }
    watch->elapsed_us += period_us;
    if (watch->elapsed_us < LOOK_US)
        return false;
    int64_t counts = (int64_t)cart - watch->cart;
    int64_t speed = cart_floor_divide(counts * CART_NANOMETRES * 1000, (int64_t)watch->elapsed_us);
    watch->cart = cart;
    watch->elapsed_us = 0;
    if (!watch->moved)
        watch->lowest = watch->highest = speed;
    watch->moved = true;
    watch->lowest = speed < watch->lowest ? speed : watch->lowest;
    watch->highest = speed > watch->highest ? speed : watch->highest;
    if (speed - watch->lowest > watch->rise)
        watch->rise = speed - watch->lowest;
    if (watch->highest - speed > watch->fall)
        watch->fall = watch->highest - speed;
    return watch->rise >= SPEED_CHANGE && watch->fall >= SPEED_CHANGE;
}
